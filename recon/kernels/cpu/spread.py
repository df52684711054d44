"""spread: blurs or sharpens projections along columns and rows; it is its own transpose (numba, threaded)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.kernels.cpu.activation import F32, OPTIONS

_f = np.float32
_MOST = 0.4  # px² of one pass; above 0.5 the finest detail would change its sign


@njit(**OPTIONS)
def _pass(lines: F32, shares: F32, out: F32) -> None:
    views, cols, rows = lines.shape
    for job in prange(views * cols):
        v, c = job // cols, job % cols
        a, b = shares[v, 0], shares[v, 1]
        left, here, right, to = lines[v, max(c - 1, 0)], lines[v, c], lines[v, min(c + 1, cols - 1)], out[v, c]
        if b == 0:
            for k in range(rows):
                to[k] = here[k] + a * (left[k] + right[k] - _f(2) * here[k])
            continue
        up = here[0] + a * (left[0] + right[0] - _f(2) * here[0])
        middle = up
        for k in range(rows):
            j = min(k + 1, rows - 1)
            down = here[j] + a * (left[j] + right[j] - _f(2) * here[j])
            to[k] = middle + b * (up + down - _f(2) * middle)
            up, middle = middle, down


def passes_of(*variances: NDArray[np.float64]) -> int:
    """Number of passes of `spread` for these variances. Each pass keeps 1 - variance / passes (1 - cos 2πf) at f."""
    return math.ceil(max(float(np.abs(each).max()) for each in variances) / _MOST)


def spread(lines: F32, along_cols: NDArray[np.float64], along_rows: NDArray[np.float64]) -> F32:
    """The lines [view, col, row] after passes over three neighbours, with these variances [view] in px².

    A variance below zero sharpens the projections by 1 - variance (1 - cos 2πf) at f cycles per pixel. Beyond an edge,
    the pixel at the edge is repeated. The matrix is symmetric.
    """
    passes = passes_of(along_cols, along_rows)
    if passes == 0:
        return lines
    shares = np.empty((len(lines), 2), np.float32)
    shares[:, 0], shares[:, 1] = along_cols / (2 * passes), along_rows / (2 * passes)
    found, other = lines, np.empty_like(lines)
    for n in range(passes):
        _pass(found, shares, other)
        found, other = other, (np.empty_like(lines) if n == 0 and passes > 1 else found)
    return found
