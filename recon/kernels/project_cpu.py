"""Footprints to an image and an image's gradient to six moments a footprint, sixteen lanes wide (numba, threaded).

    pixel = Σ_i W_i G_i,   G = exp(-1/2 δᵀ K δ)        M₀ = Σ g G,   M₁ = Σ g G δ,   M₂ = Σ g G δδᵀ

with δ the offset in pixels and g the gradient of the image: every Gaussian gathers its own gradient, no atomics.
Images are summed over threads in a fixed order: the same bits come again with the same number of threads, the same but
for rounding with another.
"""

from __future__ import annotations

import math

import numpy as np
from numba import get_num_threads, njit, prange

from recon.kernels import lanes
from recon.kernels.activation import F32, OPTIONS
from recon.kernels.footprints_cpu import HU, HV, KV, SHEAR, K, U, V, W

_f = np.float32


@njit(inline="always", fastmath=True)
def _box(table, i, rows, cols):  # type: ignore[no-untyped-def]
    """Pixel box of footprint i, clipped to the image: (row0, row1, col0, col1), ends excluded; empty if it misses."""
    hu, hv = table[i, HU], table[i, HV]
    u, v = table[i, U], table[i, V]
    if not (hu >= 0 and u + hu >= 0 and u - hu <= cols - 1 and v + hv >= 0 and v - hv <= rows - 1):
        return 0, 0, 0, 0
    row0, row1 = max(0, math.ceil(v - hv)), min(rows, math.floor(v + hv) + 1)
    col0, col1 = max(0, math.ceil(u - hu)), min(cols, math.floor(u + hu) + 1)
    return row0, row1, col0, col1


@njit(**OPTIONS)
def _render(table: F32, rows: int, cols: int, layers: F32) -> None:
    n, threads = table.shape[0], layers.shape[0]
    share = (n + threads - 1) // threads
    for t in prange(threads):
        image = layers[t]
        image[:] = _f(0)
        for i in range(t * share, min(n, (t + 1) * share)):
            row0, row1, col0, col1 = _box(table, i, rows, cols)
            k, shear, kv, w = _f(-0.5) * table[i, K], table[i, SHEAR], _f(-0.5) * table[i, KV], table[i, W]
            for start in range(col0, col1, 16):
                dx = lanes.iota() + (_f(start) - table[i, U])
                for row in range(row0, row1):
                    dy = _f(row) - table[i, V]
                    across = dx - shear * dy
                    value = lanes.exp(across * across * k + kv * dy * dy) * w
                    lanes.store(image, row, start, lanes.load(image, row, start) + value)


@njit(**OPTIONS)
def _sum_layers(layers: F32, image: F32) -> None:
    for row in prange(image.shape[0]):
        for col in range(image.shape[1]):
            value = layers[0, row, col]
            for t in range(1, layers.shape[0]):
                value += layers[t, row, col]
            image[row, col] = value


def render(table: F32, image: F32) -> None:
    """Sum the footprints of `table` into image [row, col] (overwritten)."""
    rows, cols = image.shape
    # One private image a thread; rows are 16 pixels longer so that whole lanes may be written at the right edge.
    layers = np.empty((get_num_threads(), rows, cols + lanes.WIDTH), np.float32)
    _render(table, rows, cols, layers)
    _sum_layers(layers, image)


@njit(**OPTIONS)
def _moments(table: F32, gradient: F32, rows: int, cols: int, moments: F32) -> None:
    for i in prange(table.shape[0]):
        row0, row1, col0, col1 = _box(table, i, rows, cols)
        k, shear, kv = _f(-0.5) * table[i, K], table[i, SHEAR], _f(-0.5) * table[i, KV]
        m0 = mx = my = mxx = mxy = myy = _f(0)
        for start in range(col0, col1, 16):
            dx = lanes.iota() + (_f(start) - table[i, U])
            s0, s1, s2 = lanes.zero(), lanes.zero(), lanes.zero()
            for row in range(row0, row1):
                dy = _f(row) - table[i, V]
                across = dx - shear * dy
                value = lanes.load(gradient, row, start) * lanes.exp(across * across * k + kv * dy * dy)
                s0, s1, s2 = s0 + value, s1 + value * dy, s2 + value * (dy * dy)
            first = dx * s0
            m0 += lanes.total(s0)
            mx += lanes.total(first)
            my += lanes.total(s1)
            mxx += lanes.total(dx * first)
            mxy += lanes.total(dx * s1)
            myy += lanes.total(s2)
        moments[i, 0], moments[i, 1], moments[i, 2] = m0, mx, my
        moments[i, 3], moments[i, 4], moments[i, 5] = mxx, mxy, myy


def moments(table: F32, gradient: F32) -> F32:
    """Moments [n, 6] (1, u, v, uu, uv, vv) of the image gradient [row, col] under each footprint."""
    rows, cols = gradient.shape
    # Zeros to the right of the image: lanes that stick out weigh nothing.
    padded = np.zeros((rows, cols + lanes.WIDTH), np.float32)
    padded[:, :cols] = gradient
    result = np.empty((table.shape[0], 6), np.float32)
    _moments(table, padded, rows, cols, result)
    return result
