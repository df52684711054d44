"""Voxelisation of Gaussians on a GPU in bricks; the backward pass uses ten moments per Gaussian (Triton).

With P = Σ⁻¹, and Σ_yz the block of the covariance in y and z, the exponent is a sum of three squares,

    δᵀPδ = Pxx τ² + l δ'² + δz² / Σzz,   τ = δx + Pxy/Pxx δy + Pxz/Pxx δz,   δ' = δy - r δz
    l = Σzz / det Σ_yz,   r = Σyz / Σzz,   det Σ_yz = Pxx (s₁ s₂ s₃)²

all from inner products, without cancellation. The backward pass is as in `cpu.voxelize`, with the moments of (τ, δ',
δz). With moments of δ itself, the thin sides of a needle would be small differences of large sums.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from recon.base.kernel import Kernel
from recon.base.volume import Grid
from recon.kernels.gpu.footprints import add_shape, add_to, body, scaled, shape_of
from recon.kernels.gpu.tiles import Room, tile_lists

_BLOCK = 128
_EDGE = 8  # edge of a brick in voxels
_GROUP = 4  # number of Gaussians that a brick processes at once
_DEEP, _HIGH, _WIDE = 2, 8, 8  # voxels of a Gaussian that are processed at once
_HUGE, _LEAST = tl.constexpr(3.0e38), tl.constexpr(1.0e-30)
# Columns of the table: centre and half widths in voxels, the three squares' factors, the density.
X, Y, Z, KX, SXY, SXZ, KY, SYZ, KZ, HX, HY, HZ, RHO = (tl.constexpr(column) for column in range(13))
_WIDTH = tl.constexpr(16)


@dataclass(frozen=True, eq=False)
class Placed:
    """Gaussians on a grid: float32 [n, 16] as in the columns above, int32 [n, 6] boxes (z0, z1, y0, y1, x0, x1)."""

    table: Tensor
    boxes: Tensor
    grid: Grid
    kernel: Kernel


@triton.jit(do_not_specialize=["n"])
def _placed(
    means, scales, rotations, densities, table, boxes, n, corner, per_x, per_z, nx, ny, nz, faint, cut,
    COMPACT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < n
    i = tl.minimum(i, n - 1)  # lanes past the end repeat the last Gaussian and store nothing
    zero = tl.zeros((BLOCK,), tl.float32)
    xx, yy, zz, yz, pxx, pxy, pxz = zero, zero, zero, zero, zero, zero, zero
    for k in tl.static_range(3):
        s = tl.load(scales + 3 * i + k)
        r0, r1 = tl.load(rotations + 9 * i + k), tl.load(rotations + 9 * i + 3 + k)
        r2 = tl.load(rotations + 9 * i + 6 + k)
        a, b, c = s * r0 * per_x, s * r1 * per_x, s * r2 * per_z
        xx, yy, zz, yz = xx + a * a, yy + b * b, zz + c * c, yz + b * c
        h0, h1, h2 = r0 / (s * per_x), r1 / (s * per_x), r2 / (s * per_z)
        pxx, pxy, pxz = pxx + h0 * h0, pxy + h0 * h1, pxz + h0 * h2
    kx, kz = pxx, 1.0 / zz
    # sqrt(l), by successive quotients, because a product of three small scales would leave the range of float32.
    steep = tl.sqrt(zz) / tl.sqrt(pxx) / (tl.load(scales + 3 * i) * per_x)
    steep = steep / (tl.load(scales + 3 * i + 1) * per_x) / (tl.load(scales + 3 * i + 2) * per_z)
    ky = steep * steep
    density = tl.load(densities + i)
    seen = live & (density > faint) & (density < _HUGE) & (kx < _HUGE) & (ky < _HUGE) & (kz < _HUGE)
    if COMPACT:
        reach = cut
    else:
        reach = tl.minimum(cut, tl.sqrt(2.0 * tl.maximum(tl.log(tl.where(seen, density, 1.0) / faint), 0.0)))
    x = (tl.load(means + 3 * i) - tl.load(corner)) * per_x
    y = (tl.load(means + 3 * i + 1) - tl.load(corner + 1)) * per_x
    z = (tl.load(means + 3 * i + 2) - tl.load(corner + 2)) * per_z
    hx, hy, hz = reach * tl.sqrt(xx), reach * tl.sqrt(yy), reach * tl.sqrt(zz)
    f = table + _WIDTH * i
    tl.store(f + X, x, live)
    tl.store(f + Y, y, live)
    tl.store(f + Z, z, live)
    tl.store(f + KX, tl.where(seen, kx, 0.0), live)
    tl.store(f + SXY, tl.where(seen, pxy / pxx, 0.0), live)
    tl.store(f + SXZ, tl.where(seen, pxz / pxx, 0.0), live)
    tl.store(f + KY, tl.where(seen, ky, 0.0), live)
    tl.store(f + SYZ, tl.where(seen, yz / zz, 0.0), live)
    tl.store(f + KZ, tl.where(seen, kz, 0.0), live)
    tl.store(f + HX, tl.where(seen, hx, -1.0), live)
    tl.store(f + HY, tl.where(seen, hy, -1.0), live)
    tl.store(f + HZ, tl.where(seen, hz, -1.0), live)
    tl.store(f + RHO, tl.where(seen, density, 0.0), live)
    hit = seen & (x + hx >= 0.0) & (x - hx <= nx - 1.0) & (y + hy >= 0.0) & (y - hy <= ny - 1.0)
    hit = hit & (z + hz >= 0.0) & (z - hz <= nz - 1.0)
    # Clip as floats, because a box far outside exceeds int32.
    x_low, x_high = tl.maximum(tl.ceil(x - hx), 0.0), tl.minimum(tl.floor(x + hx) + 1.0, nx * 1.0)
    y_low, y_high = tl.maximum(tl.ceil(y - hy), 0.0), tl.minimum(tl.floor(y + hy) + 1.0, ny * 1.0)
    z_low, z_high = tl.maximum(tl.ceil(z - hz), 0.0), tl.minimum(tl.floor(z + hz) + 1.0, nz * 1.0)
    hit = hit & (x_high > x_low) & (y_high > y_low) & (z_high > z_low)
    box = boxes + 6 * i
    tl.store(box, tl.where(hit, z_low, 0.0).to(tl.int32), live)
    tl.store(box + 1, tl.where(hit, z_high, 0.0).to(tl.int32), live)
    tl.store(box + 2, tl.where(hit, y_low, 0.0).to(tl.int32), live)
    tl.store(box + 3, tl.where(hit, y_high, 0.0).to(tl.int32), live)
    tl.store(box + 4, tl.where(hit, x_low, 0.0).to(tl.int32), live)
    tl.store(box + 5, tl.where(hit, x_high, 0.0).to(tl.int32), live)


def place(
    means: Tensor, scales: Tensor, rotations: Tensor, densities: Tensor, grid: Grid, faint: float, cut: float,
    kernel: Kernel = Kernel.GAUSSIAN, corner: Tensor | None = None,
) -> Placed:  # fmt: skip
    """Place Gaussians on a grid. They are cut off below `faint` (a density) and at `cut` σ, compact ones at their end.

    `corner` (x, y, z) on the device replaces the centre of the grid's first voxel.
    """
    n = densities.shape[0]
    if corner is None:
        corner = torch.tensor(grid.first[::-1], dtype=torch.float32).to(means.device)
    nz, ny, nx = grid.shape
    edge_z, _, edge_x = grid.spacing
    placed = Placed(
        means.new_empty((n, _WIDTH.value)), torch.empty((n, 6), dtype=torch.int32, device=means.device), grid, kernel
    )
    if n > 0:
        _placed[(triton.cdiv(n, _BLOCK),)](
            means, scales, rotations, densities, placed.table, placed.boxes, n, corner, 1 / edge_x, 1 / edge_z,
            nx, ny, nz, faint, kernel.reach(cut), COMPACT=kernel.is_compact, BLOCK=_BLOCK,
        )  # fmt: skip
    return placed


@triton.jit(do_not_specialize=["shares"])
def _fill(
    table, owners, starts, layers, nz, ny, nx, bricks_y, bricks_x, shares, EDGE: tl.constexpr, GROUP: tl.constexpr,
    COMPACT: tl.constexpr,
):  # fmt: skip
    brick, share = tl.program_id(0), tl.program_id(1)
    lane = tl.arange(0, EDGE * EDGE * EDGE)
    ix = (brick % bricks_x) * EDGE + lane % EDGE
    iy = ((brick // bricks_x) % bricks_y) * EDGE + (lane // EDGE) % EDGE
    iz = (brick // (bricks_x * bricks_y)) * EDGE + lane // (EDGE * EDGE)
    first, last = tl.load(starts + brick), tl.load(starts + brick + 1)
    member = tl.arange(0, GROUP)
    sums = tl.zeros((GROUP, EDGE * EDGE * EDGE), tl.float32)
    for start in range(first + share * GROUP, last, shares * GROUP):
        held = start + member < last
        f = table + _WIDTH * tl.load(owners + start + member, held, 0)
        x, y, z = tl.load(f + X, held, 0.0), tl.load(f + Y, held, 0.0), tl.load(f + Z, held, 0.0)
        kx, ky = scaled(tl.load(f + KX, held, 0.0), COMPACT), scaled(tl.load(f + KY, held, 0.0), COMPACT)
        kz, rho = scaled(tl.load(f + KZ, held, 0.0), COMPACT), tl.load(f + RHO, held, 0.0)
        sxy, sxz, syz = tl.load(f + SXY, held, 0.0), tl.load(f + SXZ, held, 0.0), tl.load(f + SYZ, held, 0.0)
        hx, hy, hz = tl.load(f + HX, held, -1.0), tl.load(f + HY, held, -1.0), tl.load(f + HZ, held, -1.0)
        dx, dy, dz = ix[None, :] - x[:, None], iy[None, :] - y[:, None], iz[None, :] - z[:, None]
        inside = (tl.abs(dx) <= hx[:, None]) & (tl.abs(dy) <= hy[:, None]) & (tl.abs(dz) <= hz[:, None])
        a, b = dx + sxy[:, None] * dy + sxz[:, None] * dz, dy - syz[:, None] * dz
        value, _ = body(kx[:, None] * a * a + ky[:, None] * b * b + kz[:, None] * dz * dz, COMPACT)
        sums += tl.where(inside, rho[:, None] * value, 0.0)
    voxel = ((share.to(tl.int64) * nz + iz) * ny + iy) * nx + ix
    tl.store(layers + voxel, tl.sum(sums, axis=0), (iz < nz) & (iy < ny) & (ix < nx))


def fill(placed: Placed, room: Room | None = None) -> Tensor:
    """Density [z, y, x] at the voxel centres."""
    shape = placed.grid.shape
    lists = tile_lists(placed.boxes, shape, _EDGE, room)
    layers = placed.table.new_empty((lists.shares, *shape))
    _fill[(lists.n_tiles, lists.shares)](
        placed.table, lists.owners, lists.starts, layers, *shape, lists.counts[1], lists.counts[2], lists.shares,
        EDGE=_EDGE, GROUP=_GROUP, COMPACT=placed.kernel.is_compact, num_warps=4,
    )  # fmt: skip
    return layers[0] if lists.shares == 1 else layers.sum(0)


@triton.jit
def _moments(
    table, boxes, gradient, moments, ny, nx, DEEP: tl.constexpr, HIGH: tl.constexpr, WIDE: tl.constexpr,
    COMPACT: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0)
    f, box = table + _WIDTH * i, boxes + 6 * i
    x, y, z = tl.load(f + X), tl.load(f + Y), tl.load(f + Z)
    kx, ky = scaled(tl.load(f + KX), COMPACT), scaled(tl.load(f + KY), COMPACT)
    kz = scaled(tl.load(f + KZ), COMPACT)
    sxy, sxz, syz = tl.load(f + SXY), tl.load(f + SXZ), tl.load(f + SYZ)
    hx, hy, hz = tl.load(f + HX), tl.load(f + HY), tl.load(f + HZ)
    z_low, z_high, y_low = tl.load(box), tl.load(box + 1), tl.load(box + 2)
    y_high, x_low, x_high = tl.load(box + 3), tl.load(box + 4), tl.load(box + 5)
    lane = tl.arange(0, DEEP * HIGH * WIDE)
    n0 = tl.zeros((DEEP * HIGH * WIDE,), tl.float32)
    nt, nv, nz, ntt, ntv, ntz, nvv, nvz, nzz = n0, n0, n0, n0, n0, n0, n0, n0, n0
    for z_start in range(z_low, z_high, DEEP):
        iz = z_start + lane // (HIGH * WIDE)
        dz = iz - z
        for y_start in range(y_low, y_high, HIGH):
            iy = y_start + (lane // WIDE) % HIGH
            dy = iy - y
            for x_start in range(x_low, x_high, WIDE):
                ix = x_start + lane % WIDE
                dx = ix - x
                inside = (iz < z_high) & (iy < y_high) & (ix < x_high)
                inside = inside & (tl.abs(dx) <= hx) & (tl.abs(dy) <= hy) & (tl.abs(dz) <= hz)
                t, v = dx + sxy * dy + sxz * dz, dy - syz * dz
                value, slope = body(kx * t * t + ky * v * v + kz * dz * dz, COMPACT)
                g = tl.load(gradient + (iz.to(tl.int64) * ny + iy) * nx + ix, inside, 0.0)
                gt, gv, gz = g * slope * t, g * slope * v, g * slope * dz
                n0, nt, nv, nz = n0 + g * value, nt + gt, nv + gv, nz + gz
                ntt, ntv, ntz = ntt + gt * t, ntv + gt * v, ntz + gt * dz
                nvv, nvz, nzz = nvv + gv * v, nvz + gv * dz, nzz + gz * dz
    m = moments + 10 * i
    tl.store(m, tl.sum(n0))
    tl.store(m + 1, tl.sum(nt))
    tl.store(m + 2, tl.sum(nv))
    tl.store(m + 3, tl.sum(nz))
    tl.store(m + 4, tl.sum(ntt))
    tl.store(m + 5, tl.sum(ntv))
    tl.store(m + 6, tl.sum(ntz))
    tl.store(m + 7, tl.sum(nvv))
    tl.store(m + 8, tl.sum(nvz))
    tl.store(m + 9, tl.sum(nzz))


@triton.jit(do_not_specialize=["n"])
def _backward(
    table, moments, boxes, scales, rotations, densities, d_means, d_log_scales, d_rotations, d_densities, n, per_x,
    per_z, MEANS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < n
    hit = live & (tl.load(boxes + 6 * i + 1, live, 0) > 0)
    m, f = moments + 10 * i, table + _WIDTH * i
    nt, nv, nz = tl.load(m + 1, hit, 0.0), tl.load(m + 2, hit, 0.0), tl.load(m + 3, hit, 0.0)
    tt, tv, tz = tl.load(m + 4, hit, 0.0), tl.load(m + 5, hit, 0.0), tl.load(m + 6, hit, 0.0)
    vv, vz, zz = tl.load(m + 7, hit, 0.0), tl.load(m + 8, hit, 0.0), tl.load(m + 9, hit, 0.0)
    rho = tl.load(densities + i, hit, 0.0)
    add_to(d_densities + i, tl.load(m, hit, 0.0), hit)
    s0, s1, s2, r0, r1, r2, r3, r4, r5, r6, r7, r8 = shape_of(scales, rotations, i, hit)
    # A = H e_x and C = c / Σzz per voxel; B, along c x A, is scaled to its length sqrt(l).
    a0, a1, a2 = r0 / (s0 * per_x), r1 / (s1 * per_x), r2 / (s2 * per_x)
    c0, c1, c2 = r6 * s0 * per_z, r7 * s1 * per_z, r8 * s2 * per_z
    b0, b1, b2 = c1 * a2 - c2 * a1, c2 * a0 - c0 * a2, c0 * a1 - c1 * a0
    size = tl.sqrt(tl.load(f + KY, hit, 0.0) / tl.maximum(b0 * b0 + b1 * b1 + b2 * b2, _LEAST))
    kz = tl.load(f + KZ, hit, 0.0)
    b0, b1, b2, c0, c1, c2 = size * b0, size * b1, size * b2, kz * c0, kz * c1, kz * c2
    if MEANS:
        y0 = rho * (nt * a0 + nv * b0 + nz * c0) / s0
        y1 = rho * (nt * a1 + nv * b1 + nz * c1) / s1
        y2 = rho * (nt * a2 + nv * b2 + nz * c2) / s2
        add_to(d_means + 3 * i, r0 * y0 + r1 * y1 + r2 * y2, hit)
        add_to(d_means + 3 * i + 1, r3 * y0 + r4 * y1 + r5 * y2, hit)
        add_to(d_means + 3 * i + 2, r6 * y0 + r7 * y1 + r8 * y2, hit)
    # T / ρ = (τ A + δ' B + δz C)(...)ᵀ, as A fᵀ + B gᵀ + C hᵀ.
    f0, f1, f2 = tt * a0 + tv * b0 + tz * c0, tt * a1 + tv * b1 + tz * c1, tt * a2 + tv * b2 + tz * c2
    g0, g1, g2 = tv * a0 + vv * b0 + vz * c0, tv * a1 + vv * b1 + vz * c1, tv * a2 + vv * b2 + vz * c2
    h0, h1, h2 = tz * a0 + vz * b0 + zz * c0, tz * a1 + vz * b1 + zz * c1, tz * a2 + vz * b2 + zz * c2
    add_shape(
        i, hit, s0, s1, s2, r0, r1, r2, r3, r4, r5, r6, r7, r8,
        rho * (a0 * f0 + b0 * g0 + c0 * h0), rho * (a0 * f1 + b0 * g1 + c0 * h1),
        rho * (a0 * f2 + b0 * g2 + c0 * h2), rho * (a1 * f1 + b1 * g1 + c1 * h1),
        rho * (a1 * f2 + b1 * g2 + c1 * h2), rho * (a2 * f2 + b2 * g2 + c2 * h2),
        d_log_scales, d_rotations,
    )  # fmt: skip


def fill_backward(
    placed: Placed, gradient: Tensor, scales: Tensor, rotations: Tensor, densities: Tensor,
    d_means: Tensor, d_log_scales: Tensor, d_rotations: Tensor, d_densities: Tensor, *, means_too: bool = True,
) -> None:  # fmt: skip
    """Back-propagate `gradient` [z, y, x], adding to the other gradients; `means_too=False`: not to positions."""
    n = densities.shape[0]
    _, ny, nx = placed.grid.shape
    if n == 0:
        return
    edge_z, _, edge_x = placed.grid.spacing
    moments = placed.table.new_empty((n, 10))
    _moments[(n,)](
        placed.table, placed.boxes, gradient, moments, ny, nx, DEEP=_DEEP, HIGH=_HIGH, WIDE=_WIDE,
        COMPACT=placed.kernel.is_compact, num_warps=1,
    )  # fmt: skip
    _backward[(triton.cdiv(n, _BLOCK),)](
        placed.table, moments, placed.boxes, scales, rotations, densities, d_means, d_log_scales, d_rotations,
        d_densities, n, 1 / edge_x, 1 / edge_z, MEANS=means_too, BLOCK=_BLOCK,
    )  # fmt: skip
