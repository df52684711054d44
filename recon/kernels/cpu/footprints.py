"""Footprints of Gaussians on the detector, and gradients back: exact for a parallel beam, affine for a cone (numba).

Consider a ray through the centre t = (tx, ty, tz) of a Gaussian, in the axes (u, v, d) of the projection with the
source at the origin. It meets the detector at (ax, ay) = (tx / tz, ty / tz) times the focal length f = sdd / pitch.
At that point the image moves by the local axes (px per mm, in the object's frame)

    Ju = g (u - ax d)        Jv = g (v - ay d)        g = f / tz        ray = ax u + ay v + d

and a parallel beam is the same with ax = ay = 0, g = 1 / pitch. With a = S RᵀJu, b = S RᵀJv, h = S⁻¹Rᵀ ray:

    Σ₂ = [[a·a, a·b], [a·b, b·b]]        det Σ₂ = |a x b|² = (s₁ s₂ s₃ g² |h|)²        μ = sqrt(2π) |ray| / |h|

μ is the central ray's integral sqrt(2π / r̂ᵀΣ⁻¹r̂), equal to the Schur complement's sqrt(2π (f - vᵀΣ₂⁻¹v)) but without
a subtraction. (3DGS's projection, Zwicker et al. 2001, with the factor of Zha et al. 2024). Backward, with the moments
M of the image gradient under a footprint, in its own directions τ and v (see `cpu.project`):

    ∂W = M₀,   ∂m = W (k M_τ, l M_v - k r M_τ),   ∂T = W (Σ g D yyᵀ + M₀ hhᵀ / h·h)      W = ρμ
    y = τ A + δv B,   A = (b x h) / (g s₁ s₂ s₃ h·h),   B = l b

y is the offset in the Gaussian's own axes, in standard deviations: y·y = δᵀKδ, A·A = k, B·B = l, A·B = 0. T's diagonal
is the gradient on log scales; off it, (s_k / s_j - s_j / s_k) T_jk turns axis j towards k. The gradient on rotations is
that rotation alone: all other components of a gradient on the matrix cancel in the quaternion, and for a needle they
are aspect² times as large. Gradients on Σ₂ = K⁻¹, as in 3DGS, lose aspect² in accuracy as well.

A cone adds the gradient on the centre through g, ax and ay. These are not clamped. 3DGS clamps them to keep Gaussians
far off the screen small; that breaks det Σ₂ and the gradient, and moves mass in a wide cone. A Gaussian at or behind
the source plane has no footprint.

The quadratic form is kept factored, δᵀKδ = k (δu - r δv)² + δv² / Σvv with k = Σvv / det Σ₂ and r = Σuv / Σvv. Sums of
squares stay accurate where the expanded form of a long thin footprint would cancel.

The error of the affine approximation is known to first order. The true ray integral differs from it by the factor
exp((β - α)·δ + δᵀKδ α·δ), with α, β as in `cpu.rays`; over the footprint that is a relative L2 error of

    ε² = 1/2 βᵀΣ₂β + αᵀΣ₂β + 3/2 αᵀΣ₂α + 6 η²

where η = 1 / |S⁻¹Rᵀt|² gives the leading term of second order, the only one on the optical axis.

A compact kernel (`recon.base.kernel`) has a factor other than sqrt(2π), moments of its own (`cpu.project`), its own end
in place of a truncation, and other numbers in ε: (β·δ G + (N D - G) α·δ)² in the mean over G², and (η N² D / 2)².
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.base.kernel import Kernel
from recon.kernels.cpu.activation import F32, OPTIONS

_f, _d = np.float32, np.float64
# Columns of the footprint table.
U, V, K, SHEAR, KV, W, HU, HV = range(8)
HIDDEN, INEXACT = -1.0, -2.0  # in HU and HV: not visible; to be integrated ray by ray
NEAREST = 0.01  # share of sod; Gaussians nearer to the plane of the source are hidden
_NEVER = 1e30  # an error that no affine footprint reaches (the arithmetic of the kernels has no infinities)


class RayCamera(NamedTuple):
    """One projection in the form that the kernels need.

    Attributes:
        axes: float32 [3, 3], unit vectors along columns, rows and beam.
        focal: for a cone sdd / pitch in px, for a parallel beam 1 / pitch in px/mm.
        sod: mm from the source to the rotation axis; 0: parallel beam.
        col, row: pixel of the object's origin.
        straight: True for a parallel beam without roll and tilt, which saves a third of the work.
        spread, travel: variance in px² along columns and rows, and arc in radians, that `cpu.wide_footprints` adds to
            footprints; 0: rays without a width.
    """

    axes: F32
    focal: float
    sod: float
    col: float
    row: float
    straight: bool
    spread: float = 0.0
    travel: float = 0.0

    @property
    def is_wide(self) -> bool:
        return self.spread > 0 or self.travel > 0


@njit(inline="always", fastmath=True)
def _rotated(x, y, z, r):
    """Rᵀ times a vector."""
    return x * r[0] + y * r[3] + z * r[6], x * r[1] + y * r[4] + z * r[7], x * r[2] + y * r[5] + z * r[8]


@njit(inline="always", fastmath=True)
def add_shape(i, scales, rotations, t00, t01, t02, t11, t12, t22, d_log_scales, d_rotations):
    """Add the gradients that follow from T, the gradient of a deformation in the Gaussian's own axes (see above)."""
    d_log_scales[i, 0] += t00
    d_log_scales[i, 1] += t11
    d_log_scales[i, 2] += t22
    s0, s1, s2, r = scales[i, 0], scales[i, 1], scales[i, 2], rotations[i]
    i0, i1, i2 = _f(1) / s0, _f(1) / s1, _f(1) / s2
    x, y, z = t01 * (s1 * i0 - s0 * i1), t02 * (s2 * i0 - s0 * i2), t12 * (s2 * i1 - s1 * i2)
    x, y, z = _f(0.5) * x, _f(0.5) * y, _f(0.5) * z
    for j in range(0, 9, 3):
        d_rotations[i, j] -= r[j + 1] * x + r[j + 2] * y
        d_rotations[i, j + 1] += r[j] * x - r[j + 2] * z
        d_rotations[i, j + 2] += r[j] * y + r[j + 1] * z


