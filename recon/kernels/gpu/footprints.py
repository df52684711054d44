"""Gaussians to footprints on the detector and gradients back, parallel beam and affine cone (Triton).

The formulas are those of `footprints_cpu`. With Ju, Jv the gradients of a Gaussian's column and row with respect to
its position, and n the unit vector along its ray, the columns of R S give a = S RᵀJu, b = S RᵀJv, h = S⁻¹Rᵀn:

    Σ₂ = [[a·a, a·b], [a·b, b·b]]        det Σ₂ = (s₁ s₂ s₃ |Ju x Jv| |h|)²        μ = sqrt(2π) / |h|

For a parallel beam Ju, Jv, n are the view's axes; for a cone, with t the position from the source in view axes and f
the distance of the detector in pixels, Ju = f/t_d (e_u - t_u/t_d e_d), Jv alike, n = t/|t| (Zwicker et al. 2001).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from recon.geometry import Geometry
from recon.kernels.footprints_cpu import HIDDEN, INEXACT, NEAREST

_BLOCK = 128
_ROOT_TWO_PI = tl.constexpr(math.sqrt(2 * math.pi))
_HUGE = tl.constexpr(3.0e38)
_HIDDEN, _INEXACT = tl.constexpr(HIDDEN), tl.constexpr(INEXACT)
# Columns of the footprint table, as in footprints_cpu.
U, V, K, SHEAR, KV, W, HU, HV = (tl.constexpr(column) for column in range(8))


@dataclass(frozen=True, eq=False)
class Footprints:
    """Footprints of Gaussians in one view.

    Attributes:
        table: float32 [n, 8]: centre (col, row), k (1/px²), r, 1 / Σvv (1/px²), weight ρμ, half widths in px (two).
        boxes: int32 [n, 4]: row0, row1, col0, col1 in pixels, ends excluded, clipped to the image; empty boxes are 0.
    """

    table: Tensor
    boxes: Tensor


@triton.jit
def along_ray(  # type: ignore[no-untyped-def]
    means, i, live, ux, uy, uz, vx, vy, vz, dx, dy, dz, focal, sod, CONE: tl.constexpr
):
    """Where a Gaussian lies in the view and how the view sees it: (across, up, per, a, b, depth, norm)."""
    x, y, z = (
        tl.load(means + 3 * i, live, 0.0),
        tl.load(means + 3 * i + 1, live, 0.0),
        tl.load(means + 3 * i + 2, live, 0.0),
    )
    across, up = ux * x + uy * y + uz * z, vx * x + vy * y + vz * z
    if CONE:
        depth = sod + dx * x + dy * y + dz * z
        ahead = tl.where(depth > 0.0, depth, 1.0)  # what lies behind the source is left out by the caller
        a, b, per = across / ahead, up / ahead, focal / ahead
        norm = tl.sqrt(1.0 + a * a + b * b)
    else:
        zero = across * 0.0
        a, b, per, depth, norm = zero, zero, zero + focal, zero + 1.0, zero + 1.0
    return across, up, per, a, b, depth, norm


@triton.jit(do_not_specialize=["n"])
def _footprints(  # type: ignore[no-untyped-def]
    means, scales, rotations, densities, table, boxes, n, rows, cols, ux, uy, uz, vx, vy, vz, dx, dy, dz, col0, row0,
    focal, sod, near, faint, cut, fixed, worst, CONE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < n
    i = tl.minimum(i, n - 1)  # lanes past the end compute the last one again and store nothing
    across, up, per, a, b, depth, norm = along_ray(
        means, i, live, ux, uy, uz, vx, vy, vz, dx, dy, dz, focal, sod, CONE
    )  # fmt: skip
    jux, juy, juz = per * (ux - a * dx), per * (uy - a * dy), per * (uz - a * dz)
    jvx, jvy, jvz = per * (vx - b * dx), per * (vy - b * dy), per * (vz - b * dz)
    nx, ny, nz = (a * ux + b * vx + dx) / norm, (a * uy + b * vy + dy) / norm, (a * uz + b * vz + dz) / norm
    uu, uv, vv, hh, product = across * 0.0, across * 0.0, across * 0.0, across * 0.0, per * per * norm
    along_u, along_v = across * 0.0, across * 0.0
    for k in tl.static_range(3):
        s = tl.load(scales + 3 * i + k)
        r0, r1 = tl.load(rotations + 9 * i + k), tl.load(rotations + 9 * i + 3 + k)
        r2 = tl.load(rotations + 9 * i + 6 + k)
        p, q = s * (jux * r0 + juy * r1 + juz * r2), s * (jvx * r0 + jvy * r1 + jvz * r2)
        h = (nx * r0 + ny * r1 + nz * r2) / s
        uu, uv, vv, hh, product = uu + p * p, uv + p * q, vv + q * q, hh + h * h, product * s
        if CONE:
            along_u += h / s * (ux * r0 + uy * r1 + uz * r2)
            along_v += h / s * (vx * r0 + vy * r1 + vz * r2)
    length = tl.sqrt(hh)
    inverse = 1.0 / (product * length)  # 1 / sqrt(det Σ₂)
    weight = tl.load(densities + i) * tl.where(fixed > 0.0, fixed, _ROOT_TWO_PI / length)
    u, v = col0 + per * across, row0 + per * up
    ka, kv = vv * inverse * inverse, 1.0 / vv
    # Comparisons with a NaN are false: what is not finite is not seen.
    seen = live & (weight > faint) & (weight < _HUGE) & (ka < _HUGE) & (kv < _HUGE) & (depth > near)
    reach = tl.minimum(cut, tl.sqrt(2.0 * tl.maximum(tl.log(tl.where(seen, weight, 1.0) / faint), 0.0)))
    hu, hv = reach * tl.sqrt(uu), reach * tl.sqrt(vv)
    hit = seen & (u + hu >= 0.0) & (u - hu <= cols - 1.0) & (v + hv >= 0.0) & (v - hv <= rows - 1.0)
    if CONE:
        # ε² of `footprints_cpu`: with α and β in px of the rotation axis' scale, Σ₂ / f² and η.
        au, av, bu, bv = along_u / (hh * norm), along_v / (hh * norm), a / (norm * norm), b / (norm * norm)
        eta = 1.0 / (depth * depth * norm * norm * hh)
        error = uu * (0.5 * bu * bu + au * bu + 1.5 * au * au)
        error += uv * (bu * bv + au * bv + av * bu + 3.0 * au * av)
        error += vv * (0.5 * bv * bv + av * bv + 1.5 * av * av)
        inexact = seen & (error / (focal * focal) + 6.0 * eta * eta > worst)
        hu, hv = tl.where(inexact, _INEXACT, hu), tl.where(inexact, _INEXACT, hv)
        hit = hit & (hu >= 0.0)
    f = table + 8 * i
    tl.store(f + U, u, live)
    tl.store(f + V, v, live)
    tl.store(f + K, tl.where(seen, ka, 0.0), live)
    tl.store(f + SHEAR, tl.where(seen, uv / vv, 0.0), live)
    tl.store(f + KV, tl.where(seen, kv, 0.0), live)
    tl.store(f + W, tl.where(seen, weight, 0.0), live)
    tl.store(f + HU, tl.where(seen, hu, _HIDDEN), live)
    tl.store(f + HV, tl.where(seen, hv, _HIDDEN), live)
    # Clipped as floats: a box far outside is no int32.
    row_low, row_high = tl.maximum(tl.ceil(v - hv), 0.0), tl.minimum(tl.floor(v + hv) + 1.0, rows * 1.0)
    col_low, col_high = tl.maximum(tl.ceil(u - hu), 0.0), tl.minimum(tl.floor(u + hu) + 1.0, cols * 1.0)
    hit = hit & (row_high > row_low) & (col_high > col_low)
    box = boxes + 4 * i
    tl.store(box, tl.where(hit, row_low, 0.0).to(tl.int32), live)
    tl.store(box + 1, tl.where(hit, row_high, 0.0).to(tl.int32), live)
    tl.store(box + 2, tl.where(hit, col_low, 0.0).to(tl.int32), live)
    tl.store(box + 3, tl.where(hit, col_high, 0.0).to(tl.int32), live)


@triton.jit(do_not_specialize=["n"])
def _footprints_backward(  # type: ignore[no-untyped-def]
    means, scales, rotations, densities, table, moments, d_means, d_log_scales, d_rotations, d_densities, d_centres, n,
    ux, uy, uz, vx, vy, vz, dx, dy, dz, focal, sod, fixed, CONE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < n
    f, m = table + 8 * i, moments + 6 * i
    seen = live & (tl.load(f + HU, live, -1.0) >= 0.0)
    across, _, per, a, b, depth, norm = along_ray(
        means, i, seen, ux, uy, uz, vx, vy, vz, dx, dy, dz, focal, sod, CONE
    )  # fmt: skip
    m0, me, mv = tl.load(m, seen, 0.0), tl.load(m + 1, seen, 0.0), tl.load(m + 2, seen, 0.0)
    mee, mev, mvv = tl.load(m + 3, seen, 0.0), tl.load(m + 4, seen, 0.0), tl.load(m + 5, seen, 0.0)
    ka, shear = tl.load(f + K, seen, 0.0), tl.load(f + SHEAR, seen, 0.0)
    kv, w = tl.load(f + KV, seen, 0.0), tl.load(f + W, seen, 0.0)
    # K δ and K M₂ K in the factored form: with e = δu - r δv and κ = 1 / Σvv, Kδ = (k e, κ δv - r k e).
    gu = w * ka * me
    gv = w * kv * mv - shear * gu
    tl.store(d_centres + 2 * i, gu, live)
    tl.store(d_centres + 2 * i + 1, gv, live)
    guu, mixed = 0.5 * w * ka * ka * mee, 0.5 * w * ka * kv * mev
    guv, gvv = mixed - shear * guu, 0.5 * w * kv * kv * mvv - shear * (2.0 * mixed - shear * guu)

    jux, juy, juz = per * (ux - a * dx), per * (uy - a * dy), per * (uz - a * dz)
    jvx, jvy, jvz = per * (vx - b * dx), per * (vy - b * dy), per * (vz - b * dz)
    nx, ny, nz = (a * ux + b * vx + dx) / norm, (a * uy + b * vy + dy) / norm, (a * uz + b * vz + dz) / norm
    hh = across * 0.0
    for k in tl.static_range(3):
        s = tl.load(scales + 3 * i + k, seen, 1.0)
        r0, r1 = tl.load(rotations + 9 * i + k, seen, 0.0), tl.load(rotations + 9 * i + 3 + k, seen, 0.0)
        r2 = tl.load(rotations + 9 * i + 6 + k, seen, 0.0)
        h = (nx * r0 + ny * r1 + nz * r2) / s
        hh += h * h
    hh = tl.where(seen, hh, 1.0)
    dense = tl.load(d_densities + i, live, 0.0) + m0 * tl.where(fixed > 0.0, fixed, _ROOT_TWO_PI / tl.sqrt(hh))
    tl.store(d_densities + i, dense, live)
    pull = tl.where(fixed > 0.0, 0.0, -w * m0 / hh)  # ∂L/∂h = -W M₀ h / |h|²
    # Gradients on Ju, Jv and n; a parallel beam's do not depend on where a Gaussian is.
    gux, guy, guz = across * 0.0, across * 0.0, across * 0.0
    gvx, gvy, gvz = across * 0.0, across * 0.0, across * 0.0
    gnx, gny, gnz = across * 0.0, across * 0.0, across * 0.0
    for k in tl.static_range(3):
        s = tl.load(scales + 3 * i + k, seen, 1.0)
        r0, r1 = tl.load(rotations + 9 * i + k, seen, 0.0), tl.load(rotations + 9 * i + 3 + k, seen, 0.0)
        r2 = tl.load(rotations + 9 * i + 6 + k, seen, 0.0)
        p, q = s * (jux * r0 + juy * r1 + juz * r2), s * (jvx * r0 + jvy * r1 + jvz * r2)
        h = (nx * r0 + ny * r1 + nz * r2) / s
        gp, gq, gh = 2.0 * (guu * p + guv * q), 2.0 * (guv * p + gvv * q), pull * h
        at = d_log_scales + 3 * i + k
        tl.store(at, tl.load(at, seen, 0.0) + gp * p + gq * q - gh * h, seen)
        gp, gq, gh = gp * s, gq * s, gh / s
        at = d_rotations + 9 * i + k
        tl.store(at, tl.load(at, seen, 0.0) + gp * jux + gq * jvx + gh * nx, seen)
        tl.store(at + 3, tl.load(at + 3, seen, 0.0) + gp * juy + gq * jvy + gh * ny, seen)
        tl.store(at + 6, tl.load(at + 6, seen, 0.0) + gp * juz + gq * jvz + gh * nz, seen)
        if CONE:
            gux, guy, guz = gux + gp * r0, guy + gp * r1, guz + gp * r2
            gvx, gvy, gvz = gvx + gq * r0, gvy + gq * r1, gvz + gq * r2
            gnx, gny, gnz = gnx + gh * r0, gny + gh * r1, gnz + gh * r2
    gx, gy, gz = gu * jux + gv * jvx, gu * juy + gv * jvy, gu * juz + gv * jvz
    if CONE:
        ahead = tl.where(seen, depth, 1.0)
        # Ju = per (e_u - a e_d) with per ~ 1 / depth and a = across / depth; Jv alike; n = t / |t|, |t| = depth norm.
        inverse = per / ahead
        along_u, along_v = gux * dx + guy * dy + guz * dz, gvx * dx + gvy * dy + gvz * dz
        eu = -inverse * along_u
        ev2 = -inverse * along_v
        ed = -inverse * (gux * ux + guy * uy + guz * uz + gvx * vx + gvy * vy + gvz * vz)
        ed += 2.0 * inverse * (a * along_u + b * along_v)
        gx, gy, gz = (
            gx + eu * ux + ev2 * vx + ed * dx,
            gy + eu * uy + ev2 * vy + ed * dy,
            gz + eu * uz + ev2 * vz + ed * dz,
        )
        on = gnx * nx + gny * ny + gnz * nz
        per_length = 1.0 / (ahead * norm)
        gx, gy, gz = (
            gx + per_length * (gnx - on * nx),
            gy + per_length * (gny - on * ny),
            gz + per_length * (gnz - on * nz),
        )
    at = d_means + 3 * i
    tl.store(at, tl.load(at, seen, 0.0) + gx, seen)
    tl.store(at + 1, tl.load(at + 1, seen, 0.0) + gy, seen)
    tl.store(at + 2, tl.load(at + 2, seen, 0.0) + gz, seen)


def beam_of(geometry: Geometry, view: int) -> tuple[list[float], float, float]:
    """The view's axes (nine numbers), the detector's distance in pixels (pixels a mm, if parallel), source distance."""
    focal = (geometry.sdd if geometry.is_cone else 1.0) / geometry.pixel_pitch
    return geometry.axes(view).ravel().tolist(), focal, geometry.sod if geometry.is_cone else 0.0


def footprints(
    means: Tensor, scales: Tensor, rotations: Tensor, densities: Tensor, geometry: Geometry, view: int,
    faint: float, cut: float, length: float = 0.0, exact_above: float = math.inf,
) -> Footprints:  # fmt: skip
    """Footprints of Gaussians, ending below `faint` (units of the image) and at the latest after `cut` σ.

    A `length` (mm) other than 0 stands in for μ: the uncorrected factor. Half widths are INEXACT, and boxes empty,
    where a cone's ε is above `exact_above` (see `footprints_cpu`).
    """
    n = densities.shape[0]
    found = Footprints(means.new_empty((n, 8)), torch.empty((n, 4), dtype=torch.int32, device=means.device))
    rows, cols = geometry.detector_shape
    axes, focal, sod = beam_of(geometry, view)
    if n > 0:
        _footprints[(triton.cdiv(n, _BLOCK),)](
            means, scales, rotations, densities, found.table, found.boxes, n, rows, cols, *axes, *geometry.origin(view),
            focal, sod, NEAREST * sod, faint, cut, length, min(exact_above * exact_above, _HUGE.value),
            CONE=geometry.is_cone, BLOCK=_BLOCK,
        )  # fmt: skip
    return found


def footprints_backward(
    found: Footprints, moments: Tensor, means: Tensor, scales: Tensor, rotations: Tensor, densities: Tensor,
    geometry: Geometry, view: int,
    d_means: Tensor, d_log_scales: Tensor, d_rotations: Tensor, d_densities: Tensor, d_centres: Tensor,
    length: float = 0.0,
) -> None:  # fmt: skip
    """Add to the gradients on means, log scales, rotations, densities; d_centres [n, 2] gets ∂/∂(col, row) in 1/px."""
    n = densities.shape[0]
    axes, focal, sod = beam_of(geometry, view)
    if n > 0:
        _footprints_backward[(triton.cdiv(n, _BLOCK),)](
            means, scales, rotations, densities, found.table, moments, d_means, d_log_scales, d_rotations, d_densities,
            d_centres, n, *axes, focal, sod, length, CONE=geometry.is_cone, BLOCK=_BLOCK,
        )  # fmt: skip
