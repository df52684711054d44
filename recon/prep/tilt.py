"""find_tilt: how far the rotation axis leans in the detector's plane, from its column in bands of rows."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F64
from recon.prep.align import opposite_curves
from recon.prep.axis_wedge import FEWEST_BANDS, FEWEST_COLS, wedge_curves

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

STEEPEST = math.radians(5)  # Largest tilt of the search, radians
_DEEP = 0.2  # least difference of the logarithm of the mismatch between the found axes and typical ones
_FLOOR = 1e-3  # least mismatch that counts
_NEWTON, _CLOSE = 20, 1e-4  # steps, and the change in px at which they end
_OWN = 6  # px from the line: search range of a band's own axis


@dataclass(frozen=True)
class TiltEstimate:
    """Estimate of the tilt.

    Attributes:
        tilt: radians; the axis' column grows by tan(tilt) a row (`Geometry` calls it roll).
        uncertainty: radians, one standard deviation.
        axis_col: column of the axis at height 0.
    """

    tilt: float
    uncertainty: float
    axis_col: float


def find_tilt(bands: NDArray[np.floating], heights: F64, angles: F64) -> TiltEstimate:
    """The straight line through the axes of bands of rows with the least sum of the logarithms of their mismatches.

    The mismatch of a band with an axis comes from the double wedge. If that fails and the views cover the full turn, it
    comes from opposite views (see `recon.prep.align`). Its logarithm is the likelihood of a band with unknown noise: a
    band that fits badly with any axis, such as air or a clipped row, weighs little. The uncertainty has two parts. One
    is the jackknife over bands, or over groups of neighbours (which see the same sample) if that is larger (Efron &
    Stein 1981, Ann. Stat. 9, 586). The other is the scatter of the bands' own axes about the line, as the jackknife is
    too small if few bands carry the estimate.

    A tilt also turns the views: rows mix by tilt times half the width. The estimate is exact if that is small, and
    better on views levelled by a first estimate.

    Args:
        bands: [view, band, col], line integrals of thin bands of rows.
        heights: [band], px of the bands' middles from the row of `axis_col`.
        angles: [view], radians.

    Raises:
        ValueError: fewer than 4 bands or 8 columns, or bands that do not show the axis.
    """
    data, heights = np.asarray(bands, np.float64), np.asarray(heights, np.float64)
    if data.ndim != 3 or heights.shape != data.shape[1:2] or len(angles) != len(data):
        raise ValueError(f"bands {data.shape} must be [view, band, col] for {heights.shape} heights")
    if not np.isfinite(data).all():
        raise ValueError("bands hold NaN or infinite values; correct them first")
    if data.shape[2] < FEWEST_COLS:
        raise ValueError(f"{data.shape[2]} columns are too few to show the axis; at least {FEWEST_COLS} are needed")
    if len(heights) < FEWEST_BANDS or not np.ptp(heights) > 0:
        raise ValueError(
            f"{len(heights)} bands of rows are too few; at least {FEWEST_BANDS} at different heights are needed"
        )
    for curves_of in (wedge_curves, opposite_curves):
        with suppress(ValueError):
            return _line(*curves_of(data, np.asarray(angles, np.float64)), heights)
    raise ValueError(
        f"the axes of {len(heights)} bands of rows lie on no line within {math.degrees(STEEPEST):g} degrees, or the "
        "views do not go round half a turn"
    )


def _line(candidates: F64, curves: F64, heights: F64) -> TiltEstimate:
    """The line through the axes of bands, from their mismatch [band, candidate].

    Raises:
        ValueError: it has no clear optimum.
    """
    step, far = float(candidates[1] - candidates[0]), float(np.abs(heights).max())
    most = math.ceil(math.tan(STEEPEST) * far / step)
    curves = np.maximum(curves, _FLOOR)
    padded = np.pad(np.log(curves), ((0, 0), (most, most)), mode="edge")
    n, best, lowest = candidates.size, (0, 0), math.inf
    for slope in range(-most, most + 1):
        shifts = np.rint(slope * heights / far).astype(int) + most
        total = sum(curve[shift : shift + n] for curve, shift in zip(padded, shifts, strict=True))
        at = int(np.argmin(total))
        if total[at] < lowest:
            best, lowest = (slope, at), float(total[at])
    slope, at = best
    typical = float(np.median(np.log(curves).sum(axis=0)))
    if abs(slope) == most or not 0 < at < n - 1 or typical - lowest < _DEEP * heights.size:
        raise ValueError("no clear optimum")
    from scipy.interpolate import CubicSpline  # half a second

    splines = [CubicSpline(candidates, curve) for curve in curves]
    start = np.array([candidates[at], slope * step / far])
    every = np.arange(heights.size)
    line = _descend(splines, heights, every, start)
    spread = 0.0
    for count in (heights.size, max(FEWEST_BANDS, heights.size // 3)):
        parts = np.array_split(every, count)
        without = np.array([_descend(splines, heights, np.setdiff1d(every, part), line)[1] for part in parts])
        spread = max(spread, math.sqrt((count - 1) * float(np.mean((without - without.mean()) ** 2))))
    spread = math.hypot(spread, _scatter(splines, heights, line))
    return TiltEstimate(math.atan(line[1]), spread / (1 + line[1] ** 2), float(line[0]))


def _scatter(splines: list[CubicSpline], heights: F64, line: F64) -> float:
    """Standard deviation of the slope from the distances of the bands' own axes to the line (weighted least squares).

    A band's weight is the curvature of its logarithm. Few bands may lie at the ends, which determine the slope. The
    scatter is therefore divided by the effective number of bands for the slope, not by their total.
    """
    at = line[0] + line[1] * heights
    value, second = (np.array([spline(x, order) for spline, x in zip(splines, at, strict=True)]) for order in (0, 2))
    weight = np.maximum(second, 0) / np.maximum(value, _FLOOR)
    near = at[:, None] + np.linspace(-_OWN, _OWN, 20 * _OWN + 1)
    near = np.clip(near, splines[0].x[0], splines[0].x[-1])
    own = np.array([x[np.argmin(spline(x))] for spline, x in zip(splines, near, strict=True)]) - at
    lever = weight * (heights - np.average(heights, weights=weight)) ** 2
    carriers = lever.sum() ** 2 / (lever**2).sum()
    variance = np.average(own**2, weights=weight) * heights.size / (heights.size - 2)
    return math.sqrt(variance / carriers * weight.sum() / lever.sum())


def _descend(splines: list[CubicSpline], heights: F64, bands: NDArray[np.int64], start: F64) -> F64:
    """(axis at height 0, slope) of the least sum of logarithms near `start`, by least squares weighted anew."""
    line, h, far = start.copy(), heights[bands], float(np.abs(heights).max())
    for _ in range(_NEWTON):
        at = line[0] + line[1] * h
        value, first, second = (
            np.array([splines[b](x, order) for b, x in zip(bands, at, strict=True)]) for order in range(3)
        )
        weight = 1 / np.maximum(value, _FLOOR)
        first, second = weight * first, weight * np.maximum(second, 0)  # a band counts only within its own minimum
        bend = np.array([[second.sum(), (h * second).sum()], [(h * second).sum(), (h * h * second).sum()]])
        if np.linalg.det(bend) <= 0:
            raise ValueError("no clear optimum")
        move = np.linalg.solve(bend, [first.sum(), (h * first).sum()])
        move *= min(1.0, 1 / max(abs(move[0]), abs(move[1]) * far, 1e-12))
        line -= move
        if max(abs(move[0]), abs(move[1]) * far) < _CLOSE:
            break
    return line
