"""find_tilt: the in-plane tilt of the rotation axis, from the column of the axis in bands of rows."""

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

STEEPEST = math.radians(5)  # largest tilt of the search, in radians
_DEEP = 0.2  # smallest difference in the logarithm of the mismatch between the axes of the result and typical axes
_FLOOR = 1e-3  # smaller mismatches are set to this value
_SIGMAS = 1.4826  # ratio of standard deviation to median distance for normal errors
_OWN = 6  # px; the axis of a single band is searched within this distance of the line


@dataclass(frozen=True)
class TiltEstimate:
    """Estimate of the in-plane tilt of the rotation axis.

    Attributes:
        tilt: radians; the column of the axis grows by tan(tilt) per row. (`Geometry` calls this tilt roll.)
        uncertainty: radians, one standard deviation.
        axis_col: column of the axis at height 0.
    """

    tilt: float
    uncertainty: float
    axis_col: float


def find_tilt(bands: NDArray[np.floating], heights: F64, angles: F64) -> TiltEstimate:
    """The in-plane tilt of the rotation axis, measured from bands of rows. It is the slope of the straight line (column
    of the axis against row) with the smallest sum of log mismatches of the bands.

    The mismatch of a band with an axis comes from the double wedge. If the double wedge fails and the scan covers 360°,
    the mismatch comes from opposite projections (see `recon.prep.align`). The logarithm of the mismatch is the
    log-likelihood of a band with unknown noise. So a band that agrees badly with every axis, such as air or a clipped
    row, has little influence. The uncertainty has two parts. One is the jackknife over bands, or over groups of
    neighbouring bands (which see the same sample) if that is larger (Efron & Stein 1981, Ann. Stat. 9, 586). The other
    is the scatter of the bands' own axes about the line, because the jackknife is too small if few bands determine the
    estimate.

    A tilt also rotates the projections, so that rows mix by tilt times half the width. The estimate is exact if this
    product is small. Otherwise, correct the projections with a first estimate, and measure again.

    Args:
        bands: [view, band, col], line integrals of thin bands of rows.
        heights: [band], distance in px of the middle of each band from the row to which `axis_col` of the result
            refers.
        angles: [view], radians.

    Raises:
        ValueError: there are fewer than 4 bands or 8 columns, or the bands do not show the axis.
    """
    data, heights = np.asarray(bands, np.float64), np.asarray(heights, np.float64)
    if data.shape[2] < FEWEST_COLS:
        raise ValueError(f"{data.shape[2]} columns are too few to find the axis; at least {FEWEST_COLS} are needed")
    if len(heights) < FEWEST_BANDS or not np.ptp(heights) > 0:
        raise ValueError(
            f"{len(heights)} bands of rows are too few to measure the tilt; at least {FEWEST_BANDS} at different "
            "heights are needed"
        )
    for curves_of in (wedge_curves, opposite_curves):
        with suppress(ValueError):
            return line_through(*curves_of(data, np.asarray(angles, np.float64)), heights)
    raise ValueError(
        f"the axes of {len(heights)} bands of rows are not on one line with a tilt of at most "
        f"{math.degrees(STEEPEST):g} degrees, or the projections are not evenly spread over 180°, so no tilt was found"
    )


