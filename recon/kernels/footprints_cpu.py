"""Gaussians to footprints on the detector and gradients back, exact for a parallel beam (numba, threaded).

For a view with axes u, v and ray d, and the columns of R S written as a = S Rᵀu, b = S Rᵀv, h = S⁻¹ Rᵀd:

    Σ₂ = [[a·a, a·b], [a·b, b·b]]        det Σ₂ = |a x b|² = (s₁ s₂ s₃ |h|)²        μ = sqrt(2π) / |h|

μ is the central ray's integral sqrt(2π / dᵀΣ⁻¹d), equal to the Schur complement's sqrt(2π (f - vᵀΣ₂⁻¹v)) but free of
any subtraction. Backward, with the moments M of the image gradient under a footprint (see `project_cpu`):

    ∂W = M₀,   ∂m = W K M₁,   ∂Σ₂ = 1/2 W K M₂ K         with W = ρμ, K = Σ₂⁻¹

The quadratic form is kept factored, δᵀKδ = k (δu - r δv)² + δv² / Σvv with k = Σvv / det Σ₂ and r = Σuv / Σvv: sums
of squares keep their digits where the expanded form of a long thin footprint would cancel.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.kernels.activation import F32, OPTIONS

_f = np.float32
_ROOT_TWO_PI = np.float32(math.sqrt(2 * math.pi))
# Columns of the footprint table.
U, V, K, SHEAR, KV, W, HU, HV = range(8)


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
    """Fill table [n, 8]: centre (col, row), k (1/px²), r, 1 / Σvv (1/px²), weight W = ρμ, half widths in px (two).

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
        table[i, K], table[i, SHEAR], table[i, KV] = vv * scale * scale, uv / vv, _f(1) / (vv * per * per)
        weight = densities[i] * _ROOT_TWO_PI / length
        table[i, U] = _f(axis_col) + per * (c * x + s * y)
        table[i, V] = _f(mid_row) + per * z
        table[i, W] = weight
        reach = _f(-1)
        if weight > _f(faint):
            reach = min(_f(cut), np.sqrt(_f(2) * np.log(weight / _f(faint)))) * per
        table[i, HU], table[i, HV] = reach * np.sqrt(uu), reach * np.sqrt(vv)


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
        if table[i, HU] < 0:
            d_centres[i, 0] = d_centres[i, 1] = _f(0)
            continue
        m0, mx, my = moments[i, 0], moments[i, 1], moments[i, 2]
        mxx, mxy, myy = moments[i, 3], moments[i, 4], moments[i, 5]
        ka, shear, w = table[i, K], table[i, SHEAR], table[i, W]
        kb, kc = -ka * shear, table[i, KV] + ka * shear * shear
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
