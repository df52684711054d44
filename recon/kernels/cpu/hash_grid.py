"""Multiresolution hash grid: features of points from tables, and the transpose (numba, threaded).

Level l has cubes of 1 / (sides[l] - 2) of the unit box, and features at their corners, which are interpolated
trilinearly. A level whose corners exceed the table shares entries by a hash (Müller et al. 2022, ACM Trans. Graph. 41,
102, eq. 4).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.kernels.cpu.activation import F32, OPTIONS

I64 = NDArray[np.int64]
PRIMES = 1, 19349663, 83492791
_f = np.float32
_TASK = 512  # points


@njit(inline="always")
def _entry(x, y, z, side, size):
    """Entry of a corner within its level; `size` is a power of two where corners share entries."""
    if side * side * side <= size:
        return x + side * (y + side * z)
    return (x ^ (y * 19349663) ^ (z * 83492791)) & (size - 1)


@njit(inline="always", fastmath=True)
def _place(points, i, side):
    """First corner of the point's cube, and its place within it."""
    scale = _f(side - 2)
    px, py, pz = points[i, 0] * scale + _f(0.5), points[i, 1] * scale + _f(0.5), points[i, 2] * scale + _f(0.5)
    x, y, z = math.floor(px), math.floor(py), math.floor(pz)
    return x, y, z, px - _f(x), py - _f(y), pz - _f(z)


@njit(**OPTIONS)
def gather(points: F32, table: F32, sides: I64, firsts: I64, out: F32) -> None:
    """Fill out [n, levels * features] with the features of points [n, 3] in 0..1.

    Args:
        table: [entries, features], level after level.
        sides: corners along each edge, by level.
        firsts: first entry of each level, and the end [levels + 1].
    """
    n, features = points.shape[0], table.shape[1]
    for task in prange((n + _TASK - 1) // _TASK):
        for i in range(task * _TASK, min(n, (task + 1) * _TASK)):
            for level in range(sides.shape[0]):
                side, first, size = sides[level], firsts[level], firsts[level + 1] - firsts[level]
                x, y, z, fx, fy, fz = _place(points, i, side)
                for f in range(features):
                    out[i, level * features + f] = _f(0)
                for corner in range(8):
                    a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
                    weight = (fx if a else _f(1) - fx) * (fy if b else _f(1) - fy) * (fz if c else _f(1) - fz)
                    entry = first + _entry(x + a, y + b, z + c, side, size)
                    for f in range(features):
                        out[i, level * features + f] += weight * table[entry, f]


@njit(**OPTIONS)
def scatter(points: F32, slopes: F32, sides: I64, firsts: I64, table: F32) -> None:
    """Add the transpose of `gather`, of slopes [n, levels * features], to table [entries, features].

    One thread owns a level, so that sums have the same order with any number of threads.
    """
    features = table.shape[1]
    for level in prange(sides.shape[0]):
        side, first, size = sides[level], firsts[level], firsts[level + 1] - firsts[level]
        for i in range(points.shape[0]):
            x, y, z, fx, fy, fz = _place(points, i, side)
            for corner in range(8):
                a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
                weight = (fx if a else _f(1) - fx) * (fy if b else _f(1) - fy) * (fz if c else _f(1) - fz)
                entry = first + _entry(x + a, y + b, z + c, side, size)
                for f in range(features):
                    table[entry, f] += weight * slopes[i, level * features + f]
