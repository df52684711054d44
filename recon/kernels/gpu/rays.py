"""Exact line integrals in a cone, for Gaussians whose affine footprint is not accurate enough (Triton).

The formulas are those of `cpu.rays`. With the centre, K and weight of the affine footprint, N = δᵀKδ, and α, η, |D|,
|D₀| as there, the value of a Gaussian at a pixel is

    V = W (|D| / |D₀|) / sqrt(Q) exp(-1/2 N / Q),   Q = (1 + α·δ)² + η N,   where N / Q <= c²
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.kernels.gpu.footprints import (
    HU,
    KV,
    ORIGIN,
    SHEAR,
    K,
    U,
    V,
    W,
    add_to,
    along_ray,
    axes_of,
    footprints,
    footprints_backward,
    lens_of,
    scaled,
    shadow,
    store_box,
)  # fmt: skip
from recon.kernels.gpu.tiles import tile_lists

_BLOCK = 128
_EDGE = 8  # edge of a tile in pixels
_GROUP = 4  # number of Gaussians that a tile processes at once
_PIXELS = (8, 16)  # pixels of a Gaussian that are processed at once, (rows, cols)
# Columns of the terms: α, η, W / |D₀|, the truncation c².
_AU, _AV, _ETA, _WEIGHT, _CUT = (tl.constexpr(column) for column in range(5))
_TERMS = tl.constexpr(8)
# Columns of the sums, as in `cpu.rays`.
_A, _BT, _BV, _BTT, _BTV, _BVV, _L, _LU, _LV, _N = (tl.constexpr(column) for column in range(10))


@triton.jit(do_not_specialize=["n"])
def _terms(
    means, scales, rotations, densities, table, terms, boxes, n, rows, cols, beam, focal, sod, faint, cut, unit,
    COMPACT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < n
    i = tl.minimum(i, n - 1)  # lanes past the end repeat the last Gaussian and store nothing
    f, t = table + 8 * i, terms + _TERMS * i
    seen = live & (tl.load(f + HU) >= 0.0)
    ux, uy, uz, vx, vy, vz, dx, dy, dz = axes_of(beam)
    _, _, _, a, b, depth, norm = along_ray(means, i, seen, beam, focal, sod, True)
    zero = a * 0.0
    hh, along_u, along_v, broadest = zero, zero, zero, zero
    for k in tl.static_range(3):
        s = tl.load(scales + 3 * i + k)
        r0, r1 = tl.load(rotations + 9 * i + k), tl.load(rotations + 9 * i + 3 + k)
        r2 = tl.load(rotations + 9 * i + 6 + k)
        pu, pv, pd = ux * r0 + uy * r1 + uz * r2, vx * r0 + vy * r1 + vz * r2, dx * r0 + dy * r1 + dz * r2
        h = (a * pu + b * pv + pd) / s
        hh, along_u, along_v = hh + h * h, along_u + h / s * pu, along_v + h / s * pv
        broadest = tl.maximum(broadest, s)
    most = tl.load(densities + i) * unit * broadest  # largest value on any ray
    seen = seen & (most > faint)
    au, av, eta = along_u / (hh * focal), along_v / (hh * focal), 1.0 / (hh * depth * depth)
    c2 = cut * cut if COMPACT else tl.minimum(cut * cut, 2.0 * tl.log(tl.where(seen, most, faint) / faint))
    tl.store(t + _AU, tl.where(seen, au, 0.0), live)
    tl.store(t + _AV, tl.where(seen, av, 0.0), live)
    tl.store(t + _ETA, tl.where(seen, eta, 0.0), live)
    tl.store(t + _WEIGHT, tl.where(seen, tl.load(f + W) / norm, 0.0), live)
    tl.store(t + _CUT, tl.where(seen, c2, 0.0), live)
    # The conic N (1 - c²η) = c² (1 + α·δ)² is an ellipse unless the Gaussian reaches the plane of the source.
    left = 1.0 - c2 * eta
    bounded = left > 0.0
    left = tl.where(bounded, left, 1.0)
    shear = tl.load(f + SHEAR)
    svv = 1.0 / (tl.load(f + KV) * left)
    suv, suu = shear * svv, 1.0 / (tl.load(f + K) * left) + shear * shear * svv
    gu, gv = suu * au + suv * av, suv * au + svv * av
    left = 1.0 - c2 * (au * gu + av * gv)
    bounded = bounded & (left > 0.0)
    left = tl.where(bounded, left, 1.0)
    mu, mv = tl.load(f + U) + c2 * gu / left, tl.load(f + V) + c2 * gv / left
    wide, high = tl.sqrt(c2 / left * (suu + c2 * gu * gu / left)), tl.sqrt(c2 / left * (svv + c2 * gv * gv / left))
    store_box(boxes, i, live, seen, bounded, mu, mv, wide, high, rows, cols)


@triton.jit
def _at_pixels(du, dv, over, up, k, shear, kv, au, av, eta, c2, COMPACT: tl.constexpr):
    """(N / Q <= c², τ, N, 1 + α·δ, 1 / Q, V / (W / |D₀|), the same with D for G) at offsets δ of pixels.

    The pixels are at (over, up) from the axis, divided by f; G and D as in `cpu.project`.
    """
    across = du - shear * dv
    square = k * across * across + kv * dv * dv
    lift = 1.0 + au * du + av * dv
    q = lift * lift + eta * square
    inside = (square <= c2 * q) & (q > 0.0)
    inverse = 1.0 / tl.where(inside, q, 1.0)
    value, slope = shadow(scaled(square * inverse, COMPACT), COMPACT)
    longer = tl.sqrt((1.0 + up * up + over * over) * inverse)
    return inside, across, square, lift, inverse, longer * value, longer * slope


@triton.jit
def _render(
    table, terms, boxes, owners, starts, layers, rows, cols, tile_cols, shares, per, beam, EDGE: tl.constexpr,
    GROUP: tl.constexpr, COMPACT: tl.constexpr,
):  # fmt: skip
    tile, share = tl.program_id(0), tl.program_id(1)
    lane = tl.arange(0, EDGE * EDGE)
    row, col = (tile // tile_cols) * EDGE + lane // EDGE, (tile % tile_cols) * EDGE + lane % EDGE
    over, up = (col[None, :] - tl.load(beam + ORIGIN)) * per, (row[None, :] - tl.load(beam + ORIGIN + 1)) * per
    first, last = tl.load(starts + tile), tl.load(starts + tile + 1)
    member = tl.arange(0, GROUP)
    sums = tl.zeros((GROUP, EDGE * EDGE), tl.float32)
    for start in range(first + share * GROUP, last, shares * GROUP):
        held = start + member < last
        owner = tl.load(owners + start + member, held, 0)
        f, t, box = table + 8 * owner, terms + _TERMS * owner, boxes + 4 * owner
        row_low, row_high = tl.load(box, held, 0), tl.load(box + 1, held, 0)
        col_low, col_high = tl.load(box + 2, held, 0), tl.load(box + 3, held, 0)
        du, dv = col[None, :] - tl.load(f + U, held, 0.0)[:, None], row[None, :] - tl.load(f + V, held, 0.0)[:, None]
        inside, _, _, _, _, value, _ = _at_pixels(
            du, dv, over, up, tl.load(f + K, held, 0.0)[:, None], tl.load(f + SHEAR, held, 0.0)[:, None],
            tl.load(f + KV, held, 0.0)[:, None], tl.load(t + _AU, held, 0.0)[:, None],
            tl.load(t + _AV, held, 0.0)[:, None], tl.load(t + _ETA, held, 0.0)[:, None],
            tl.load(t + _CUT, held, 0.0)[:, None], COMPACT,
        )  # fmt: skip
        inside = inside & (row[None, :] >= row_low[:, None]) & (row[None, :] < row_high[:, None])
        inside = inside & (col[None, :] >= col_low[:, None]) & (col[None, :] < col_high[:, None])
        sums += tl.where(inside, value * tl.load(t + _WEIGHT, held, 0.0)[:, None], 0.0)
    pixel = (share.to(tl.int64) * rows + row) * cols + col
    tl.store(layers + pixel, tl.sum(sums, axis=0), (row < rows) & (col < cols))


@triton.jit
def _sums(
    table, terms, boxes, gradient, sums, cols, per, beam, HIGH: tl.constexpr, WIDE: tl.constexpr,
    COMPACT: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0)
    f, t, box = table + 8 * i, terms + _TERMS * i, boxes + 4 * i
    u, v, k = tl.load(f + U), tl.load(f + V), tl.load(f + K)
    shear, kv, weight = tl.load(f + SHEAR), tl.load(f + KV), tl.load(t + _WEIGHT)
    au, av, eta, c2 = tl.load(t + _AU), tl.load(t + _AV), tl.load(t + _ETA), tl.load(t + _CUT)
    row_low, row_high, col_low, col_high = tl.load(box), tl.load(box + 1), tl.load(box + 2), tl.load(box + 3)
    lane = tl.arange(0, HIGH * WIDE)
    col0, row0 = tl.load(beam + ORIGIN), tl.load(beam + ORIGIN + 1)
    s = tl.zeros((HIGH * WIDE,), tl.float32)
    bt, bv, btt, btv, bvv, sl, slu, slv, sn = s, s, s, s, s, s, s, s, s
    for row_start in range(row_low, row_high, HIGH):
        row = row_start + lane // WIDE
        dv, up = row - v, (row - row0) * per
        for col_start in range(col_low, col_high, WIDE):
            col = col_start + lane % WIDE
            du, over = col - u, (col - col0) * per
            inside, across, square, lift, inverse, value, slope = _at_pixels(
                du, dv, over, up, k, shear, kv, au, av, eta, c2, COMPACT
            )
            inside = inside & (row < row_high) & (col < col_high)
            under = tl.load(gradient + row.to(tl.int64) * cols + col, inside, 0.0) * weight
            # Outside, the value may be infinite.
            a, steep = tl.where(inside, under * value, 0.0), tl.where(inside, under * slope, 0.0)
            aq = 0.5 * inverse * (square * inverse * steep - a)
            ab, al = eta * aq - 0.5 * inverse * steep, lift * aq
            abt, abv = ab * across, ab * dv
            s, bt, bv = s + a, bt + abt, bv + abv
            btt, btv, bvv = btt + abt * across, btv + abt * dv, bvv + abv * dv
            sl, slu, slv = sl + al, slu + al * du, slv + al * dv
            sn += tl.where(inside, aq * square, 0.0)
    m = sums + 10 * i
    tl.store(m + _A, tl.sum(s))
    tl.store(m + _BT, tl.sum(bt))
    tl.store(m + _BV, tl.sum(bv))
    tl.store(m + _BTT, tl.sum(btt))
    tl.store(m + _BTV, tl.sum(btv))
    tl.store(m + _BVV, tl.sum(bvv))
    tl.store(m + _L, tl.sum(sl))
    tl.store(m + _LU, tl.sum(slu))
    tl.store(m + _LV, tl.sum(slv))
    tl.store(m + _N, tl.sum(sn))


@triton.jit(do_not_specialize=["n"])
def _bend(
    means, scales, rotations, table, terms, boxes, sums, moments, d_means, d_log_scales, d_rotations, n, beam,
    focal, sod, BLOCK: tl.constexpr,
):  # fmt: skip
    """Moments that give an affine footprint the same gradient through W, K and the centre; add the other parts."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < n
    hit = live & (tl.load(boxes + 4 * i + 1, live, 0) > 0)
    f, t, s, m = table + 8 * i, terms + _TERMS * i, sums + 10 * i, moments + 6 * i
    au, av, eta = tl.load(t + _AU, hit, 0.0), tl.load(t + _AV, hit, 0.0), tl.load(t + _ETA, hit, 1.0)
    whole, sl = tl.load(s + _A, hit, 0.0), tl.load(s + _L, hit, 0.0)
    per_w = -2.0 / tl.load(f + W, hit, 1.0)
    # Σ₂α in the directions τ and v: αu / k, and its part along the slant.
    along = (tl.load(f + SHEAR, hit, 0.0) * au + av) / tl.load(f + KV, hit, 1.0)
    tl.store(m, -0.5 * per_w * whole, live)
    tl.store(m + 1, per_w * (tl.load(s + _BT, hit, 0.0) + sl * au / tl.load(f + K, hit, 1.0)), live)
    tl.store(m + 2, per_w * (tl.load(s + _BV, hit, 0.0) + sl * along), live)
    tl.store(m + 3, per_w * tl.load(s + _BTT, hit, 0.0), live)
    tl.store(m + 4, per_w * tl.load(s + _BTV, hit, 0.0), live)
    tl.store(m + 5, per_w * tl.load(s + _BVV, hit, 0.0), live)
    # The gradient through α, η and |D₀|, which an affine footprint does not have.
    ux, uy, uz, vx, vy, vz, dx, dy, dz = axes_of(beam)
    _, _, _, a, b, depth, norm = along_ray(means, i, hit, beam, focal, sod, True)
    hh = 1.0 / (eta * depth * depth)
    bent = eta * tl.load(s + _N, hit, 0.0)
    gau, gav = 2.0 * tl.load(s + _LU, hit, 0.0), 2.0 * tl.load(s + _LV, hit, 0.0)
    pull = -2.0 * (gau * au + gav * av + bent) / hh
    gau, gav = gau / (focal * hh), gav / (focal * hh)
    ga, gb = -whole * a / (norm * norm), -whole * b / (norm * norm)
    for k in tl.static_range(3):
        sharp = 1.0 / tl.load(scales + 3 * i + k, hit, 1.0)
        r0, r1 = tl.load(rotations + 9 * i + k, hit, 0.0), tl.load(rotations + 9 * i + 3 + k, hit, 0.0)
        r2 = tl.load(rotations + 9 * i + 6 + k, hit, 0.0)
        xu, xv = (ux * r0 + uy * r1 + uz * r2) * sharp, (vx * r0 + vy * r1 + vz * r2) * sharp
        h = a * xu + b * xv + (dx * r0 + dy * r1 + dz * r2) * sharp
        gh, gxu, gxv = gau * xu + gav * xv + pull * h, gau * h, gav * h
        add_to(d_log_scales + 3 * i + k, -(gh * h + gxu * xu + gxv * xv), hit)
        ga, gb = ga + gh * xu, gb + gh * xv
        gu, gv, gd = (gh * a + gxu) * sharp, (gh * b + gxv) * sharp, gh * sharp
        at = d_rotations + 9 * i + k
        add_to(at, ux * gu + vx * gv + dx * gd, hit)
        add_to(at + 3, uy * gu + vy * gv + dy * gd, hit)
        add_to(at + 6, uz * gu + vz * gv + dz * gd, hit)
    far = -(ga * a + gb * b + 2.0 * bent) / depth
    ga, gb = ga / depth, gb / depth
    add_to(d_means + 3 * i, ux * ga + vx * gb + dx * far, hit)
    add_to(d_means + 3 * i + 1, uy * ga + vy * gb + dy * far, hit)
    add_to(d_means + 3 * i + 2, uz * ga + vz * gb + dz * far, hit)