# `straight` is a constant of the compiled kernel, so its branches are removed; this fails for arguments of threaded
# loops.
def _forward(straight: bool) -> Any:
    @njit(**OPTIONS)
    def kernel(
        means: F32,
        scales: F32,
        rotations: F32,
        densities: F32,
        axes: F32,
        focal: float,
        sod: float,
        col: float,
        row: float,
        faint: float,
        cut: float,
        length: float,
        exact_above: float,
        unit: float,
        ends: bool,
        terms: tuple[float, float, float, float],
        table: F32,
    ) -> None:
        f, source, nearest = _f(focal), _f(sod), _f(NEAREST * sod)
        plain, judged, central = length > 0, exact_above < _NEVER, _f(unit)
        e0, e1, e2, e3 = _f(terms[0]), _f(terms[1]), _f(terms[2]), _f(terms[3])
        for i in prange(densities.shape[0]):
            u0, u1, u2 = axes[0, 0], axes[0, 1], axes[0, 2]
            v0, v1, v2 = axes[1, 0], axes[1, 1], axes[1, 2]
            d0, d1, d2 = axes[2, 0], axes[2, 1], axes[2, 2]
            if straight:
                u2 = v0 = v1 = d2 = _f(0)
                v2 = _f(1)
            x, y, z = means[i, 0], means[i, 1], means[i, 2]
            ax, ay, g, ray, depth = _f(0), _f(0), f, _f(1), _f(1)
            tu, tv = u0 * x + u1 * y + u2 * z, v0 * x + v1 * y + v2 * z
            if not straight and sod > 0:
                depth = source + (d0 * x + d1 * y + d2 * z)
                if depth <= nearest:
                    table[i, :] = _f(0)
                    table[i, HU] = table[i, HV] = _f(HIDDEN)
                    continue
                near = _f(1) / depth
                ax, ay, g = tu * near, tv * near, f * near
                ray = np.sqrt(_f(1) + ax * ax + ay * ay)
                tu, tv = ax, ay
            uu = uv = vv = hh = hu = hv = _f(0)  # products of a, b, h; of h with S⁻¹Rᵀu and S⁻¹Rᵀv
            for k in range(3):
                r0, r1, r2, s = rotations[i, k], rotations[i, 3 + k], rotations[i, 6 + k], scales[i, k]
                pu, pv, pd = u0 * r0 + u1 * r1 + u2 * r2, v0 * r0 + v1 * r1 + v2 * r2, d0 * r0 + d1 * r1 + d2 * r2
                a, b, sharp = s * (pu - ax * pd), s * (pv - ay * pd), _f(1) / s
                h = (ax * pu + ay * pv + pd) * sharp
                uu, uv, vv, hh = uu + a * a, uv + a * b, vv + b * b, hh + h * h
                hu, hv = hu + h * pu * sharp, hv + h * pv * sharp
            within = _f(1) / np.sqrt(hh)  # mm of the ray in one standard deviation
            # g / sqrt(det Σ₂); in float64, because a product of three scales of 1e-13 mm would leave the range of
            # float32.
            scale = _f(_d(within) / (_d(g) * (_d(scales[i, 0]) * _d(scales[i, 1]) * _d(scales[i, 2]))))
            table[i, U], table[i, V] = _f(col) + f * tu, _f(row) + f * tv
            # Squares of square roots, because products for a Gaussian of 1e-12 px would leave the range of float32.
            wide, high = np.sqrt(uu), np.sqrt(vv)
            steep, level = high * scale, _f(1) / (high * g)
            table[i, K], table[i, SHEAR], table[i, KV] = steep * steep, uv / vv, level * level
            weight = densities[i] * (_f(length) if plain else central * ray * within)
            table[i, W] = weight
            reach = _f(HIDDEN)
            if weight > _f(faint):
                reach = _f(cut) if ends else min(_f(cut), np.sqrt(_f(2) * np.log(weight / _f(faint))))
                reach *= g
                if not straight and sod > 0 and judged:
                    # α and β in px of the rotation axis' scale: f α, f β and Σ₂ / f².
                    au, av, bu, bv = hu / hh, hv / hh, ax / (ray * ray), ay / (ray * ray)
                    eta = _f(1) / (depth * depth * hh)
                    first = uu * (e0 * bu * bu + e1 * au * bu + e2 * au * au)
                    first += uv * (_f(2) * (e0 * bu * bv + e2 * au * av) + e1 * (au * bv + av * bu))
                    first += vv * (e0 * bv * bv + e1 * av * bv + e2 * av * av)
                    if first / (depth * depth) + e3 * eta * eta > _f(exact_above * exact_above):
                        table[i, HU] = table[i, HV] = _f(INEXACT)
                        continue
            table[i, HU], table[i, HV] = reach * wide, reach * high

    return kernel


