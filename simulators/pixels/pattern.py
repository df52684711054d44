"""Pattern: fixed differences between the sensor's pixels: a hash of (effect, seed, row, column).

Only the pixels of the frame are computed; they are the same for any ROI and binning.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.orca_quest import SENSOR_SHAPE
from recon.base.jit import njit
from simulators.frame.shot import Image, Shot, fixed_rng
from simulators.pixels.bands import share_rows
from simulators.pixels.streams import STEP, begin, mix, normal


@njit(cache=True, nogil=True)
def _normal_rows(key, first, end, row0, col0, out):  # pragma: no cover
    for row in range(first, end):
        of_row = begin(key, row0 + row)
        for col in range(out.shape[1]):
            out[row, col], _ = normal(mix(of_row + np.uint64(col0 + col) * STEP))


def normals(effect: str, seed: int, shot: Shot) -> Image:
    """A normal number (mean 0, variance 1) of each sensor pixel of the ROI, float64 [row, col], unbinned."""
    row0, col0, rows, cols = shot.roi
    key, out = fixed_rng(effect, seed).integers(2**64, dtype=np.uint64), np.empty((rows, cols))
    share_rows(lambda first, end: _normal_rows(key, first, end, row0, col0, out), out.shape)
    return out


def binned(pixels: Image, binning: int) -> Image:
    """Sums over binning x binning sensor pixels."""
    if binning == 1:
        return pixels
    rows, cols = (n // binning for n in pixels.shape)
    return pixels.reshape(rows, binning, cols, binning).sum(axis=(1, 3))


def places(
    effect: str, seed: int, fraction: float, shot: Shot
) -> tuple[tuple[NDArray[np.int64], NDArray[np.int64]], NDArray[np.float64]]:
    """Random sensor pixels, a `fraction` of all, as far as they are in the frame.

    Returns:
        Their (rows, columns) in the frame, and for each a uniform number in 0 ... 1. A binned pixel occurs as often
        as it contains such pixels.
    """
    rng = fixed_rng(effect, seed)
    n = round(fraction * SENSOR_SHAPE[0] * SENSOR_SHAPE[1])
    drawn, first = np.unique(rng.integers(SENSOR_SHAPE[0] * SENSOR_SHAPE[1], size=n), return_index=True)
    value = rng.random(n)[first]
    rows, cols = np.divmod(drawn, SENSOR_SHAPE[1])
    row0, col0, height, width = shot.roi
    inside = (rows >= row0) & (rows < row0 + height) & (cols >= col0) & (cols < col0 + width)
    return ((rows[inside] - row0) // shot.binning, (cols[inside] - col0) // shot.binning), value[inside]
