"""Footprints of Gaussians on the detector, and their gradients: parallel beam and affine cone (Triton).

Formulas and symbols are those of `cpu.footprints`. Products of a, b and h replace determinants. The gradient is with
respect to deformations in the Gaussian's own axes, and is computed from moments along the directions of the footprint.
Gaussians with a parameter that is not finite are not drawn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.kernels.cpu.footprints import HIDDEN, INEXACT, NEAREST

_BLOCK = 128
# Factor on a squared distance in standard deviations: exp(-q / 2) = 2^x, and t = 1 + x for a compact kernel.
_HALF_LOG2_E = tl.constexpr(-0.5 / math.log(2))
_PER = tl.constexpr(-1 / Kernel.COMPACT.radius**2)
_SHADOW_SLOPE = tl.constexpr(2 * (Kernel.COMPACT.exponent + 0.5) / Kernel.COMPACT.radius**2)
_BODY_SLOPE = tl.constexpr(2 * Kernel.COMPACT.exponent / Kernel.COMPACT.radius**2)
_HUGE = tl.constexpr(3.0e38)
_HIDDEN, _INEXACT = tl.constexpr(HIDDEN), tl.constexpr(INEXACT)
# Columns of the footprint table, as in `cpu.footprints`.
U, V, K, SHEAR, KV, W, HU, HV = (tl.constexpr(column) for column in range(8))
# A projection's `beam`: nine numbers of its axes, then its origin (col, row) and its centre (x, y, z).
ORIGIN, _CENTRE = tl.constexpr(9), tl.constexpr(11)
BEAM = 14


@dataclass(frozen=True, eq=False)
class Footprints:
    """Footprints of Gaussians in one projection.

    Attributes:
        table: float32 [n, 8]: centre (col, row), k (1/px²), r, 1 / Σvv (1/px²), weight ρμ, half widths in px (two).
        boxes: int32 [n, 4]: row0, row1, col0, col1 in pixels, ends excluded, clipped to the image; empty boxes are 0.
    """

    table: Tensor
    boxes: Tensor


@triton.jit
def scaled(k, COMPACT: tl.constexpr):
    """A factor of the quadratic form, scaled for `shadow` and `body`."""
    return k * _PER if COMPACT else k * _HALF_LOG2_E


@triton.jit
def shadow(x, COMPACT: tl.constexpr):
    """G and D of `cpu.project` in an image; x: the scaled quadratic form."""
    if COMPACT:
        t = tl.maximum(1.0 + x, 0.0)
        value, slope = t * t, t * _SHADOW_SLOPE
    else:
        value = tl.exp2(x)
        slope = value
    return value, slope


@triton.jit
def body(x, COMPACT: tl.constexpr):
    """G and D in a volume; x: the scaled quadratic form."""
    if COMPACT:
        t = tl.maximum(1.0 + x, 0.0)
        root = tl.sqrt(t)
        value, slope = t * root, root * _BODY_SLOPE
    else:
        value = tl.exp2(x)
        slope = value
    return value, slope


@triton.jit
def axes_of(beam):
    """The axes u, v and d of the projection."""
    return (
        tl.load(beam), tl.load(beam + 1), tl.load(beam + 2), tl.load(beam + 3), tl.load(beam + 4), tl.load(beam + 5),
        tl.load(beam + 6), tl.load(beam + 7), tl.load(beam + 8),
    )  # fmt: skip


@triton.jit
def along_ray(means, i, live, beam, focal, sod, CONE: tl.constexpr):
    """Position of a Gaussian in the projection, and its ray: (across, up, px/mm, a, b, depth, length of ray)."""
    ux, uy, uz, vx, vy, vz, dx, dy, dz = axes_of(beam)
    x, y = tl.load(means + 3 * i, live, 0.0), tl.load(means + 3 * i + 1, live, 0.0)
    z = tl.load(means + 3 * i + 2, live, 0.0)
    if CONE:
        x, y, z = x - tl.load(beam + _CENTRE), y - tl.load(beam + _CENTRE + 1), z - tl.load(beam + _CENTRE + 2)
    across, up = ux * x + uy * y + uz * z, vx * x + vy * y + vz * z
    if CONE:
        depth = sod + (dx * x + dy * y + dz * z)
        ahead = tl.where(depth > 0.0, depth, 1.0)  # the caller skips Gaussians behind the source
        a, b, per = across / ahead, up / ahead, focal / ahead
        norm = tl.sqrt(1.0 + a * a + b * b)
    else:
        zero = tl.zeros_like(across)
        a, b, per, depth, norm = zero, zero, zero + focal, zero + 1.0, zero + 1.0
    return across, up, per, a, b, depth, norm


@triton.jit
def turned(x, y, z, r0, r1, r2, r3, r4, r5, r6, r7, r8):
    """Rᵀ times a vector."""
    return x * r0 + y * r3 + z * r6, x * r1 + y * r4 + z * r7, x * r2 + y * r5 + z * r8


@triton.jit
def shape_of(scales, rotations, i, live):
    """The three scales and nine numbers of the rotation; unit scales and rotation if not `live`."""
    s, r = scales + 3 * i, rotations + 9 * i
    return (
        tl.load(s, live, 1.0), tl.load(s + 1, live, 1.0), tl.load(s + 2, live, 1.0),
        tl.load(r, live, 1.0), tl.load(r + 1, live, 0.0), tl.load(r + 2, live, 0.0),
        tl.load(r + 3, live, 0.0), tl.load(r + 4, live, 1.0), tl.load(r + 5, live, 0.0),
        tl.load(r + 6, live, 0.0), tl.load(r + 7, live, 0.0), tl.load(r + 8, live, 1.0),
    )  # fmt: skip


@triton.jit
def store_box(boxes, i, live, hit, bounded, u, v, hu, hv, rows, cols):
    """Store the pixels within hu, hv of (u, v): the whole image if not `bounded`, an empty box if not `hit`."""
    # Clip as floats, because a box far outside exceeds int32.
    row_low, row_high = tl.maximum(tl.ceil(v - hv), 0.0), tl.minimum(tl.floor(v + hv) + 1.0, rows * 1.0)
    col_low, col_high = tl.maximum(tl.ceil(u - hu), 0.0), tl.minimum(tl.floor(u + hu) + 1.0, cols * 1.0)
    row_low, row_high = tl.where(bounded, row_low, 0.0), tl.where(bounded, row_high, rows * 1.0)
    col_low, col_high = tl.where(bounded, col_low, 0.0), tl.where(bounded, col_high, cols * 1.0)
    hit = hit & (row_high > row_low) & (col_high > col_low)
    box = boxes + 4 * i
    tl.store(box, tl.where(hit, row_low, 0.0).to(tl.int32), live)
    tl.store(box + 1, tl.where(hit, row_high, 0.0).to(tl.int32), live)
    tl.store(box + 2, tl.where(hit, col_low, 0.0).to(tl.int32), live)
    tl.store(box + 3, tl.where(hit, col_high, 0.0).to(tl.int32), live)


@triton.jit
def add_to(at, value, live):
    """*at += value, for lanes that are `live`."""
    tl.store(at, tl.load(at, live, 0.0) + value, live)


@triton.jit
def add_shape(
    i, live, s0, s1, s2, r0, r1, r2, r3, r4, r5, r6, r7, r8, t00, t01, t02, t11, t12, t22, d_log_scales, d_rotations
):
    """Add the gradients that follow from T, the gradient of a deformation in the Gaussian's axes (`cpu.footprints`)."""
    add_to(d_log_scales + 3 * i, t00, live)
    add_to(d_log_scales + 3 * i + 1, t11, live)
    add_to(d_log_scales + 3 * i + 2, t22, live)
    # Quotients of equal scales are bit-identical, so a sphere gets no gradient for its rotation.
    x, y = 0.5 * t01 * (s1 / s0 - s0 / s1), 0.5 * t02 * (s2 / s0 - s0 / s2)
    z = 0.5 * t12 * (s2 / s1 - s1 / s2)
    g = d_rotations + 9 * i
    add_to(g, -(r1 * x + r2 * y), live)
    add_to(g + 1, r0 * x - r2 * z, live)
    add_to(g + 2, r0 * y + r1 * z, live)
    add_to(g + 3, -(r4 * x + r5 * y), live)
    add_to(g + 4, r3 * x - r5 * z, live)
    add_to(g + 5, r3 * y + r4 * z, live)
    add_to(g + 6, -(r7 * x + r8 * y), live)
    add_to(g + 7, r6 * x - r8 * z, live)
    add_to(g + 8, r6 * y + r7 * z, live)


