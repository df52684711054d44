"""Footprints of Gaussians on pixels with a width, during rotation of the stage, and their gradients (numba).

A footprint keeps its mass, and its covariance grows by that of the pixel and by the path of its centre:

    Σ' = Σ₂ + s 1 + e eᵀ        W' = W sqrt(det Σ₂ / det Σ')        e = arc / sqrt(12) (∂ centre / ∂ angle)

with s from `RayWidth.variance` and Σ₂, W as in `cpu.footprints`. For a parallel beam e is the Gaussian's coordinate
along the beam, times the arc, along the columns. A compact kernel keeps its profile, so that its second moment is exact
but its shape is not. In a cone, Gaussians that are integrated along each ray are not widened, because they are many
pixels wide.

Backward, a, b and the deformation T are those of `cpu.footprints`:

    G = ∂L/∂Σ' = W' / 2 (K' M₂ K' - M₀ K')        T = 2 (G_uu aaᵀ + G_uv (abᵀ + baᵀ) + G_vv bbᵀ) + W' M₀ 1

In contrast to `cpu.footprints`, needles do not lose accuracy, because Σ' is never thinner than the pixel. The change of
e with the centre is included.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from recon.base.kernel import Kernel
from recon.kernels.cpu.activation import F32, OPTIONS
from recon.kernels.cpu.footprints import HIDDEN, HU, HV, KV, SHEAR, K, RayCamera, W, _rotated, add_shape

_f, _d = np.float32, np.float64


@njit(inline="always", fastmath=True)
def _projected(x, y, z, axes, focal, sod):
    """ax, ay, g, depth of a centre, see `cpu.footprints`."""
    if sod == 0:
        return _f(0), _f(0), focal, _f(1)
    depth = sod + axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
    ax = (axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z) / depth
    ay = (axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z) / depth
    return ax, ay, focal / depth, depth


@njit(inline="always", fastmath=True)
def _path(x, y, axes, ax, ay, g, travel):
    """e of a centre in px, and the change of e along the beam."""
    along = axes[2, 1] * x - axes[2, 0] * y
    eu = travel * g * (axes[0, 1] * x - axes[0, 0] * y - ax * along)
    ev = travel * g * (axes[1, 1] * x - axes[1, 0] * y - ay * along)
    return eu, ev, along


@njit(**OPTIONS)
def _widen(
    table: F32, means: F32, axes: F32, focal: float, sod: float, spread: float, travel: float, faint: float, cut: float,
    ends: bool,
) -> None:  # fmt: skip
    f, source, t, s = _f(focal), _f(sod), _f(travel), _d(spread)
    for i in prange(table.shape[0]):
        if table[i, HU] < 0:
            continue
        ax, ay, g, _ = _projected(means[i, 0], means[i, 1], means[i, 2], axes, f, source)
        e0, e1, _ = _path(means[i, 0], means[i, 1], axes, ax, ay, g, t)
        eu, ev, r = _d(e0), _d(e1), _d(table[i, SHEAR])
        vv, thin = _d(1) / _d(table[i, KV]), _d(1) / _d(table[i, K])
        uu, uv, det = thin + r * r * vv, r * vv, thin * vv
        # det Σ' as a sum of non-negative terms: eᵀ adj(Σ₂) e = thin e_v² + vv (e_u - r e_v)²
        across = eu - r * ev
        wide = det + s * (uu + vv + s + eu * eu + ev * ev) + thin * ev * ev + vv * across * across
        uu, uv, vv = uu + s + eu * eu, uv + eu * ev, vv + s + ev * ev
        table[i, K], table[i, SHEAR], table[i, KV] = _f(vv / wide), _f(uv / vv), _f(_d(1) / vv)
        weight = _f(_d(table[i, W]) * np.sqrt(det / wide))
        table[i, W] = weight
        if weight <= _f(faint):
            table[i, HU] = table[i, HV] = _f(HIDDEN)
            continue
        reach = _f(cut) if ends else min(_f(cut), np.sqrt(_f(2) * np.log(weight / _f(faint))))
        table[i, HU], table[i, HV] = reach * _f(np.sqrt(uu)), reach * _f(np.sqrt(vv))


@njit(**OPTIONS)
def _backward(
    table: F32, moments: F32, means: F32, scales: F32, rotations: F32, axes: F32, focal: float, sod: float,
    travel: float, unit: float, d_means: F32, d_log_scales: F32, d_rotations: F32, d_densities: F32, d_centres: F32,
) -> None:  # fmt: skip
    f, source, t = _f(focal), _f(sod), _f(travel)
    for i in prange(table.shape[0]):
        if table[i, HU] < 0:
            d_centres[i, 0] = d_centres[i, 1] = _f(0)
            continue
        k, shear, kv, w = table[i, K], table[i, SHEAR], table[i, KV], table[i, W]
        m0, mt, mv = moments[i, 0], moments[i, 1], moments[i, 2]
        mtt, mtv, mvv = k * moments[i, 3], kv * moments[i, 4], kv * moments[i, 5]
        gu = w * k * mt
        gv = w * kv * mv - shear * gu
        d_centres[i, 0], d_centres[i, 1] = gu, gv
        # 2 G
        guu, thin = w * k * (mtt - m0), w * kv * (mvv - m0)
        guv = w * k * mtv - shear * guu
        gvv = thin - shear * (w * k * mtv + guv)
        x, y, z = means[i, 0], means[i, 1], means[i, 2]
        ax, ay, g, depth = _projected(x, y, z, axes, f, source)
        r, s0, s1, s2 = rotations[i], scales[i, 0], scales[i, 1], scales[i, 2]
        pu0, pu1, pu2 = _rotated(axes[0, 0], axes[0, 1], axes[0, 2], r)
        pv0, pv1, pv2 = _rotated(axes[1, 0], axes[1, 1], axes[1, 2], r)
        pd0, pd1, pd2 = _rotated(axes[2, 0], axes[2, 1], axes[2, 2], r)
        a0, a1, a2 = g * s0 * (pu0 - ax * pd0), g * s1 * (pu1 - ax * pd1), g * s2 * (pu2 - ax * pd2)
        b0, b1, b2 = g * s0 * (pv0 - ay * pd0), g * s1 * (pv1 - ay * pd1), g * s2 * (pv2 - ay * pd2)
        c0, c1, c2 = guu * a0 + guv * b0, guu * a1 + guv * b1, guu * a2 + guv * b2
        h0, h1, h2 = guv * a0 + gvv * b0, guv * a1 + gvv * b1, guv * a2 + gvv * b2
        mass = w * m0
        add_shape(
            i, scales, rotations, c0 * a0 + h0 * b0 + mass, c0 * a1 + h0 * b1, c0 * a2 + h0 * b2,
            c1 * a1 + h1 * b1 + mass, c1 * a2 + h1 * b2, c2 * a2 + h2 * b2 + mass, d_log_scales, d_rotations,
        )  # fmt: skip
        rr = _f(1) + ax * ax + ay * ay
        volume = _d(s0) * _d(s1) * _d(s2) * _d(g) * _d(g) * np.sqrt(_d(k) * _d(kv) * _d(rr))
        d_densities[i] += m0 * _f(unit * volume)
        eu, ev, along = _path(x, y, axes, ax, ay, g, t)
        pull_u, pull_v = guu * eu + guv * ev, guv * eu + gvv * ev  # gradient on e
        moved_u, moved_v = t * g * pull_u, t * g * pull_v
        tu, tv, td = f * gu, f * gv, _f(0)
        if source > 0:
            pd0, pd1, pd2 = g * s0 * pd0, g * s1 * pd1, g * s2 * pd2
            tu += mass * ax / rr - (c0 * pd0 + c1 * pd1 + c2 * pd2) - moved_u * along
            tv += mass * ay / rr - (h0 * pd0 + h1 * pd1 + h2 * pd2) - moved_v * along
            grow = c0 * a0 + c1 * a1 + c2 * a2 + h0 * b0 + h1 * b1 + h2 * b2
            grow += _f(2) * mass + pull_u * eu + pull_v * ev
            tu, tv = tu / depth, tv / depth
            td = -(tu * ax + tv * ay + grow / depth)
        away = -(moved_u * ax + moved_v * ay)
        turn_x = moved_u * axes[0, 1] + moved_v * axes[1, 1] + away * axes[2, 1]
        turn_y = moved_u * axes[0, 0] + moved_v * axes[1, 0] + away * axes[2, 0]
        d_means[i, 0] += axes[0, 0] * tu + axes[1, 0] * tv + axes[2, 0] * td + turn_x
        d_means[i, 1] += axes[0, 1] * tu + axes[1, 1] * tv + axes[2, 1] * td - turn_y
        d_means[i, 2] += axes[0, 2] * tu + axes[1, 2] * tv + axes[2, 2] * td


def widen(table: F32, means: F32, camera: RayCamera, faint: float, cut: float, kernel: Kernel) -> None:
    """Convert footprints of rays without a width to footprints of rays with the width of the camera.

    Arguments as for `footprints`.
    """
    _widen(
        table, means, camera.axes, camera.focal, camera.sod, camera.spread, camera.travel, faint, kernel.reach(cut),
        kernel.is_compact,
    )  # fmt: skip


def wide_footprints_backward(
    table: F32,
    moments: F32,
    parameters: tuple[F32, F32, F32],
    camera: RayCamera,
    gradients: tuple[F32, F32, F32, F32],
    d_centres: F32,
    kernel: Kernel,
) -> None:
    """`footprints_backward` after `widen`.

    Args:
        parameters: means, scales, rotations.
        gradients: gradients of means, log scales, rotations and densities, to which the result is added.
    """
    _backward(
        table, moments, *parameters, camera.axes, camera.focal, camera.sod, camera.travel, kernel.length, *gradients,
        d_centres,
    )  # fmt: skip
