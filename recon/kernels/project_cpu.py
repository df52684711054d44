"""Parallel-beam projection of Gaussians on the CPU: exact footprints, sixteen lanes wide, six-moment backward.

For a view with axes u, v and ray d, and the columns of R S written as a = S Rᵀu, b = S Rᵀv, h = S⁻¹ Rᵀd:

    Σ₂ = [[a·a, a·b], [a·b, b·b]]        det Σ₂ = |a x b|² = (s₁ s₂ s₃ |h|)²        μ = sqrt(2π) / |h|

μ is the central ray's integral sqrt(2π / dᵀΣ⁻¹d), equal to the Schur complement's sqrt(2π (f - vᵀΣ₂⁻¹v)) but free of
any subtraction. The backward pass needs, per Gaussian, only the moments M₀ = Σ g G, M₁ = Σ g G δ, M₂ = Σ g G δδᵀ over
its footprint (g the gradient of the image, G the unit footprint, δ the offset in pixels):

    ∂W = M₀,   ∂m = W K M₁,   ∂Σ₂ = 1/2 W K M₂ K         with W = ρμ, K = Σ₂⁻¹

so every Gaussian gathers its own gradient: no atomics. Images are summed over threads in a fixed order: the same bits
come again with the same number of threads, the same but for rounding with another.
"""

from __future__ import annotations

import math

import numpy as np
from numba import get_num_threads, njit, prange
from numpy.typing import NDArray

from recon.kernels import lanes
from recon.kernels.activation import F32, OPTIONS

_f = np.float32
_ROOT_TWO_PI = np.float32(math.sqrt(2 * math.pi))
# Columns of the footprint table.
_U, _V, _KA, _KB, _KC, _W, _HU, _HV = range(8)


@njit(**OPTIONS)
def footprints(
    means: F32,
    scales: F32,
    rotations: F32,
    densities: F32,
    cos: float,
    sin: float,
    per_mm: float,
    axis_col: float,
    mid_row: float,
    faint: float,
    cut: float,
    table: F32,
) -> None:
    """Fill table [n, 8]: centre (col, row), inverse covariance (1/px², three), weight W = ρμ, half widths in px (two).

    A footprint ends where it falls below `faint` (in units of the image) and at the latest after `cut` standard
    deviations; half widths are negative where nothing of it is above `faint`.
    """
    c, s, per = _f(cos), _f(sin), _f(per_mm)
    for i in prange(densities.shape[0]):
        r, sc = rotations[i], scales[i]
        x, y, z = means[i, 0], means[i, 1], means[i, 2]
        a0, a1, a2 = sc[0] * (c * r[0] + s * r[3]), sc[1] * (c * r[1] + s * r[4]), sc[2] * (c * r[2] + s * r[5])
        b0, b1, b2 = sc[0] * r[6], sc[1] * r[7], sc[2] * r[8]
        h0, h1, h2 = (c * r[3] - s * r[0]) / sc[0], (c * r[4] - s * r[1]) / sc[1], (c * r[5] - s * r[2]) / sc[2]
        length = np.sqrt(h0 * h0 + h1 * h1 + h2 * h2)
        uu, uv, vv = a0 * a0 + a1 * a1 + a2 * a2, a0 * b0 + a1 * b1 + a2 * b2, b0 * b0 + b1 * b1 + b2 * b2
        root = sc[0] * sc[1] * sc[2] * length  # sqrt(det Σ₂), mm²
        scale = _f(1) / (per * root)
        table[i, _KA], table[i, _KB], table[i, _KC] = vv * scale * scale, -uv * scale * scale, uu * scale * scale
        weight = densities[i] * _ROOT_TWO_PI / length
        table[i, _U] = _f(axis_col) + per * (c * x + s * y)
        table[i, _V] = _f(mid_row) + per * z
        table[i, _W] = weight
        reach = _f(-1)
        if weight > _f(faint):
            reach = min(_f(cut), np.sqrt(_f(2) * np.log(weight / _f(faint)))) * per
        table[i, _HU], table[i, _HV] = reach * np.sqrt(uu), reach * np.sqrt(vv)


