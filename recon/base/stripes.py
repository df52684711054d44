"""Detector pixels whose sensitivity differs from their neighbours. They make stripes in sinograms, rings in volumes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, median_filter, minimum_filter

from recon.base.arrays import F32, median_deviation
from recon.base.geometry import Geometry

_BLOCKS, _BLOCK = 8, 5
_RING_VIEWS, _NEIGHBOURS = 20, 9  # fewest projections; number of pixels along a row
# two limits in standard deviations; smallest number of columns that have a mirrored column
_STANDARD_ERRORS, _SHARED, _FEWEST_PAIRS = 3.0, 2.0, 40
NARROWEST = 64  # least columns; with 40 columns, the methods that remove stripes add larger errors than they remove
# `Steadiness.score` from which on there are stripes. Scans without stripes have 0.3 to 2.7, two real scans 4.4 and 5.3
_VISIBLE_SCORE = 3.5
# smallest ratio of the odd to the even part. For pixel sensitivities both parts are equal; for layers of the sample the
# odd part is almost 0
_ONE_SIDED = 0.5
# number of contiguous blocks of projections; number of projections in the smallest block
_STEADY_BLOCKS, _STEADY_BLOCK = 8, 8
AT_AXIS = 4.0  # columns on either side of the axis; a body this small on the axis looks like a ring
_FEWEST_MIRRORED = 20  # smallest number of mirrored columns


def ring_offsets(residual: F32, geometry: Geometry) -> F32:
    """Offsets of single pixels [row, col] that are constant over all projections and cause rings in a volume.

    An offset is the median of the residual over the projections, minus the median of its neighbours along the row. The
    wall of a can around the axis is also constant over all projections, but it is the same in all rows and on both
    sides of the axis. Counting it as an offset costs 1.1 dB on a battery. So an offset that all rows share counts only
    if the columns on the other side of the axis do not show it, see `without_layers`. Offsets below three standard
    errors (from the scatter between blocks of neighbouring angles) are multiplied by the share of pixel sensitivity in
    them, estimated by comparing columns with those on the other side (Wiener filter). With few projections, noise
    cannot be separated from the sample; then all offsets are 0. The part of the sample that a model does not explain
    changes with the angle. Blocks that are contiguous in angle see it differently. Blocks in another order would all
    see the same mean, which would count as rings (-0.5 dB).

    Args:
        residual: projections minus the projections of a model, [view, row, col].
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
    differences = (blocks - mirrored(blocks, axis_col)) / math.sqrt(2)
    spread2 = median_deviation(differences.mean(axis=0)) ** 2 - median_deviation(
        differences - differences.mean(axis=0)
    ) ** 2 / (len(blocks) - 1)
    prior = max(spread2, 0.0)
    share = np.where(steady**2 > _STANDARD_ERRORS**2 * error2, 1.0, prior / (prior + error2))
    return np.asarray(steady * share, np.float32)


def _fine(image: F32) -> F32:
    return image - median_filter(image, (1, _NEIGHBOURS), mode="nearest")


def mirrored(values: NDArray[np.floating], axis_col: float) -> NDArray[np.floating]:
    """Values [..., col] at the mirrored columns on the other side of the axis (cubic splines); NaN outside."""
    from scipy.interpolate import make_interp_spline  # loading takes a quarter of a second

    cols = values.shape[-1]
    mirror = 2 * axis_col - np.arange(cols)
    spline = make_interp_spline(np.arange(cols), values, 3, axis=-1)
    return np.where((mirror >= 0) & (mirror <= cols - 1), spline(np.clip(mirror, 0, cols - 1)), np.nan)


def without_layers(stripes: F32, axis_col: float) -> F32:
    """Stripes [row, col] minus the part that the columns on the other side of the axis also show.

    If the part that both sides share is more than twice the standard deviation of the one-sided part, the shared part
    belongs to layers of the sample around the axis. By chance this happens for one in 800 pairs of independent columns.
    Columns without a mirrored column are not changed.
    """
    opposite = mirrored(stripes, axis_col)
    seen = np.isfinite(opposite[0])
    if seen.sum() < _FEWEST_PAIRS:
        return stripes
    usual = _SHARED * median_deviation((stripes - opposite)[:, seen] / math.sqrt(2))
    opposite_or_zero = np.where(seen, opposite, 0)
    low, high = (extreme(opposite_or_zero, (1, 3), mode="nearest") for extreme in (minimum_filter, maximum_filter))
    shared = np.where(stripes > 0, np.clip(high, 0, np.maximum(stripes, 0)), np.clip(low, np.minimum(stripes, 0), 0))
    return np.asarray(stripes - np.where(seen & (np.abs(shared) > usual), shared, 0), np.float32)


@dataclass(frozen=True)
class Steadiness:
    """How much the columns of a sinogram differ from each other in all projections in the same way, as standard
    deviations.

    The standard deviations are of fine differences between columns. A layer of the sample around the axis also makes
    columns that are constant over all projections, but equally on both sides of the axis. The sensitivity of a pixel is
    independent of the pixel on the other side. So stripes from pixels have an odd part (about the axis) as large as
    their even part. Stripes from the sample have only an even part.

    Attributes:
        odd, even: odd and even part of the mean over blocks of projections.
        noise: noise of the odd part, from its differences between the blocks.
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
        """Whether the sensitivities of the pixels differ."""
        return self.score > _VISIBLE_SCORE and self.odd > _ONE_SIDED * self.even


def steadiness(sinograms: F32, axis_col: float) -> Steadiness | None:
    """The `Steadiness` of sinograms: how constant and how asymmetric their columns are. None if too few columns have a
    mirrored column.

    Args:
        sinograms: [view, row, col] in the order of the angles.
        axis_col: column of the rotation axis.
    """
    n, rows, cols = sinograms.shape
    blocks = np.array_split(np.arange(n), min(max(n // _STEADY_BLOCK, 2), _STEADY_BLOCKS))
    right_columns = np.arange(math.ceil(axis_col + AT_AXIS), cols)
    right_columns = right_columns[2 * axis_col - right_columns >= 0]
    if right_columns.size < _FEWEST_MIRRORED:
        return None
    fine = np.stack([[_fine_columns(sinograms[block, row]) for row in range(rows)] for block in blocks])
    own, mirrored_values = fine[..., right_columns], mirrored(fine, axis_col)[..., right_columns]
    odd_part, even_part = (own - mirrored_values) / math.sqrt(2), (own + mirrored_values) / math.sqrt(2)
    mean = odd_part.mean(axis=0)
    noise = median_deviation(odd_part - mean) / math.sqrt(len(blocks) - 1)
    return Steadiness(median_deviation(mean), median_deviation(even_part.mean(axis=0)), noise)


def _fine_columns(sinogram: F32) -> NDArray[np.floating]:
    """[col] median difference of a column from its four neighbours, without slow changes along the row."""
    x = np.pad(sinogram, ((0, 0), (2, 2)), mode="edge")
    deviations = np.median(x[:, 2:-2] - (x[:, :-4] + x[:, 1:-3] + x[:, 3:-1] + x[:, 4:]) / 4, axis=0)
    return np.asarray(np.convolve(deviations, (-0.5, 1, -0.5), mode="same"))
