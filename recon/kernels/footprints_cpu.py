"""Gaussians to footprints on the detector and gradients back: exact for a parallel beam, affine for a cone (numba).

A ray through the centre t = (tx, ty, tz) of a Gaussian, in the axes (u, v, d) of the view with the source at the
origin, meets the detector at (ax, ay) = (tx / tz, ty / tz) times the focal length f = sdd / pitch. There the picture
moves by the local axes (px per mm, in the object's frame)

    Ju = g (u - ax d)        Jv = g (v - ay d)        g = f / tz        ray = ax u + ay v + d

and a parallel beam is the same with ax = ay = 0, g = 1 / pitch. With a = S RᵀJu, b = S RᵀJv, h = S⁻¹Rᵀ ray:

    Σ₂ = [[a·a, a·b], [a·b, b·b]]        det Σ₂ = |a x b|² = (s₁ s₂ s₃ g² |h|)²        μ = sqrt(2π) |ray| / |h|

μ is the central ray's integral sqrt(2π / r̂ᵀΣ⁻¹r̂), equal to the Schur complement's sqrt(2π (f - vᵀΣ₂⁻¹v)) but free of
any subtraction (3DGS's projection, Zwicker et al. 2001, with the factor of Zha et al. 2024). Backward, with the
moments M of the image gradient under a footprint (see `project_cpu`):

    ∂W = M₀,   ∂m = W K M₁,   ∂Σ₂ = 1/2 W K M₂ K         with W = ρμ, K = Σ₂⁻¹

and for a cone through g, ax and ay to the centre. ax and ay are not clamped, as 3DGS does to keep far off-screen
Gaussians small: the clamp breaks det Σ₂ and the gradient, and moves mass where a cone is wide. A Gaussian at or behind
the source plane has no footprint.

The quadratic form is kept factored, δᵀKδ = k (δu - r δv)² + δv² / Σvv with k = Σvv / det Σ₂ and r = Σuv / Σvv: sums
of squares keep their digits where the expanded form of a long thin footprint would cancel.

The affine picture's own error is known to first order. The true ray integral differs from it by the factor
exp((β - α)·δ + δᵀKδ α·δ), with α, β as in `rays_cpu`; over the footprint that is a relative L2 error of

    ε² = 1/2 βᵀΣ₂β + αᵀΣ₂β + 3/2 αᵀΣ₂α + 6 η²

where η = 1 / |S⁻¹Rᵀt|² gives the leading term of second order, all there is on the axis.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.kernels.activation import F32, OPTIONS

_f = np.float32
_ROOT_TWO_PI = np.float32(math.sqrt(2 * math.pi))
# Columns of the footprint table.
U, V, K, SHEAR, KV, W, HU, HV = range(8)
HIDDEN, INEXACT = -1.0, -2.0  # in HU and HV: nothing to be seen; to be done ray by ray
NEAREST = 0.01  # of sod: what lies nearer to the source plane is not seen
_NEVER = 1e30  # an error that no affine footprint reaches (the kernels' arithmetic has no infinities)


class Camera(NamedTuple):
    """One view as the kernels take it.

    Attributes:
        axes: float32 [3, 3], unit vectors along columns, rows and beam.
        focal: a cone: sdd / pitch in px; a parallel beam: 1 / pitch in px/mm.
        sod: mm from the source to the rotation axis; 0 stands for a parallel beam.
        col, row: pixel of the object's origin.
        straight: a parallel beam with columns along z, which saves a third of the work.
    """

    axes: F32
    focal: float
    sod: float
    col: float
    row: float
    straight: bool


# What is fixed when a kernel is compiled (here: straight) folds into its loop; an argument of a threaded loop does not.
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
        table: F32,
    ) -> None:
        f, source, nearest = _f(focal), _f(sod), _f(NEAREST * sod)
        plain, judged = length > 0, exact_above < _NEVER
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
            scale = within / (g * (scales[i, 0] * scales[i, 1] * scales[i, 2]))  # g / sqrt(det Σ₂)
            table[i, U], table[i, V] = _f(col) + f * tu, _f(row) + f * tv
            table[i, K], table[i, SHEAR], table[i, KV] = vv * scale * scale, uv / vv, _f(1) / (vv * g * g)
            weight = densities[i] * (_f(length) if plain else _ROOT_TWO_PI * ray * within)
            table[i, W] = weight
            reach = _f(HIDDEN)
            if weight > _f(faint):
                reach = min(_f(cut), np.sqrt(_f(2) * np.log(weight / _f(faint)))) * g
                if not straight and sod > 0 and judged:
                    # α and β in px of the rotation axis' scale: f α, f β and Σ₂ / f².
                    au, av, bu, bv = hu / hh, hv / hh, ax / (ray * ray), ay / (ray * ray)
                    eta = _f(1) / (depth * depth * hh)
                    first = uu * (_f(0.5) * bu * bu + au * bu + _f(1.5) * au * au)
                    first += uv * (bu * bv + au * bv + av * bu + _f(3) * au * av)
                    first += vv * (_f(0.5) * bv * bv + av * bv + _f(1.5) * av * av)
                    if first / (depth * depth) + _f(6) * eta * eta > _f(exact_above * exact_above):
                        table[i, HU] = table[i, HV] = _f(INEXACT)
                        continue
            table[i, HU], table[i, HV] = reach * np.sqrt(uu), reach * np.sqrt(vv)

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
        d_means: F32,
        d_log_scales: F32,
        d_rotations: F32,
        d_densities: F32,
        d_centres: F32,
    ) -> None:
        f, source, plain = _f(focal), _f(sod), length > 0
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
            m0, mx, my = moments[i, 0], moments[i, 1], moments[i, 2]
            mxx, mxy, myy = moments[i, 3], moments[i, 4], moments[i, 5]
            ka, shear, w = table[i, K], table[i, SHEAR], table[i, W]
            kb, kc = -ka * shear, table[i, KV] + ka * shear * shear
            gu, gv = w * (ka * mx + kb * my), w * (kb * mx + kc * my)
            d_centres[i, 0], d_centres[i, 1] = gu, gv
            ax, ay, g, rr, depth = _f(0), _f(0), f, _f(1), _f(1)
            if not straight and sod > 0:
                x, y, z = means[i, 0], means[i, 1], means[i, 2]
                depth = source + (d0 * x + d1 * y + d2 * z)
                ax, ay = (u0 * x + u1 * y + u2 * z) / depth, (v0 * x + v1 * y + v2 * z) / depth
                g, rr = f / depth, _f(1) + ax * ax + ay * ay
            # P = K M₂, then ∂Σ₂ = 1/2 W P K; g² takes it from 1/px² to 1/mm².
            p00, p01 = ka * mxx + kb * mxy, ka * mxy + kb * myy
            p10, p11 = kb * mxx + kc * mxy, kb * mxy + kc * myy
            twice = w * g * g
            guu, guv, gvv = twice * (p00 * ka + p01 * kb), twice * (p00 * kb + p01 * kc), twice * (p10 * kb + p11 * kc)

            hh = _f(0)
            for k in range(3):
                r0, r1, r2 = rotations[i, k], rotations[i, 3 + k], rotations[i, 6 + k]
                pu, pv, pd = u0 * r0 + u1 * r1 + u2 * r2, v0 * r0 + v1 * r1 + v2 * r2, d0 * r0 + d1 * r1 + d2 * r2
                h = (ax * pu + ay * pv + pd) / scales[i, k]
                hh += h * h
            d_densities[i] += m0 * (_f(length) if plain else _ROOT_TWO_PI * np.sqrt(rr / hh))
            pull = _f(0) if plain else -w * m0 / hh  # ∂L/∂h = -W M₀ h / |h|²
            gax = gay = grow = _f(0)
            for k in range(3):
                r0, r1, r2, s = rotations[i, k], rotations[i, 3 + k], rotations[i, 6 + k], scales[i, k]
                pu, pv, pd = u0 * r0 + u1 * r1 + u2 * r2, v0 * r0 + v1 * r1 + v2 * r2, d0 * r0 + d1 * r1 + d2 * r2
                a, b = s * (pu - ax * pd), s * (pv - ay * pd)
                h = (ax * pu + ay * pv + pd) / s
                ga, gb, gh = guu * a + guv * b, guv * a + gvv * b, pull * h
                d_log_scales[i, k] += ga * a + gb * b - gh * h
                grow += ga * a + gb * b
                ga, gb, gh = ga * s, gb * s, gh / s
                gax, gay = gax + gh * pu - ga * pd, gay + gh * pv - gb * pd
                gpu, gpv, gpd = ga + gh * ax, gb + gh * ay, gh - ga * ax - gb * ay
                d_rotations[i, k] += u0 * gpu + v0 * gpv + d0 * gpd
                d_rotations[i, 3 + k] += u1 * gpu + v1 * gpv + d1 * gpd
                d_rotations[i, 6 + k] += u2 * gpu + v2 * gpv + d2 * gpd
            tu, tv, td = f * gu, f * gv, _f(0)
            if not straight and sod > 0:
                if not plain:  # μ grows with |ray|
                    gax, gay = gax + w * m0 * ax / rr, gay + w * m0 * ay / rr
                tu, tv = (tu + gax) / depth, (tv + gay) / depth
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
    camera: Camera,
    faint: float,
    cut: float,
    table: F32,
    *,
    length: float = 0.0,
    exact_above: float = math.inf,
) -> None:
    """Fill table [n, 8]: centre (col, row), k (1/px²), r, 1 / Σvv (1/px²), weight W = ρμ, half widths in px (two).

    A footprint ends where it falls below `faint` (in units of the image) and at the latest after `cut` standard
    deviations; half widths are HIDDEN where nothing of it is above `faint`, and INEXACT where a cone's ε is above
    `exact_above`. A `length` (mm) other than 0 stands in for μ: the uncorrected factor.
    """
    kernel = _straight_footprints if camera.straight else _footprints
    kernel(
        means, scales, rotations, densities, camera.axes, camera.focal, camera.sod, camera.col, camera.row,
        faint, cut, length, min(exact_above, _NEVER), table,
    )  # fmt: skip


def footprints_backward(
    table: F32,
    moments: F32,
    means: F32,
    scales: F32,
    rotations: F32,
    densities: F32,
    camera: Camera,
    d_means: F32,
    d_log_scales: F32,
    d_rotations: F32,
    d_densities: F32,
    d_centres: F32,
    *,
    length: float = 0.0,
) -> None:
    """Add to the gradients on means, log scales, rotations, densities; d_centres [n, 2] gets ∂/∂(col, row) in 1/px."""
    kernel = _straight_footprints_backward if camera.straight else _footprints_backward
    kernel(
        table, moments, means, scales, rotations, densities, camera.axes, camera.focal, camera.sod, length,
        d_means, d_log_scales, d_rotations, d_densities, d_centres,
    )  # fmt: skip


def footprint_table(n: int) -> NDArray[np.float32]:
    """Room for n footprints."""
    return np.empty((n, 8), np.float32)