@njit(inline="always", fastmath=True)
def _box(table, i, rows, cols):  # type: ignore[no-untyped-def]
    """Pixel box of footprint i, clipped to the image: (row0, row1, col0, col1), ends excluded; empty if it misses."""
    hu, hv = table[i, _HU], table[i, _HV]
    u, v = table[i, _U], table[i, _V]
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
            a, b, c, w = _f(-0.5) * table[i, _KA], -table[i, _KB], _f(-0.5) * table[i, _KC], table[i, _W]
            for start in range(col0, col1, 16):
                dx = lanes.iota() + (_f(start) - table[i, _U])
                adx, bdx = dx * dx * a, dx * b
                for row in range(row0, row1):
                    dy = _f(row) - table[i, _V]
                    value = lanes.exp(adx + bdx * dy + c * dy * dy) * w
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
        a, b, c = _f(-0.5) * table[i, _KA], -table[i, _KB], _f(-0.5) * table[i, _KC]
        m0 = mx = my = mxx = mxy = myy = _f(0)
        for start in range(col0, col1, 16):
            dx = lanes.iota() + (_f(start) - table[i, _U])
            adx, bdx = dx * dx * a, dx * b
            s0, s1, s2 = lanes.zero(), lanes.zero(), lanes.zero()
            for row in range(row0, row1):
                dy = _f(row) - table[i, _V]
                value = lanes.load(gradient, row, start) * lanes.exp(adx + bdx * dy + c * dy * dy)
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


@njit(**OPTIONS)
def footprints_backward(
    table: F32,
    moments: F32,
    scales: F32,
    rotations: F32,
    densities: F32,
    cos: float,
    sin: float,
    per_mm: float,
    d_means: F32,
    d_log_scales: F32,
    d_rotations: F32,
    d_densities: F32,
    d_centres: F32,
) -> None:
    """Add to the gradients on means, log scales, rotations, densities; d_centres [n, 2] gets ∂/∂(col, row) in 1/px."""
    c, s, per = _f(cos), _f(sin), _f(per_mm)
    for i in prange(densities.shape[0]):
        if table[i, _HU] < 0:
            d_centres[i, 0] = d_centres[i, 1] = _f(0)
            continue
        m0, mx, my = moments[i, 0], moments[i, 1], moments[i, 2]
        mxx, mxy, myy = moments[i, 3], moments[i, 4], moments[i, 5]
        ka, kb, kc, w = table[i, _KA], table[i, _KB], table[i, _KC], table[i, _W]
        gu, gv = w * (ka * mx + kb * my), w * (kb * mx + kc * my)
        d_centres[i, 0], d_centres[i, 1] = gu, gv
        d_means[i, 0] += per * c * gu
        d_means[i, 1] += per * s * gu
        d_means[i, 2] += per * gv
        # P = K M₂, then ∂Σ₂ = 1/2 W P K; per² takes it from 1/px² to 1/mm².
        p00, p01 = ka * mxx + kb * mxy, ka * mxy + kb * myy
        p10, p11 = kb * mxx + kc * mxy, kb * mxy + kc * myy
        half = _f(0.5) * w * per * per
        guu, guv, gvv = half * (p00 * ka + p01 * kb), half * (p00 * kb + p01 * kc), half * (p10 * kb + p11 * kc)

        r, sc = rotations[i], scales[i]
        h0, h1, h2 = (c * r[3] - s * r[0]) / sc[0], (c * r[4] - s * r[1]) / sc[1], (c * r[5] - s * r[2]) / sc[2]
        length2 = h0 * h0 + h1 * h1 + h2 * h2
        d_densities[i] += m0 * _ROOT_TWO_PI / np.sqrt(length2)
        pull = -w * m0 / length2  # ∂L/∂h = -W M₀ h / |h|²
        for k in range(3):
            ru, rv, rd = c * r[k] + s * r[3 + k], r[6 + k], c * r[3 + k] - s * r[k]
            a, b, h = sc[k] * ru, sc[k] * rv, rd / sc[k]
            ga, gb, gh = _f(2) * (guu * a + guv * b), _f(2) * (guv * a + gvv * b), pull * h
            d_log_scales[i, k] += ga * a + gb * b - gh * h
            gru, grv, grd = ga * sc[k], gb * sc[k], gh / sc[k]
            d_rotations[i, k] += c * gru - s * grd
            d_rotations[i, 3 + k] += s * gru + c * grd
            d_rotations[i, 6 + k] += grv


def footprint_table(n: int) -> NDArray[np.float32]:
    """Room for n footprints."""
    return np.empty((n, 8), np.float32)