def _backward(straight: bool) -> Any:
    @njit(**OPTIONS)
    def kernel(
        table: F32,
        moments: F32,
        means: F32,
        scales: F32,
        rotations: F32,
        densities: F32,
        axes: F32,
        focal: float,
        sod: float,
        length: float,
        unit: float,
        d_means: F32,
        d_log_scales: F32,
        d_rotations: F32,
        d_densities: F32,
        d_centres: F32,
    ) -> None:
        f, source, plain = _f(focal), _f(sod), length > 0
        # The view's axes are left-handed in this project; others would turn A around.
        turned = axes[0, 0] * (axes[1, 1] * axes[2, 2] - axes[1, 2] * axes[2, 1])
        turned -= axes[0, 1] * (axes[1, 0] * axes[2, 2] - axes[1, 2] * axes[2, 0])
        turned += axes[0, 2] * (axes[1, 0] * axes[2, 1] - axes[1, 1] * axes[2, 0])
        for i in prange(densities.shape[0]):
            u0, u1, u2 = axes[0, 0], axes[0, 1], axes[0, 2]
            v0, v1, v2 = axes[1, 0], axes[1, 1], axes[1, 2]
            d0, d1, d2 = axes[2, 0], axes[2, 1], axes[2, 2]
            if straight:
                u2 = v0 = v1 = d2 = _f(0)
                v2 = _f(1)
            if table[i, HU] < 0:
                d_centres[i, 0] = d_centres[i, 1] = _f(0)
                continue
            k, shear, kv, w = table[i, K], table[i, SHEAR], table[i, KV], table[i, W]
            m0, mt, mv = moments[i, 0], moments[i, 1], moments[i, 2]
            mtt, mtv, mvv = moments[i, 3], moments[i, 4], moments[i, 5]
            gu = w * k * mt
            gv = w * kv * mv - shear * gu
            d_centres[i, 0], d_centres[i, 1] = gu, gv
            ax, ay, g, rr, depth = _f(0), _f(0), f, _f(1), _f(1)
            if not straight and sod > 0:
                x, y, z = means[i, 0], means[i, 1], means[i, 2]
                depth = source + (d0 * x + d1 * y + d2 * z)
                ax, ay = (u0 * x + u1 * y + u2 * z) / depth, (v0 * x + v1 * y + v2 * z) / depth
                g, rr = f / depth, _f(1) + ax * ax + ay * ay
            r, s0, s1, s2 = rotations[i], scales[i, 0], scales[i, 1], scales[i, 2]
            pu0, pu1, pu2 = _rotated(u0, u1, u2, r)
            pv0, pv1, pv2 = _rotated(v0, v1, v2, r)
            pd0, pd1, pd2 = _rotated(d0, d1, d2, r)
            b0, b1, b2 = s0 * (pv0 - ay * pd0), s1 * (pv1 - ay * pd1), s2 * (pv2 - ay * pd2)
            i0, i1, i2 = _f(1) / s0, _f(1) / s1, _f(1) / s2
            h0, h1 = (ax * pu0 + ay * pv0 + pd0) * i0, (ax * pu1 + ay * pv1 + pd1) * i1
            h2 = (ax * pu2 + ay * pv2 + pd2) * i2
            hh = h0 * h0 + h1 * h1 + h2 * h2
            size, level = _f(_d(turned) / (_d(g) * (_d(s0) * _d(s1) * _d(s2)) * _d(hh))), kv * g
            a0, a1, a2 = size * (b1 * h2 - b2 * h1), size * (b2 * h0 - b0 * h2), size * (b0 * h1 - b1 * h0)
            b0, b1, b2 = level * b0, level * b1, level * b2
            d_densities[i] += m0 * (_f(length) if plain else _f(unit) * np.sqrt(rr / hh))
            pull = _f(0) if plain else m0 / hh
            # T / W = (τ A + δv B)(τ A + δv B)ᵀ + M₀ hhᵀ / h·h, as A cᵀ + B eᵀ + ...
            c0, c1, c2 = mtt * a0 + mtv * b0, mtt * a1 + mtv * b1, mtt * a2 + mtv * b2
            e0, e1, e2 = mtv * a0 + mvv * b0, mtv * a1 + mvv * b1, mtv * a2 + mvv * b2
            add_shape(
                i, scales, rotations,
                w * (a0 * c0 + b0 * e0 + pull * h0 * h0), w * (a0 * c1 + b0 * e1 + pull * h0 * h1),
                w * (a0 * c2 + b0 * e2 + pull * h0 * h2), w * (a1 * c1 + b1 * e1 + pull * h1 * h1),
                w * (a1 * c2 + b1 * e2 + pull * h1 * h2), w * (a2 * c2 + b2 * e2 + pull * h2 * h2),
                d_log_scales, d_rotations,
            )  # fmt: skip
            tu, tv, td = f * gu, f * gv, _f(0)
            if not straight and sod > 0:
                # ∂a = g W k Σ g G τ y and ∂b alike; a and b lose ax and ay times SRᵀd, h gains them times S⁻¹Rᵀ(u, v).
                pd0, pd1, pd2 = s0 * pd0, s1 * pd1, s2 * pd2
                far_t, far_v = c0 * pd0 + c1 * pd1 + c2 * pd2, e0 * pd0 + e1 * pd1 + e2 * pd2
                gax = -g * k * far_t
                gay = -g * (kv * far_v - k * shear * far_t)
                if not plain:  # μ grows with |ray|, and falls as h grows
                    gax += m0 * ax / rr - pull * (h0 * pu0 * i0 + h1 * pu1 * i1 + h2 * pu2 * i2)
                    gay += m0 * ay / rr - pull * (h0 * pv0 * i0 + h1 * pv1 * i1 + h2 * pv2 * i2)
                grow = w * (k * mtt + kv * mvv)
                tu, tv = (tu + w * gax) / depth, (tv + w * gay) / depth
                td = -(tu * ax + tv * ay + grow / depth)
            d_means[i, 0] += u0 * tu + v0 * tv + d0 * td
            d_means[i, 1] += u1 * tu + v1 * tv + d1 * td
            d_means[i, 2] += u2 * tu + v2 * tv + d2 * td

    return kernel


