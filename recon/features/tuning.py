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
from recon.prep.align import axis_from_pair, mirror_mismatch
from recon.prep.axis_wedge import FEWEST_BANDS
from recon.prep.tilt import line_through

BANDS = 12  # Bands of rows, at most; none has fewer than FEWEST_ROWS
FEWEST_ROWS = 8
ROUNDS = 3


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
    tilt, found = 0.0, None
    for _ in range(ROUNDS):
        a, b = (_levelled(view, tilt) for view in (p0, p180))
        whole = axis_from_pair(a, b)
        rows = np.array_split(np.arange(len(a)), max(1, min(BANDS, len(a) // FEWEST_ROWS)))
        if len(rows) < FEWEST_BANDS:
            break
        curves = np.stack([mirror_mismatch(a[band], b[band], whole.candidates) for band in rows])
        heights = np.array([band.mean() for band in rows]) - (len(a) - 1) / 2
        try:
            found = line_through(whole.candidates, curves, heights)
        except ValueError:
            found = None
            break
        tilt += found.tilt
    if found is None:
        return PairAlignment(axis_from_pair(p0, p180).value, math.nan, math.nan, whole.confident)
    return PairAlignment(whole.value, tilt, found.uncertainty, whole.confident)


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
