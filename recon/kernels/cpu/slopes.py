"""Slopes: a volume under a window along each axis, and the length of its gradient at some voxels (numba, threaded).

scipy's filters use one thread, and such a gradient would need nine passes over the volume.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from recon.base.arrays import I64
from recon.kernels.cpu.activation import F32, OPTIONS

_f = np.float32


@njit(**OPTIONS)
def windowed(x: F32, window: F32, out: F32) -> None:
    """out = x [z, y, x] averaged with the window along each axis.

    Beyond a face, the values at the face are repeated.
    """
    nz, ny, nx = x.shape
    r = window.size // 2
    for k in prange(nz):
        plane, line = np.zeros((ny, nx), np.float32), np.empty(nx + 2 * r, np.float32)
        for t in range(window.size):
            weight, other = window[t], x[min(max(k + t - r, 0), nz - 1)]
            for j in range(ny):
                row, source = plane[j], other[j]
                for i in range(nx):
                    row[i] += weight * source[i]
        for j in range(ny):
            middle, target = line[r : r + nx], out[k, j]
            middle[:] = _f(0)
            for t in range(window.size):
                weight, row = window[t], plane[min(max(j + t - r, 0), ny - 1)]
                for i in range(nx):
                    middle[i] += weight * row[i]
            line[:r], line[r + nx :] = middle[0], middle[nx - 1]
            target[:] = _f(0)
            for t in range(window.size):
                weight, row = window[t], line[t : t + nx]
                for i in range(nx):
                    target[i] += weight * row[i]


@njit(**OPTIONS)
def slopes_at(x: F32, voxels: I64, out: F32) -> None:
    """out [n] = half the length of the differences between both neighbours, for the voxels of x with these flat
    indices.

    At a face, the voxel itself is the neighbour on the other side.
    """
    nz, ny, nx = x.shape
    for n in prange(voxels.size):
        line, i = divmod(voxels[n], nx)
        k, j = divmod(line, ny)
        a = x[min(k + 1, nz - 1), j, i] - x[max(k - 1, 0), j, i]
        b = x[k, min(j + 1, ny - 1), i] - x[k, max(j - 1, 0), i]
        c = x[k, j, min(i + 1, nx - 1)] - x[k, j, max(i - 1, 0)]
        out[n] = _f(0.5) * math.sqrt(a * a + b * b + c * c)
