"""Pixels that answer unlike their neighbours in all views, whose stripes in sinograms become rings in volumes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, median_filter, minimum_filter

from recon.base.arrays import F32, median_deviation
from recon.base.geometry import Geometry

_BLOCKS, _BLOCK = 8, 5
_RING_VIEWS, _NEIGHBOURS = 20, 9  # views; pixels along a row
_SURE, _SHARED, _FEWEST_PAIRS = 3.0, 2.0, 40  # standard deviations; columns with one on the other side of the axis
NARROWEST = 64  # columns; in 40 columns the methods that remove stripes add more than they remove
_SEEN = 3.5  # `Steadiness.score` from which on there are stripes: 0.3 to 2.7 without, 4.4 and 5.3 in two real scans
_ONE_SIDED = 0.5  # of pixels' answers the odd part equals the even one; layers of the sample have hardly any
_STEADY_BLOCKS, _STEADY_BLOCK = 8, 8  # contiguous blocks of views, and views of the smallest one
AT_AXIS = 4.0  # Columns on either side: a body this small on the axis looks like a ring
_FEWEST_MIRRORED = 20  # mirrored columns


def ring_offsets(residual: F32, geometry: Geometry) -> F32:
    """Offsets of single pixels [row, col] that are constant over all views and cause rings in a volume.

    It is the median of the residual over the views, less its neighbourhood along the row. The wall of a can around the
    axis stays in all views, too, in all rows alike (-1.1 dB on a battery), and on both sides of the axis. So of what
    rows have in common only that counts which the other side lacks, see `without_layers`. Offsets below three standard
    errors of their scatter between blocks of neighbouring angles count by the share that gains have in them, as columns
    differ from those on the other side (Wiener). With few views noise cannot be separated from the sample: then all are
    0. What a model leaves of the sample changes with the angle: blocks of views taken in another order would agree on
    it, and parts of the sample would count as rings (-0.5 dB).

    Args:
        residual: views less a model's views, [view, row, col].
    """
    n, rows, cols = residual.shape
    axis_col = geometry.axis_col
    if n < _RING_VIEWS or cols < _NEIGHBOURS:
        return np.zeros((rows, cols), np.float32)
    by_angle = np.argsort(np.mod(geometry.angles, 2 * np.pi), kind="stable")
    parts = np.array_split(by_angle, min(n // _BLOCK, _BLOCKS))
    blocks = np.stack([_fine(np.median(residual[part], axis=0)) for part in parts])
    steady = blocks.mean(axis=0)
    shared = median_filter(steady, (min(rows, _NEIGHBOURS), 1), mode="nearest")
    steady += without_layers(shared, axis_col) - shared
    error2 = blocks.var(axis=0) / (len(blocks) - 1)
    error2 = np.maximum(error2, np.median(error2)) + 1e-30
    odd = (blocks - mirrored(blocks, axis_col)) / math.sqrt(2)
    spread2 = median_deviation(odd.mean(axis=0)) ** 2 - median_deviation(odd - odd.mean(axis=0)) ** 2 / (
        len(blocks) - 1
    )
    prior = max(spread2, 0.0)
    share = np.where(steady**2 > _SURE**2 * error2, 1.0, prior / (prior + error2))
    return np.asarray(steady * share, np.float32)


def _fine(image: F32) -> F32:
    return image - median_filter(image, (1, _NEIGHBOURS), mode="nearest")


def mirrored(values: NDArray[np.floating], axis_col: float) -> NDArray[np.floating]:
    """Values [..., col] of the columns on the other side of the axis, by cubic splines; NaN where there are none."""
    from scipy.interpolate import make_interp_spline  # a quarter of a second

    cols = values.shape[-1]
    at = 2 * axis_col - np.arange(cols)
    spline = make_interp_spline(np.arange(cols), values, 3, axis=-1)
    return np.where((at >= 0) & (at <= cols - 1), spline(np.clip(at, 0, cols - 1)), np.nan)


def without_layers(stripes: F32, axis_col: float) -> F32:
    """Stripes [row, col] minus what the columns on the other side of the axis also show.

    Where both sides have more in common than twice the standard deviation of what is one-sided, it belongs to layers of
    the sample around the axis: of 800 pairs of independent columns, one has. Columns without one on the other side stay
    as they are.
    """
    across = mirrored(stripes, axis_col)
    seen = np.isfinite(across[0])
    if seen.sum() < _FEWEST_PAIRS:
        return stripes
    usual = _SHARED * median_deviation((stripes - across)[:, seen] / math.sqrt(2))
    near = np.where(seen, across, 0)
    low, high = (extreme(near, (1, 3), mode="nearest") for extreme in (minimum_filter, maximum_filter))
    shared = np.where(stripes > 0, np.clip(high, 0, np.maximum(stripes, 0)), np.clip(low, np.minimum(stripes, 0), 0))
    return np.asarray(stripes - np.where(seen & (np.abs(shared) > usual), shared, 0), np.float32)


@dataclass(frozen=True)
class Steadiness:
    """What is constant over all views in the columns of a sinogram, as standard deviations of fine differences.

    A layer of the sample around the axis stays in its columns, too, but in those on both sides of the axis alike. The
    answer of a pixel knows nothing of the pixel on the other side. So stripes are odd about the axis as much as they
    are even, and only those of the sample are even alone.

    Attributes:
        odd, even: parts of the mean over blocks of views.
        noise: of the odd part, by how it differs between the blocks.
    """

    odd: float
    even: float
    noise: float

    @property
    def score(self) -> float:
        """The odd part in units of its noise; about 1 without stripes."""
        return self.odd / max(self.noise, 1e-12)

    @property
    def stripes(self) -> bool:
        """Whether the pixels respond unequally."""
        return self.score > _SEEN and self.odd > _ONE_SIDED * self.even


def steadiness(sinograms: F32, axis_col: float) -> Steadiness | None:
    """How constant and how asymmetric the columns of sinograms are; None if too few columns have a mirrored one.

    Args:
        sinograms: [view, row, col] in the order of the angles.
        axis_col: column of the rotation axis.
    """
    n, rows, cols = sinograms.shape
    blocks = np.array_split(np.arange(n), min(max(n // _STEADY_BLOCK, 2), _STEADY_BLOCKS))
    right = np.arange(math.ceil(axis_col + AT_AXIS), cols)
    right = right[2 * axis_col - right >= 0]
    if right.size < _FEWEST_MIRRORED:
        return None
    fine = np.stack([[_fine_columns(sinograms[block, row]) for row in range(rows)] for block in blocks])
    own, across = fine[..., right], mirrored(fine, axis_col)[..., right]
    odd, even = (own - across) / math.sqrt(2), (own + across) / math.sqrt(2)
    mean = odd.mean(axis=0)
    noise = median_deviation(odd - mean) / math.sqrt(len(blocks) - 1)
    return Steadiness(median_deviation(mean), median_deviation(even.mean(axis=0)), noise)


def _fine_columns(sinogram: F32) -> NDArray[np.floating]:
    """[col] median difference of a column from the four beside it, without slow changes along the row."""
    x = np.pad(sinogram, ((0, 0), (2, 2)), mode="edge")
    off = np.median(x[:, 2:-2] - (x[:, :-4] + x[:, 1:-3] + x[:, 3:-1] + x[:, 4:]) / 4, axis=0)
    return np.asarray(np.convolve(off, (-0.5, 1, -0.5), mode="same"))
