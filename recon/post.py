"""Divides the grey values of a volume into clusters (k-means)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F64

_SAMPLED_VALUES = 20_000  # number of values from which the centres are computed
_STARTS = 8
MOST = 6


@dataclass(frozen=True, eq=False)
class Clusters:
    """Grey values grouped by k-means.

    Attributes:
        centres: float64 [cluster], ascending.
        shares: share of all values in each cluster.
        inertias: mean squared distance to the centres for 1, 2, ... clusters, if the elbow rule was used.
    """

    centres: F64
    shares: F64
    inertias: F64

    @property
    def threshold(self) -> float:
        """Threshold between particles and the rest: half-way between the brightest centre and the centre of the largest
        other cluster.

        Clusters between these two contain voxels at edges, which are mixtures of both. An edge is assumed half-way (ISO
        50 % rule).
        """
        return float(self.centres[-1] + self.centres[:-1][self.shares[:-1].argmax()]) / 2


def k_means(values: NDArray[np.floating], k: int, seed: int = 0) -> F64:
    """Centres [k], ascending, of one-dimensional k-means (MacQueen 1967): the best of several k-means++ starts.

    Raises:
        ValueError: there are fewer than k different values, or values that are not finite.
    """
    return _fitted(_sampled(values, seed), k, seed)[0]


def clusters(values: NDArray[np.floating], k: int | None = None, seed: int = 0) -> Clusters:
    """Divide grey values into k clusters. If k is None, the elbow rule chooses 2 to 5 clusters, see `elbow`.

    Raises:
        ValueError: as for `k_means`, or k is below 2.
    """
    if k is not None and k < 2:
        raise ValueError(f"at least 2 clusters are needed to tell particles from the rest, got {k}")
    sample = _sampled(values, seed)
    inertias = np.empty(0)
    if k is None:
        most_levels = min(MOST, np.unique(sample).size)
        inertias = np.array([_fitted(sample, n, seed)[1] for n in range(1, most_levels + 1)])
        k = elbow(inertias)
    centres, _ = _fitted(sample, k, seed)
    counts = np.bincount(np.searchsorted((centres[1:] + centres[:-1]) / 2, sample), minlength=k)
    return Clusters(centres, counts / sample.size, inertias)


def elbow(inertias: F64) -> int:
    """The number of clusters at the elbow of the mean squared distances W for 1, 2, ... clusters; at least 2.

    The elbow is the sharpest bend of log(W). Thorndike (1953) takes the sharpest bend of W. But if a sample has several
    grey values at equal steps, W falls as 1 / k² up to their number, and its sharpest bend is always at 2.
    """
    if inertias.size < 3:
        return 2
    fall = np.log(np.maximum(inertias, 1e-9 * inertias[0]))
    return int(np.diff(fall, 2).argmax()) + 2


def _sampled(values: NDArray[np.floating], seed: int) -> F64:
    flat = np.asarray(values).ravel()
    if flat.size > _SAMPLED_VALUES:
        flat = np.random.default_rng(seed).choice(flat, _SAMPLED_VALUES, replace=False)
    if not np.isfinite(flat).all():
        raise ValueError("some grey values are not finite")
    return flat.astype(np.float64)


def _fitted(sample: F64, k: int, seed: int) -> tuple[F64, float]:
    """Centres, ascending, and the mean squared distance of the values to their centres."""
    from scipy.cluster.vq import ClusterError, kmeans2

    if np.unique(sample).size < k:
        raise ValueError(f"{np.unique(sample).size} different grey values are too few for {k} clusters")
    best: tuple[F64, float] | None = None
    rng = np.random.default_rng(seed)
    for _ in range(_STARTS):
        try:
            centres = np.sort(kmeans2(sample[:, None], k, iter=30, minit="++", rng=rng, missing="raise")[0].ravel())
        except ClusterError:  # a cluster may become empty
            continue
        nearest = centres[np.searchsorted((centres[1:] + centres[:-1]) / 2, sample)]
        inertia = float(np.mean((sample - nearest) ** 2))
        if best is None or inertia < best[1]:
            best = centres, inertia
    if best is None:
        raise ValueError(
            f"k-means did not find {k} clusters in {sample.size} grey values from {sample.min():g} to {sample.max():g}"
        )
    return best