class GpuRays:
    """One or more Gaussians in one projection of a cone, integrated along each ray, with forward and backward pass."""

    def __init__(
        self, parameters: tuple[Tensor, Tensor, Tensor, Tensor], geometry: Geometry, beam: Tensor, faint: float,
        cut: float, kernel: Kernel = Kernel.GAUSSIAN,
    ) -> None:  # fmt: skip
        """Gaussians are cut off at `cut` standard deviations, and left out if no ray gets more than `faint` from them.

        `parameters` are means [n, 3], standard deviations [n, 3], rotations [n, 9] and densities [n].
        """
        self.parameters, self.geometry, self.beam = parameters, geometry, beam
        means, _, _, densities = parameters
        self.kernel, self.footprints = kernel, footprints(*self.parameters, geometry, beam, faint, cut, kernel=kernel)
        n = densities.shape[0]
        self.terms = means.new_empty((n, _TERMS.value))
        self.boxes = torch.empty((n, 4), dtype=torch.int32, device=means.device)
        _terms[(triton.cdiv(n, _BLOCK),)](
            *self.parameters, self.footprints.table, self.terms, self.boxes, n, *geometry.detector_shape, beam,
            *lens_of(geometry), faint, kernel.reach(cut), kernel.length, COMPACT=kernel.is_compact, BLOCK=_BLOCK,
        )  # fmt: skip

    def add_to(self, image: Tensor) -> None:
        """Add the Gaussians to an image [row, col]."""
        shape = self.geometry.detector_shape
        lists = tile_lists(self.boxes, shape, _EDGE)
        layers = image.new_empty((lists.shares, *shape))
        focal, _ = lens_of(self.geometry)
        _render[(lists.n_tiles, lists.shares)](
            self.footprints.table, self.terms, self.boxes, lists.owners, lists.starts, layers, *shape,
            lists.counts[1], lists.shares, 1 / focal, self.beam,
            EDGE=_EDGE, GROUP=_GROUP, COMPACT=self.kernel.is_compact, num_warps=2,
        )  # fmt: skip
        image += layers.sum(0)

    def backward(
        self, gradient: Tensor, d_means: Tensor, d_log_scales: Tensor, d_rotations: Tensor, d_densities: Tensor,
        d_centres: Tensor,
    ) -> None:  # fmt: skip
        """Add to the gradients; d_centres [n, 2] receives ∂/∂(col, row) of the footprint's centre in 1/px."""
        n, table = self.boxes.shape[0], self.footprints.table
        focal, sod = lens_of(self.geometry)
        high, wide = _PIXELS
        sums, moments = table.new_empty((n, 10)), table.new_empty((n, 6))
        _sums[(n,)](
            table, self.terms, self.boxes, gradient, sums, gradient.shape[1], 1 / focal, self.beam,
            HIGH=high, WIDE=wide, COMPACT=self.kernel.is_compact, num_warps=1,
        )  # fmt: skip
        _bend[(triton.cdiv(n, _BLOCK),)](
            *self.parameters[:3], table, self.terms, self.boxes, sums, moments, d_means, d_log_scales, d_rotations, n,
            self.beam, focal, sod, BLOCK=_BLOCK,
        )  # fmt: skip
        footprints_backward(
            self.footprints, moments, *self.parameters, self.geometry, self.beam,
            d_means, d_log_scales, d_rotations, d_densities, d_centres, kernel=self.kernel,
        )  # fmt: skip
