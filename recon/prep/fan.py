"""The fan angle of the rays, measured from a 360° scan, in which each ray is measured from both sides."""

from __future__ import annotations

import math

import numpy as np

from recon.base.arrays import F64

_WIDEST, _STEP = 0.5, 0.01  # radians from the central ray to the edge of the detector: largest value, and step
_COLS = 256  # with more columns, they are binned


def fans_shown(sinogram: F64, angles: F64, axis_col: float, slope: float) -> tuple[float, float, float, float]:
    """How much the two measurements of each ray (one from each side) disagree: for the stated fan angle, and for the
    best one.

    The ray at γ in the projection at β is the ray at -γ in the projection at β + π - 2γ, with tan γ = slope x columns
    from the axis.

    Args:
        sinogram: [view, col] of one row in the plane of the source, in any order; the projections cover 360°.
        slope: pixel pitch of the detector divided by its distance from the source; 0: parallel rays.

    Returns:
        The mean square of the differences divided by twice the variance: for the stated slope, for the best slope, and
        the median over all slopes. 0: perfect agreement, 1: no agreement. The fourth value is the best slope.
    """
    order = np.argsort(np.mod(angles, 2 * math.pi), kind="stable")
    factor = math.ceil(sinogram.shape[1] / _COLS)
    cols = sinogram.shape[1] // factor
    rows = sinogram[order, : cols * factor].reshape(order.size, cols, factor).mean(axis=2)
    beta, u = np.mod(angles[order], 2 * math.pi), (np.arange(cols) + 0.5) * factor - 0.5 - axis_col
    seen_from_both_sides = np.abs(u) <= min(-u[0], u[-1])
    u, rows = u[seen_from_both_sides], rows[:, seen_from_both_sides]
    mirrored = np.stack([np.interp(-u, u, row) for row in rows])

    def disagreement(slope: float) -> float:
        turns = math.pi - 2 * np.arctan(slope * u)
        opposite_rays = [
            np.interp(beta + turn, beta, row, period=2 * math.pi) for turn, row in zip(turns, mirrored.T, strict=True)
        ]
        return float(np.square(rows - np.stack(opposite_rays, axis=1)).mean() / (2 * rows.var()))

    slopes = np.tan(np.arange(0, _WIDEST, _STEP)) / u[-1]
    mismatches = [disagreement(each) for each in slopes]
    return disagreement(slope), min(mismatches), float(np.median(mismatches)), float(slopes[int(np.argmin(mismatches))])
