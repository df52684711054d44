"""render and moments: footprints to an image, and an image gradient to six moments a footprint (Triton).

    pixel = Σ_i W_i G_i,   G = exp(-1/2 (k τ² + δv² / Σvv)),   τ = δu - r δv
    moments of the gradient g:  Σ g G  and  Σ g D (τ, δv, τ², τ δv, δv²),   D = G, for a compact kernel as `cpu.project`

The moments use the sheared offset τ, in which the quadratic form is diagonal: they are accurate for long thin
footprints. A footprint is cut off at its box, independent of tiles.
"""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from recon.base.kernel import Kernel
from recon.kernels.gpu.footprints import HU, HV, KV, SHEAR, Footprints, K, U, V, W, scaled, shadow
from recon.kernels.gpu.tiles import Room, tile_lists

_EDGE = 8  # pixels; footprints are mostly 9 to 15 wide, and larger tiles would evaluate more pixels outside them
_GROUP = 8  # Gaussians that a tile processes at once
_MANY = 64  # footprints in one partial sum: adding many small numbers one by one to a large sum loses accuracy
_BLOCK = (8, 16)  # pixels of a footprint at once, (rows, cols)


@triton.jit(do_not_specialize=["shares"])
def _render(
    table, owners, starts, layers, rows, cols, tile_cols, shares,
    EDGE: tl.constexpr, GROUP: tl.constexpr, MANY: tl.constexpr, COMPACT: tl.constexpr,
):  # fmt: skip
    tile, share = tl.program_id(0), tl.program_id(1)
    lane = tl.arange(0, EDGE * EDGE)
    row, col = (tile // tile_cols) * EDGE + lane // EDGE, (tile % tile_cols) * EDGE + lane % EDGE
    first, last = tl.load(starts + tile), tl.load(starts + tile + 1)
    member = tl.arange(0, GROUP)
    sums = tl.zeros((EDGE * EDGE,), tl.float32)
    for outer in range(first + share * GROUP, last, shares * GROUP * MANY):
        # Each member of a group has its own sum, so that the inner loop has no reduction.
        part = tl.zeros((GROUP, EDGE * EDGE), tl.float32)
        for start in range(outer, tl.minimum(last, outer + shares * GROUP * MANY), shares * GROUP):
            held = start + member < last
            f = table + 8 * tl.load(owners + start + member, held, 0)
            u, v = tl.load(f + U, held, 0.0), tl.load(f + V, held, 0.0)
            k, kv = scaled(tl.load(f + K, held, 0.0), COMPACT), scaled(tl.load(f + KV, held, 0.0), COMPACT)
            shear, w = tl.load(f + SHEAR, held, 0.0), tl.load(f + W, held, 0.0)
            hu, hv = tl.load(f + HU, held, -1.0), tl.load(f + HV, held, -1.0)
            du, dv = col[None, :] - u[:, None], row[None, :] - v[:, None]
            inside = (tl.abs(du) <= hu[:, None]) & (tl.abs(dv) <= hv[:, None])
            t = du - shear[:, None] * dv
            value, _ = shadow(k[:, None] * t * t + kv[:, None] * dv * dv, COMPACT)
            part += tl.where(inside, w[:, None] * value, 0.0)
        sums += tl.sum(part, axis=0)
    pixel = (share.to(tl.int64) * rows + row) * cols + col
    tl.store(layers + pixel, sums, (row < rows) & (col < cols))


def render(
    found: Footprints, shape: tuple[int, int], kernel: Kernel = Kernel.GAUSSIAN, room: Room | None = None
) -> Tensor:
    """Image [row, col]: the sum of the footprints."""
    lists = tile_lists(found.boxes, shape, _EDGE, room)
    layers = found.table.new_empty((lists.shares, *shape))
    _render[(lists.n_tiles, lists.shares)](
        found.table, lists.owners, lists.starts, layers, *shape, lists.counts[1], lists.shares,
        EDGE=_EDGE, GROUP=_GROUP, MANY=_MANY, COMPACT=kernel.is_compact, num_warps=2,
    )  # fmt: skip
    return layers[0] if lists.shares == 1 else layers.sum(0)


@triton.jit
def _moments(table, boxes, gradient, moments, cols, HIGH: tl.constexpr, WIDE: tl.constexpr, COMPACT: tl.constexpr):
    i = tl.program_id(0)
    f, box = table + 8 * i, boxes + 4 * i
    u, v, shear = tl.load(f + U), tl.load(f + V), tl.load(f + SHEAR)
    k, kv = scaled(tl.load(f + K), COMPACT), scaled(tl.load(f + KV), COMPACT)
    hu, hv = tl.load(f + HU), tl.load(f + HV)
    row_low, row_high, col_low, col_high = tl.load(box), tl.load(box + 1), tl.load(box + 2), tl.load(box + 3)
    lane = tl.arange(0, HIGH * WIDE)
    down, over = lane // WIDE, lane % WIDE
    m0 = tl.zeros((HIGH * WIDE,), tl.float32)
    mt, mv, mtt, mtv, mvv = m0, m0, m0, m0, m0
    for row_start in range(row_low, row_high, HIGH):
        row = row_start + down
        dv = row - v
        for col_start in range(col_low, col_high, WIDE):
            col = col_start + over
            du = col - u
            inside = (row < row_high) & (col < col_high) & (tl.abs(du) <= hu) & (tl.abs(dv) <= hv)
            t = du - shear * dv
            value, slope = shadow(k * t * t + kv * dv * dv, COMPACT)
            g = tl.load(gradient + row.to(tl.int64) * cols + col, inside, 0.0)
            gt, gv = g * slope * t, g * slope * dv
            m0, mt, mv = m0 + g * value, mt + gt, mv + gv
            mtt, mtv, mvv = mtt + gt * t, mtv + gt * dv, mvv + gv * dv
    m = moments + 6 * i
    tl.store(m, tl.sum(m0))
    tl.store(m + 1, tl.sum(mt))
    tl.store(m + 2, tl.sum(mv))
    tl.store(m + 3, tl.sum(mtt))
    tl.store(m + 4, tl.sum(mtv))
    tl.store(m + 5, tl.sum(mvv))


def moments(found: Footprints, gradient: Tensor, kernel: Kernel = Kernel.GAUSSIAN) -> Tensor:
    """Moments [n, 6] (1, τ, v, ττ, τv, vv) of an image gradient [row, col] under each footprint."""
    n = found.table.shape[0]
    result = found.table.new_empty((n, 6))
    if n > 0:
        high, wide = _BLOCK
        _moments[(n,)](
            found.table, found.boxes, gradient, result, gradient.shape[1], HIGH=high, WIDE=wide,
            COMPACT=kernel.is_compact, num_warps=1,
        )  # fmt: skip
    return result
