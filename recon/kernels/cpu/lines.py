"""Lines along z, the memory layout of the voxel projectors: transposition, and interpolation of rows between slices."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from recon.kernels.cpu.activation import F32, OPTIONS
from recon.kernels.cpu.joseph import F64

_f = np.float32
_TILE = 32


@njit(**OPTIONS)
def swap_last(source: F32, out: F32) -> None:
    """out [n, j, i] = source [n, i, j], tile by tile."""
    stacks, rows, cols = source.shape
    down, across = (rows + _TILE - 1) // _TILE, (cols + _TILE - 1) // _TILE
    for job in prange(stacks * down):
        n, i0 = job // down, job % down * _TILE
        i1 = min(rows, i0 + _TILE)
        for tile in range(across):
            j0 = tile * _TILE
            for j in range(j0, min(cols, j0 + _TILE)):
                for i in range(i0, i1):
                    out[n, j, i] = source[n, i, j]


@njit(**OPTIONS)
def rows_from_slices(slices: F32, first: F64, step: float, out: F32) -> None:
    """out [view, col, row]: slices [view, col, z] interpolated at level first[view] + step * row.

    Beyond the last slice the value falls linearly to zero within one slice, as beyond the last voxel in the plane.
    """
    views, cols, nz = slices.shape
    rows = out.shape[2]
    for job in prange(views * cols):
        v, col = job // cols, job % cols
        for row in range(rows):
            level = first[v] + step * row
            value = _f(0)
            if level > -1.0 and level < nz:
                low = math.floor(level)
                part = _f(level - low)
                if low >= 0:
                    value += (_f(1) - part) * slices[v, col, low]
                if low + 1 < nz:
                    value += part * slices[v, col, low + 1]
            out[v, col, row] = value


@njit(**OPTIONS)
def slices_from_rows(rows: F32, first: F64, step: float, out: F32) -> None:
    """The transpose of `rows_from_slices`: rows [view, col, row] into out [view, col, z] (overwritten)."""
    views, cols, n = rows.shape
    nz = out.shape[2]
    for job in prange(views * cols):
        v, col = job // cols, job % cols
        out[v, col] = _f(0)
        for row in range(n):
            level = first[v] + step * row
            if level > -1.0 and level < nz:
                low = math.floor(level)
                part = _f(level - low)
                if low >= 0:
                    out[v, col, low] += (_f(1) - part) * rows[v, col, row]
                if low + 1 < nz:
                    out[v, col, low + 1] += part * rows[v, col, row]
