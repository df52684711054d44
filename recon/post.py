"""Enhancement of a volume before it is segmented: a box without the can, rescaled and smoothed grey values."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.base.arrays import F32, F64, some_values

_CLUSTERED = 20_000  # values from which centres are computed
_STARTS = 8
MOST = 6


@dataclass(frozen=True, eq=False)
class Clusters:
    """Grey values grouped by k-means.

    Attributes:
        centres: float64 [cluster], rising.
        shares: of all values in each.
        inertias: mean squared distance to the centres for 1, 2, ... clusters, if the elbow rule was used.
    """

    centres: F64
    shares: F64
    inertias: F64

    @property
    def threshold(self) -> float:
        """Half-way between the brightest centre and the centre of the largest other cluster.

        Clusters between those two are edges, mixtures of both; an edge lies half-way (ISO 50 % rule).
        """
        return float(self.centres[-1] + self.centres[:-1][self.shares[:-1].argmax()]) / 2


def k_means(values: NDArray[np.floating], k: int, seed: int = 0) -> F64:
    """Rising centres [k] of one-dimensional k-means (MacQueen 1967), the best of some starts by k-means++.

    Raises:
        ValueError: fewer than k different values, or values that are not finite.
    """
    return _fitted(_sampled(values, seed), k, seed)[0]


def clusters(values: NDArray[np.floating], k: int | None = None, seed: int = 0) -> Clusters:
    """Clusters of grey values; k None: as many as the elbow rule says, 2 to 5, see `elbow`.

    Raises:
        ValueError: as `k_means`, or for k below 2.
    """
    if k is not None and k < 2:
        raise ValueError(f"at least 2 clusters are needed to tell particles from the rest, got {k}")
    sample = _sampled(values, seed)
    inertias = np.empty(0)
    if k is None:
        most = min(MOST, np.unique(sample).size)
        inertias = np.array([_fitted(sample, n, seed)[1] for n in range(1, most + 1)])
        k = elbow(inertias)
    centres, _ = _fitted(sample, k, seed)
    counts = np.bincount(np.searchsorted((centres[1:] + centres[:-1]) / 2, sample), minlength=k)
    return Clusters(centres, counts / sample.size, inertias)


def elbow(inertias: F64) -> int:
    """The number of clusters at the elbow of the mean squared distances W for 1, 2, ... clusters; at least 2.

    That is the sharpest bend of the logarithm log(W). The bend of W itself (Thorndike 1953) is at 2 for any number of
    equal steps, because W falls as 1 / k² before it.
    """
    if inertias.size < 3:
        return 2
    fall = np.log(np.maximum(inertias, 1e-9 * inertias[0]))
    return int(np.diff(fall, 2).argmax()) + 2


def _sampled(values: NDArray[np.floating], seed: int) -> F64:
    flat = np.asarray(values).ravel()
    if flat.size > _CLUSTERED:
        flat = np.random.default_rng(seed).choice(flat, _CLUSTERED, replace=False)
    if not np.isfinite(flat).all():
        raise ValueError("some grey values are not finite")
    return flat.astype(np.float64)


def _fitted(sample: F64, k: int, seed: int) -> tuple[F64, float]:
    """Centres, rising, and the mean squared distance to them."""
    from scipy.cluster.vq import ClusterError, kmeans2

    if np.unique(sample).size < k:
        raise ValueError(f"{np.unique(sample).size} different grey values do not make {k} clusters")
    best: tuple[F64, float] | None = None
    rng = np.random.default_rng(seed)
    for _ in range(_STARTS):
        try:
            centres = np.sort(kmeans2(sample[:, None], k, iter=30, minit="++", rng=rng, missing="raise")[0].ravel())
        except ClusterError:  # a start may lose a cluster
            continue
        nearest = centres[np.searchsorted((centres[1:] + centres[:-1]) / 2, sample)]
        inertia = float(np.mean((sample - nearest) ** 2))
        if best is None or inertia < best[1]:
            best = centres, inertia
    if best is None:
        raise ValueError(f"{k} clusters do not fit {sample.size} grey values from {sample.min():g} to {sample.max():g}")
    return best


Box = tuple[slice, slice, slice]

_SAMPLE = 4_000_000  # voxels from which percentiles are computed


def sample_circle(volume: F32) -> tuple[float, float, float]:
    """Centre (y, x) and radius of the sample seen along z, in voxels.

    K-means divides the root of the mean over z above its least value into two classes, so that a pin of metal is not
    one of them; the circle has the extent of the largest connected part.

    Args:
        volume: [z, y, x], finite.

    Raises:
        ValueError: the mean is the same everywhere.
    """
    mean = volume.mean(axis=0, dtype=np.float64)
    mean = np.sqrt(mean - mean.min())
    parts, _ = ndimage.label(ndimage.binary_fill_holes(mean > k_means(mean.ravel(), 2).mean()))
    largest = np.bincount(parts.ravel())[1:].argmax() + 1
    rows, cols = np.nonzero(parts == largest)
    radius = (np.ptp(rows) + np.ptp(cols) + 2) / 4
    return float(rows.min() + rows.max()) / 2, float(cols.min() + cols.max()) / 2, float(radius)


def inscribed_box(shape: tuple[int, int, int], circle: tuple[float, float, float], margin: float = 0.05) -> Box:
    """All slices of the square inside a circle, of side 2 r cos 45° less a margin, cut to the volume.

    Args:
        shape: (nz, ny, nx).
        circle: centre (y, x) and radius in voxels.
        margin: share of the side taken off at each of its ends, 0 to 0.5.

    Raises:
        ValueError: for another margin, or a box that is empty.
    """
    if not 0 <= margin < 0.5:
        raise ValueError(f"the margin is a share of the side, 0 to 0.5, got {margin}")
    *centre, radius = circle
    half = radius * math.cos(math.pi / 4) * (1 - 2 * margin)
    y, x = (
        slice(max(0, math.ceil(c - half)), min(n, math.floor(c + half) + 1))
        for c, n in zip(centre, shape[1:], strict=True)
    )
    if y.start >= y.stop or x.start >= x.stop:
        raise ValueError(f"the square in a circle of radius {radius:.3g} voxels at {centre} holds no voxel of {shape}")
    return slice(0, shape[0]), y, x


def rescaled(volume: F32, low: float = 0.5, high: float = 99.5) -> F32:
    """Grey values rescaled from 0 at the `low` to 1 at the `high` percentile, clipped at both.

    Raises:
        ValueError: the percentiles are no range, or their values are equal.
    """
    if not 0 <= low < high <= 100:
        raise ValueError(f"percentiles must rise within 0 to 100, got {low} and {high}")
    bottom, top = _range(volume, low, high)
    return np.clip((volume - np.float32(bottom)) / np.float32(top - bottom), 0, 1)


def _range(volume: F32, low: float, high: float) -> tuple[float, float]:
    bottom, top = np.percentile(some_values(volume, _SAMPLE), [low, high])
    if not top > bottom:
        raise ValueError(f"grey values are {bottom:g} at both percentiles ({low:g} and {high:g}): nothing to rescale")
    return float(bottom), float(top)


def enhanced(
    volume: F32, percentiles: tuple[float, float] = (0.5, 99.5), gamma: float = 1.0, sigma: float = 0.7
) -> F32:
    """Grey values rescaled, raised to the power `gamma`, then smoothed by a Gaussian.

    A gamma other than 1 moves edges, since half of the grey value is then not half of the attenuation.

    Args:
        gamma: above 0.
        sigma: of the Gaussian, voxels; 0: none.

    Raises:
        ValueError: for other settings.
    """
    if not (gamma > 0 and sigma >= 0):
        raise ValueError(f"gamma must be above 0 and sigma 0 or more, got {gamma} and {sigma}")
    out = rescaled(volume, *percentiles)
    if gamma != 1:
        out **= np.float32(gamma)
    return ndimage.gaussian_filter(out, sigma) if sigma > 0 else out


def grey_at(volume: F32, level: float, percentiles: tuple[float, float] = (0.5, 99.5), gamma: float = 1.0) -> float:
    """The value of the volume at a `level` of its grey values, as `enhanced` rescales them."""
    bottom, top = _range(volume, *percentiles)
    return bottom + (top - bottom) * float(level ** (1 / gamma))


def enhanced_deviation(
    volume: F32, deviation: F32, percentiles: tuple[float, float] = (0.5, 99.5), gamma: float = 1.0
) -> F32:
    """The standard deviation of the grey values of `enhanced`, from that of the voxels; smoothing is not taken to lower
    it further.

    Args:
        volume, deviation: [z, y, x] of the same unit.
    """
    bottom, top = _range(volume, *percentiles)
    scaled = deviation / np.float32(top - bottom)
    if gamma != 1:
        scaled *= np.float32(gamma) * np.maximum(rescaled(volume, *percentiles), 0.01) ** np.float32(gamma - 1)
    return scaled
