"""Displaced volumes: each voxel is interpolated at another position; with the transpose and the derivatives.

    (W x)(r) = x(r + u(r)),    trilinear, 0 beyond the volume

Volumes are [y, x, z], displacements u [3, y, x, z] in voxels along y, x and z.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from recon.kernels.cpu.activation import F32, OPTIONS

_f = np.float32
_LEAST_SLAB = 8  # planes of a slab of the transpose


@njit(inline="always")
def _corner(position, size):
    """The voxel below a position and the share of the voxel above.

    Positions more than one voxel outside have no share.
    """
    position = min(max(position, _f(-1)), _f(size))
    low = min(math.floor(position), size - 1)
    return low, position - _f(low)


@njit(inline="always")
def _within(position, size):
    return _f(1) if -1 < position < size else _f(0)


@njit(inline="always")
def _value(x, j, i, k):
    ny, nx, nz = x.shape
    if 0 <= j < ny and 0 <= i < nx and 0 <= k < nz:
        return x[j, i, k]
    return _f(0)


@njit(**OPTIONS)
def _pull(x: F32, u: F32, out: F32) -> None:
    ny, nx, nz = x.shape
    for j in prange(ny):
        for i in range(nx):
            for k in range(nz):
                j0, a = _corner(_f(j) + u[0, j, i, k], ny)
                i0, b = _corner(_f(i) + u[1, j, i, k], nx)
                k0, c = _corner(_f(k) + u[2, j, i, k], nz)
                total = _f(0)
                for dj in range(2):
                    for di in range(2):
                        share = (a if dj else 1 - a) * (b if di else 1 - b)
                        low = _value(x, j0 + dj, i0 + di, k0)
                        total += share * (low + c * (_value(x, j0 + dj, i0 + di, k0 + 1) - low))
                out[j, i, k] = total


def pull(x: F32, u: F32, out: F32) -> None:
    """W x, into `out`."""
    _pull(x, u, out)


@njit(inline="always")
def _add(out, j, i, k, value):
    ny, nx, nz = out.shape
    if 0 <= j < ny and 0 <= i < nx and 0 <= k < nz:
        out[j, i, k] += value


@njit(**OPTIONS)
def _push(y: F32, u: F32, slab: int, first: int, out: F32) -> None:
    """Adds the planes of every other slab. These slabs have no common plane, so the sums always have the same order."""
    ny, nx, nz = y.shape
    slabs = (ny + slab - 1) // slab
    for half in prange((slabs - first + 1) // 2):
        start = (2 * half + first) * slab
        for j in range(start, min(start + slab, ny)):
            for i in range(nx):
                for k in range(nz):
                    j0, a = _corner(_f(j) + u[0, j, i, k], ny)
                    i0, b = _corner(_f(i) + u[1, j, i, k], nx)
                    k0, c = _corner(_f(k) + u[2, j, i, k], nz)
                    value = y[j, i, k]
                    for dj in range(2):
                        for di in range(2):
                            share = (a if dj else 1 - a) * (b if di else 1 - b) * value
                            _add(out, j0 + dj, i0 + di, k0, share * (1 - c))
                            _add(out, j0 + dj, i0 + di, k0 + 1, share * c)


def push(y: F32, u: F32, out: F32) -> None:
    """Wᵀ y, into `out`; bit-identical for any number of threads."""
    out[...] = 0
    slab = max(_LEAST_SLAB, 2 * math.ceil(float(np.abs(u[0]).max(initial=0.0))) + 4)
    for first in (0, 1):
        _push(y, u, slab, first, out)


@njit(**OPTIONS)
def _slopes(x: F32, u: F32, out: F32) -> None:
    ny, nx, nz = x.shape
    for j in prange(ny):
        for i in range(nx):
            for k in range(nz):
                j0, a = _corner(_f(j) + u[0, j, i, k], ny)
                i0, b = _corner(_f(i) + u[1, j, i, k], nx)
                k0, c = _corner(_f(k) + u[2, j, i, k], nz)
                down, right, up = _f(0), _f(0), _f(0)
                for dj in range(2):
                    for di in range(2):
                        low, high = _value(x, j0 + dj, i0 + di, k0), _value(x, j0 + dj, i0 + di, k0 + 1)
                        value = low + c * (high - low)
                        down += (value if dj else -value) * (b if di else 1 - b)
                        right += (value if di else -value) * (a if dj else 1 - a)
                        up += (a if dj else 1 - a) * (b if di else 1 - b) * (high - low)
                out[0, j, i, k] = down * _within(_f(j) + u[0, j, i, k], ny)
                out[1, j, i, k] = right * _within(_f(i) + u[1, j, i, k], nx)
                out[2, j, i, k] = up * _within(_f(k) + u[2, j, i, k], nz)


def slopes(x: F32, u: F32, out: F32) -> None:
    """Derivatives of W x at each voxel with respect to its own u, into `out` [3, y, x, z]."""
    _slopes(x, u, out)