_footprints, _straight_footprints = _forward(False), _forward(True)
_footprints_backward, _straight_footprints_backward = _backward(False), _backward(True)


def footprints(
    means: F32,
    scales: F32,
    rotations: F32,
    densities: F32,
    camera: RayCamera,
    faint: float,
    cut: float,
    table: F32,
    *,
    length: float = 0.0,
    exact_above: float = math.inf,
    kernel: Kernel = Kernel.GAUSSIAN,
) -> None:
    """Fill table [n, 8]: centre (col, row), k (1/px²), r, 1 / Σvv (1/px²), weight W = ρμ, half widths in px (two).

    Footprints are cut off where they fall below `faint` (in units of the image). They are also cut off at `cut`
    standard deviations, those of a compact kernel at its end. Half widths are HIDDEN for a footprint nowhere above
    `faint`, and INEXACT where a cone's ε is above `exact_above`. A `length` (mm) other than 0 replaces μ: the
    uncorrected factor.
    """
    fill = _straight_footprints if camera.straight else _footprints
    fill(
        means, scales, rotations, densities, camera.axes, camera.focal, camera.sod, camera.col, camera.row, faint,
        kernel.reach(cut), length, min(exact_above, _NEVER), kernel.length, kernel.is_compact, kernel.affine_terms,
        table,
    )  # fmt: skip


def footprints_backward(
    table: F32,
    moments: F32,
    means: F32,
    scales: F32,
    rotations: F32,
    densities: F32,
    camera: RayCamera,
    d_means: F32,
    d_log_scales: F32,
    d_rotations: F32,
    d_densities: F32,
    d_centres: F32,
    *,
    length: float = 0.0,
    kernel: Kernel = Kernel.GAUSSIAN,
) -> None:
    """Add to the gradients on means, log scales, rotations, densities; d_centres [n, 2]: ∂/∂(col, row) in 1/px."""
    add = _straight_footprints_backward if camera.straight else _footprints_backward
    add(
        table, moments, means, scales, rotations, densities, camera.axes, camera.focal, camera.sod, length,
        kernel.length, d_means, d_log_scales, d_rotations, d_densities, d_centres,
    )  # fmt: skip


def footprint_table(n: int) -> NDArray[np.float32]:
    """An uninitialised table of n footprints, float32 [n, 8]."""
    return np.empty((n, 8), np.float32)