def line_through(candidates: F64, curves: F64, heights: F64) -> TiltEstimate:
    """The line through the axes of the bands, as in `find_tilt`, from the mismatch [band, candidate].

    Raises:
        ValueError: there is no clear optimum.
    """
    step, farthest = float(candidates[1] - candidates[0]), float(np.abs(heights).max())
    most_steps = math.ceil(math.tan(STEEPEST) * farthest / step)
    curves = np.maximum(curves, _FLOOR)
    padded = np.pad(np.log(curves), ((0, 0), (most_steps, most_steps)), mode="edge")
    n, best, lowest = candidates.size, (0, 0), math.inf
    for slope in range(-most_steps, most_steps + 1):
        shifts = np.rint(slope * heights / farthest).astype(int) + most_steps
        total = sum(curve[shift : shift + n] for curve, shift in zip(padded, shifts, strict=True))
        index = int(np.argmin(total))
        if total[index] < lowest:
            best, lowest = (slope, index), float(total[index])
    slope, index = best
    typical = float(np.median(np.log(curves).sum(axis=0)))
    if abs(slope) == most_steps or not 0 < index < n - 1 or typical - lowest < _DEEP * heights.size:
        raise ValueError("no clear optimum")
    from scipy.interpolate import CubicSpline  # loading takes half a second

    splines = [CubicSpline(candidates, np.log(curve)) for curve in curves]
    all_bands, start = np.arange(heights.size), np.array([candidates[index], slope * step / farthest])
    line = _best_line(splines, heights, all_bands, start)
    variances = []
    for count in (heights.size, max(FEWEST_BANDS, heights.size // 3)):
        parts = np.array_split(all_bands, count)
        slopes = [_best_line(splines, heights, np.setdiff1d(all_bands, part), line)[1] for part in parts]
        variances.append((count - 1) * np.var(slopes))
    index = line[0] + line[1] * heights
    search_cols = np.clip(index[:, None] + np.linspace(-_OWN, _OWN, 20 * _OWN + 1), candidates[0], candidates[-1])
    own_deviations = np.array([x[np.argmin(spline(x))] for spline, x in zip(splines, search_cols, strict=True)]) - index
    scatter = (
        float(np.median(np.abs(own_deviations))) * _SIGMAS / math.sqrt(float(((heights - heights.mean()) ** 2).sum()))
    )
    uncertainty = math.hypot(math.sqrt(max(variances)), scatter)
    return TiltEstimate(math.atan(line[1]), uncertainty / (1 + line[1] ** 2), float(line[0]))


def _best_line(splines: list[CubicSpline], heights: F64, bands: NDArray[np.int64], start: F64) -> F64:
    """(axis at height 0, slope) with the smallest sum of log mismatches of some bands, near `start`."""
    from scipy.optimize import minimize

    def total(line: F64) -> float:
        return sum(float(splines[band](line[0] + line[1] * heights[band])) for band in bands)

    farthest = float(np.abs(heights).max())
    corners = start + np.array([[0, 0], [0.5, 0], [0, 0.5 / farthest]])
    return np.asarray(
        minimize(total, start, method="Nelder-Mead", options={"initial_simplex": corners, "xatol": 1e-5}).x
    )


def roll_of_mean_view(mean: F64, axis_col: float) -> tuple[float, float]:
    """The in-plane tilt of the axis from the mean projection of a 360° scan, and its standard deviation.

    The mean projection is that of a body of revolution. So its left and right halves are mirror images, in a cone beam
    and in a parallel beam. A tilt rotates the mean projection, and a wrong axis shifts it. A detector that is not
    perpendicular to the beam, or an intensity gradient, skews it. All of these effects are fitted to the difference of
    the halves. The standard deviation is from the jackknife over bands of rows.

    Args:
        mean: float64 [row, col], line integrals.
        axis_col: column about which the halves are compared. It may be wrong by a pixel or two.

    Returns:
        The tilt in radians, as `Geometry.roll`, and its standard deviation. NaN if the field of view does not contain
        both halves.
    """
    rows, cols = mean.shape
    reach = int(min(axis_col, cols - 1 - axis_col))
    if reach < FEWEST_COLS // 2 or rows < 2 * FEWEST_BANDS:
        return math.nan, math.nan
    across, heights = np.arange(-reach, reach + 1.0), np.arange(rows)[:, None] - (rows - 1) / 2
    centred = np.stack([np.interp(axis_col + across, np.arange(cols), row) for row in mean])
    even, odd = (centred + centred[:, ::-1]) / 2, (centred - centred[:, ::-1]) / 2
    row_gradient, col_gradient = np.gradient(even)
    skew_effect = across**2 * col_gradient + heights * across * row_gradient
    effects = np.stack(
        [
            across * row_gradient - heights * col_gradient,
            -col_gradient,
            skew_effect,
            across * even,
            across + 0 * heights,
        ]
    )
    bands = [np.s_[:, part] for part in np.array_split(np.arange(rows), 2 * FEWEST_BANDS)]
    sums_of_bands = [(effects[band].reshape(len(effects), -1), odd[band[1]].ravel()) for band in bands]
    normal, right = np.stack([p @ p.T for p, _ in sums_of_bands]), np.stack([p @ o for p, o in sums_of_bands])
    without_band = np.linalg.pinv(normal.sum(axis=0) - normal) @ (right.sum(axis=0) - right)[..., None]
    roll = float((np.linalg.pinv(normal.sum(axis=0)) @ right.sum(axis=0))[0])
    return roll, float(np.sqrt((len(bands) - 1) * without_band[:, 0, 0].var()))
