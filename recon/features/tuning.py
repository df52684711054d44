"""Axis and tilt from two views half a turn apart, and the size of the finest structure: to align an instrument.

The second view is the first one mirrored about the axis, so that bands of rows find the axis' column at their heights
(`recon.prep.align.axis_from_pair`). A tilt also turns the views, which mixes rows: both are levelled by what is known
of it, and the bands are asked again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import rotate

from recon.base.arrays import F64
from recon.prep.align import AxisError, axis_from_pair
from recon.prep.axis_wedge import FEWEST_BANDS

BANDS = 12  # Bands of rows, at most; none has fewer than FEWEST_ROWS
FEWEST_ROWS = 8
ROUNDS = 3
FINEST = 0.05  # Columns: no band finds its axis better, since its rows mix with those beside it
OUTLIER = 4.0  # Median distances from the line beyond which a band does not count


@dataclass(frozen=True)
class PairAlignment:
    """Position and tilt of the rotation axis.

    Attributes:
        axis_col: its column at the middle row, 0 at the centre of the first column.
        tilt: rad; the axis' column grows by tan(tilt) a row. NaN: the bands do not tell it.
        uncertainty: rad, one standard deviation of the tilt.
        confident: the views match well, and their halves agree.
    """

    axis_col: float
    tilt: float
    uncertainty: float
    confident: bool


def align_pair(p0: NDArray[np.floating], p180: NDArray[np.floating]) -> PairAlignment:
    """Find the axis from two views half a turn apart.

    Args:
        p0, p180: float [row, col], line integrals.

    Raises:
        ValueError: shapes that differ, or values that are not finite.
        AxisError: no axis in the middle three quarters of the columns.
    """
    tilt, uncertainty = 0.0, math.nan
    for _ in range(ROUNDS):
        a, b = (_levelled(view, tilt) for view in (p0, p180))
        whole = axis_from_pair(a, b)
        slope, uncertainty = _slope(a, b, whole.value)
        if math.isnan(slope):
            return PairAlignment(axis_from_pair(p0, p180).value, math.nan, math.nan, whole.confident)
        tilt += math.atan(slope)
    return PairAlignment(whole.value, tilt, uncertainty, whole.confident)


def finest_structure(one: NDArray[np.floating], other: NDArray[np.floating]) -> float:
    """Pixels over which a view changes: its contrast divided by its slope, both from two frames of it, so free of
    noise.

    It is smaller the sharper the picture is, for the same sample at the same angle. NaN where there is only noise.

    Args:
        one, other: float [row, col], the same view twice.
    """
    contrast = float(np.mean((one - one.mean()) * (other - other.mean())))
    slope = sum(float(np.mean(np.diff(one, axis=axis) * np.diff(other, axis=axis))) for axis in range(2))
    return math.sqrt(contrast / slope) if contrast > 0 and slope > 0 else math.nan


def _levelled(view: NDArray[np.floating], tilt: float) -> F64:
    """The view turned about its middle, so that an axis with this tilt stands upright."""
    data = np.asarray(view, np.float64)
    return data if tilt == 0 else rotate(data, -math.degrees(tilt), reshape=False, order=1, mode="nearest")


def _slope(a: F64, b: F64, axis_col: float) -> tuple[float, float]:
    """Slope of the axis, columns a row, and its uncertainty: a straight line through the axes of bands of rows."""
    n = min(BANDS, len(a) // FEWEST_ROWS)
    heights, columns = list[float](), list[float]()
    near = max(8.0, 0.05 * a.shape[1])
    for rows in np.array_split(np.arange(len(a)), max(n, 1)):
        try:
            estimate = axis_from_pair(a[rows], b[rows])
        except AxisError:
            continue
        if estimate.confident and abs(estimate.value - axis_col) < near:
            heights.append(float(rows.mean()) - (len(a) - 1) / 2)
            columns.append(estimate.value)
    h, c = np.array(heights), np.array(columns)
    for _ in range(2):
        if h.size < FEWEST_BANDS:
            return math.nan, math.nan
        slope, level = np.polyfit(h, c, 1)
        off = np.abs(c - level - slope * h)
        good = off <= max(OUTLIER * float(np.median(off)), 1e-3)
        h, c = h[good], c[good]
    spread = max(FINEST, math.sqrt(float((off[good] ** 2).sum()) / max(h.size - 2, 1)))
    return float(slope), spread / math.sqrt(float(((h - h.mean()) ** 2).sum()))
