"""The fan of rays that views of a full turn show: each ray is measured again, from the other side."""

from __future__ import annotations

import math

import numpy as np

from recon.base.arrays import F64

_WIDEST, _STEP = 0.5, 0.01  # radians from the beam's axis to the edge of the detector
_COLS = 256  # of more, columns are binned


def fans_shown(sinogram: F64, angles: F64, axis_col: float, slope: float) -> tuple[float, float, float, float]:
    """How ill measurements of a ray from both sides agree, with the fan that is stated, and with the best one.

    The ray at γ in the view β is the ray at -γ in the view β + π - 2γ, with tan γ = slope x columns from the axis.

    Args:
        sinogram: [view, col] of one row in the plane of the source, in any order; views cover the circle.
        slope: pitch of the detector over its distance from the source; 0: parallel rays.

    Returns:
        Mean square of the differences over twice the variance, as stated, at best, and the median over slopes: 0 where
        they agree, 1 where they have nothing in common. And the best slope.
    """
    order = np.argsort(np.mod(angles, 2 * math.pi), kind="stable")
    factor = math.ceil(sinogram.shape[1] / _COLS)
    cols = sinogram.shape[1] // factor
    rows = sinogram[order, : cols * factor].reshape(order.size, cols, factor).mean(axis=2)
    beta, u = np.mod(angles[order], 2 * math.pi), (np.arange(cols) + 0.5) * factor - 0.5 - axis_col
    seen = np.abs(u) <= min(-u[0], u[-1])
    u, rows = u[seen], rows[:, seen]
    mirrored = np.stack([np.interp(-u, u, row) for row in rows])

    def disagreement(slope: float) -> float:
        turns = math.pi - 2 * np.arctan(slope * u)
        there = [
            np.interp(beta + turn, beta, row, period=2 * math.pi) for turn, row in zip(turns, mirrored.T, strict=True)
        ]
        return float(np.square(rows - np.stack(there, axis=1)).mean() / (2 * rows.var()))

    slopes = np.tan(np.arange(0, _WIDEST, _STEP)) / u[-1]
    found = [disagreement(each) for each in slopes]
    return disagreement(slope), min(found), float(np.median(found)), float(slopes[int(np.argmin(found))])