@triton.jit(do_not_specialize=["n"])
def _footprints(
    means, scales, rotations, densities, table, boxes, n, rows, cols, beam, focal, sod, near, faint, cut, fixed,
    worst, unit, e0, e1, e2, e3, CONE: tl.constexpr, COMPACT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < n
    i = tl.minimum(i, n - 1)  # lanes past the end repeat the last Gaussian and store nothing
    ux, uy, uz, vx, vy, vz, dx, dy, dz = axes_of(beam)
    across, up, per, a, b, depth, norm = along_ray(means, i, live, beam, focal, sod, CONE)
    zero = tl.zeros((BLOCK,), tl.float32)
    uu, uv, vv, hh, along_u, along_v = zero, zero, zero, zero, zero, zero
    for k in tl.static_range(3):
        s = tl.load(scales + 3 * i + k)
        r0, r1 = tl.load(rotations + 9 * i + k), tl.load(rotations + 9 * i + 3 + k)
        r2 = tl.load(rotations + 9 * i + 6 + k)
        pu, pv, pd = ux * r0 + uy * r1 + uz * r2, vx * r0 + vy * r1 + vz * r2, dx * r0 + dy * r1 + dz * r2
        p, q, h = s * (pu - a * pd), s * (pv - b * pd), (a * pu + b * pv + pd) / s
        uu, uv, vv, hh = uu + p * p, uv + p * q, vv + q * q, hh + h * h
        if CONE:
            along_u += h / s * pu
            along_v += h / s * pv
    within = 1.0 / tl.sqrt(hh)  # mm along the ray per standard deviation
    # g / sqrt(det Σ₂), by successive quotients, because a product of three small scales would leave the range of
    # float32.
    scale = within / per / tl.load(scales + 3 * i) / tl.load(scales + 3 * i + 1) / tl.load(scales + 3 * i + 2)
    wide, high = tl.sqrt(uu), tl.sqrt(vv)
    steep, level = high * scale, 1.0 / (high * per)
    ka, kv = steep * steep, level * level
    weight = tl.load(densities + i) * tl.where(fixed > 0.0, fixed, unit * norm * within)
    u, v = tl.load(beam + ORIGIN) + per * across, tl.load(beam + ORIGIN + 1) + per * up
    # Comparisons with NaN are false, so Gaussians that are not finite are not drawn.
    seen = live & (weight > faint) & (weight < _HUGE) & (ka < _HUGE) & (kv < _HUGE) & (depth > near)
    if COMPACT:
        reach = cut * per
    else:
        reach = tl.minimum(cut, tl.sqrt(2.0 * tl.maximum(tl.log(tl.where(seen, weight, 1.0) / faint), 0.0))) * per
    hu, hv = reach * wide, reach * high
    hit = seen & (u + hu >= 0.0) & (u - hu <= cols - 1.0) & (v + hv >= 0.0) & (v - hv <= rows - 1.0)
    if CONE:
        # ε² of `cpu.footprints`: with α and β in px of the rotation axis' scale, Σ₂ / f² and η.
        au, av, bu, bv = along_u / hh, along_v / hh, a / (norm * norm), b / (norm * norm)
        eta = 1.0 / (depth * depth * hh)
        error = uu * (e0 * bu * bu + e1 * au * bu + e2 * au * au)
        error += uv * (2.0 * (e0 * bu * bv + e2 * au * av) + e1 * (au * bv + av * bu))
        error += vv * (e0 * bv * bv + e1 * av * bv + e2 * av * av)
        inexact = seen & (error / (depth * depth) + e3 * eta * eta > worst)
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
    store_box(boxes, i, live, hit, hit, u, v, hu, hv, rows, cols)


@triton.jit(do_not_specialize=["n"])
def _footprints_backward(
    means, scales, rotations, table, moments, d_means, d_log_scales, d_rotations, d_densities, d_centres, n, beam,
    focal, sod, fixed, unit, CONE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < n
    f, m = table + 8 * i, moments + 6 * i
    seen = live & (tl.load(f + HU, live, -1.0) >= 0.0)
    ux, uy, uz, vx, vy, vz, dx, dy, dz = axes_of(beam)
    _, _, g, ax, ay, depth, norm = along_ray(means, i, seen, beam, focal, sod, CONE)
    m0, mt, mv = tl.load(m, seen, 0.0), tl.load(m + 1, seen, 0.0), tl.load(m + 2, seen, 0.0)
    mtt, mtv, mvv = tl.load(m + 3, seen, 0.0), tl.load(m + 4, seen, 0.0), tl.load(m + 5, seen, 0.0)
    k, shear = tl.load(f + K, seen, 0.0), tl.load(f + SHEAR, seen, 0.0)
    kv, w = tl.load(f + KV, seen, 0.0), tl.load(f + W, seen, 0.0)
    gu = w * k * mt
    gv = w * kv * mv - shear * gu
    tl.store(d_centres + 2 * i, gu, live)
    tl.store(d_centres + 2 * i + 1, gv, live)
    s0, s1, s2, r0, r1, r2, r3, r4, r5, r6, r7, r8 = shape_of(scales, rotations, i, seen)
    pu0, pu1, pu2 = turned(ux, uy, uz, r0, r1, r2, r3, r4, r5, r6, r7, r8)
    pv0, pv1, pv2 = turned(vx, vy, vz, r0, r1, r2, r3, r4, r5, r6, r7, r8)
    pd0, pd1, pd2 = turned(dx, dy, dz, r0, r1, r2, r3, r4, r5, r6, r7, r8)
    b0, b1, b2 = s0 * (pv0 - ay * pd0), s1 * (pv1 - ay * pd1), s2 * (pv2 - ay * pd2)
    h0, h1, h2 = ((ax * pu0 + ay * pv0 + pd0) / s0, (ax * pu1 + ay * pv1 + pd1) / s1, (ax * pu2 + ay * pv2 + pd2) / s2)
    hh = h0 * h0 + h1 * h1 + h2 * h2
    # A = (b x h) / (g s₁ s₂ s₃ h·h), with opposite sign since the views' axes are left-handed; B = b / Σvv in px.
    size, level = 1.0 / (g * s0 * s1) / (s2 * hh), kv * g
    a0, a1, a2 = size * (b2 * h1 - b1 * h2), size * (b0 * h2 - b2 * h0), size * (b1 * h0 - b0 * h1)
    b0, b1, b2 = level * b0, level * b1, level * b2
    add_to(d_densities + i, m0 * tl.where(fixed > 0.0, fixed, unit * norm / tl.sqrt(hh)), seen)
    pull = tl.where(fixed > 0.0, 0.0, m0 / hh)
    # T / W = (τ A + δv B)(τ A + δv B)ᵀ + M₀ hhᵀ / h·h, as A cᵀ + B eᵀ + ...
    c0, c1, c2 = mtt * a0 + mtv * b0, mtt * a1 + mtv * b1, mtt * a2 + mtv * b2
    e0, e1, e2 = mtv * a0 + mvv * b0, mtv * a1 + mvv * b1, mtv * a2 + mvv * b2
    add_shape(
        i, seen, s0, s1, s2, r0, r1, r2, r3, r4, r5, r6, r7, r8,
        w * (a0 * c0 + b0 * e0 + pull * h0 * h0), w * (a0 * c1 + b0 * e1 + pull * h0 * h1),
        w * (a0 * c2 + b0 * e2 + pull * h0 * h2), w * (a1 * c1 + b1 * e1 + pull * h1 * h1),
        w * (a1 * c2 + b1 * e2 + pull * h1 * h2), w * (a2 * c2 + b2 * e2 + pull * h2 * h2),
        d_log_scales, d_rotations,
    )  # fmt: skip
    if CONE:
        # ∂a = g W k Σ g G τ y and ∂b alike; a and b lose ax and ay times SRᵀd, h gains them times S⁻¹Rᵀ(u, v).
        far_t = c0 * s0 * pd0 + c1 * s1 * pd1 + c2 * s2 * pd2
        far_v = e0 * s0 * pd0 + e1 * s1 * pd1 + e2 * s2 * pd2
        gax, gay = -g * k * far_t, -g * (kv * far_v - k * shear * far_t)
        # μ grows with |ray|, and falls as h grows.
        rays = tl.where(fixed > 0.0, 0.0, m0 / (norm * norm))
        gax += rays * ax - pull * (h0 * pu0 / s0 + h1 * pu1 / s1 + h2 * pu2 / s2)
        gay += rays * ay - pull * (h0 * pv0 / s0 + h1 * pv1 / s1 + h2 * pv2 / s2)
        ahead = tl.where(seen, depth, 1.0)
        tu, tv = (focal * gu + w * gax) / ahead, (focal * gv + w * gay) / ahead
        td = -(tu * ax + tv * ay + w * (k * mtt + kv * mvv) / ahead)
    else:
        tu, tv, td = focal * gu, focal * gv, tl.zeros_like(gu)
    add_to(d_means + 3 * i, ux * tu + vx * tv + dx * td, seen)
    add_to(d_means + 3 * i + 1, uy * tu + vy * tv + dy * td, seen)
    add_to(d_means + 3 * i + 2, uz * tu + vz * tv + dz * td, seen)


def beam_of(geometry: Geometry, view: int) -> F32:
    """The values of one projection for the kernels, float32 [14]: axes, origin (col, row) in pixels, centre in mm."""
    return np.array([*geometry.axes(view).ravel(), *geometry.origin(view), *geometry.centres[view]], np.float32)


def lens_of(geometry: Geometry) -> tuple[float, float]:
    """Values common to all projections: sdd in pixels (parallel beam: pixels per mm), and sod (parallel beam: 0)."""
    focal = (geometry.sdd if geometry.is_cone else 1.0) / geometry.pixel_pitch
    return focal, geometry.sod if geometry.is_cone else 0.0


def footprints(
    means: Tensor, scales: Tensor, rotations: Tensor, densities: Tensor, geometry: Geometry, beam: Tensor,
    faint: float, cut: float, length: float = 0.0, exact_above: float = math.inf, kernel: Kernel = Kernel.GAUSSIAN,
) -> Footprints:  # fmt: skip
    """Footprints of Gaussians in the projection of `beam`, see `beam_of`.

    They are cut off below `faint` (units of the image) and at `cut` σ, compact ones at their end.

    A `length` (mm) other than 0 replaces μ (the uncorrected factor). In a cone, Gaussians with ε above `exact_above`
    get half widths INEXACT and empty boxes (see `cpu.footprints`).
    """
    n = densities.shape[0]
    seen = Footprints(means.new_empty((n, 8)), torch.empty((n, 4), dtype=torch.int32, device=means.device))
    rows, cols = geometry.detector_shape
    focal, sod = lens_of(geometry)
    if n > 0:
        _footprints[(triton.cdiv(n, _BLOCK),)](
            means, scales, rotations, densities, seen.table, seen.boxes, n, rows, cols, beam, focal, sod,
            NEAREST * sod, faint, kernel.reach(cut), length, min(exact_above * exact_above, _HUGE.value),
            kernel.length, *kernel.affine_terms, CONE=geometry.is_cone, COMPACT=kernel.is_compact, BLOCK=_BLOCK,
        )  # fmt: skip
    return seen


def footprints_backward(
    seen: Footprints, moments: Tensor, means: Tensor, scales: Tensor, rotations: Tensor, densities: Tensor,
    geometry: Geometry, beam: Tensor,
    d_means: Tensor, d_log_scales: Tensor, d_rotations: Tensor, d_densities: Tensor, d_centres: Tensor,
    length: float = 0.0, kernel: Kernel = Kernel.GAUSSIAN,
) -> None:  # fmt: skip
    """Add to the gradients of means, log scales, rotations, densities; d_centres [n, 2]: ∂/∂(col, row) in 1/px."""
    n = densities.shape[0]
    if n > 0:
        _footprints_backward[(triton.cdiv(n, _BLOCK),)](
            means, scales, rotations, seen.table, moments, d_means, d_log_scales, d_rotations, d_densities, d_centres,
            n, beam, *lens_of(geometry), length, kernel.length, CONE=geometry.is_cone, BLOCK=_BLOCK,
        )  # fmt: skip
