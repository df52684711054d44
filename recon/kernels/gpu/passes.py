"""GpuPass: one pass over a model on a GPU: projections, voxel boxes, and the sum of their gradients."""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel, RayModel
from recon.base.volume import Grid
from recon.kernels.cpu.footprints import INEXACT
from recon.kernels.gpu.footprints import (
    HU,
    HV,
    KV,
    SHEAR,
    Footprints,
    K,
    U,
    V,
    W,
    beam_of,
    footprints,
    footprints_backward,
    scaled,
    shadow,
)
from recon.kernels.gpu.parameters import activate, activation_backward
from recon.kernels.gpu.rays import GpuRays
from recon.kernels.gpu.tiles import Room, tile_lists
from recon.kernels.gpu.voxels import fill, fill_backward, place

_EDGE = 8  # pixels; footprints are mostly 9 to 15 pixels wide, and larger tiles would evaluate more pixels outside them
_GROUP = 8  # number of Gaussians that a tile processes at once
_MANY = 64  # footprints in one partial sum, because adding many small numbers one by one to a large sum loses accuracy
_BLOCK = (8, 16)  # pixels of a footprint that are processed at once, (rows, cols)


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
        # Each member of a group has its own sum, so that the inner loop needs no reduction.
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
    projected: Footprints, shape: tuple[int, int], kernel: Kernel = Kernel.GAUSSIAN, room: Room | None = None
) -> Tensor:
    """Image [row, col]: the sum of the footprints."""
    lists = tile_lists(projected.boxes, shape, _EDGE, room)
    layers = projected.table.new_empty((lists.shares, *shape))
    _render[(lists.n_tiles, lists.shares)](
        projected.table, lists.owners, lists.starts, layers, *shape, lists.counts[1], lists.shares,
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


def moments(projected: Footprints, gradient: Tensor, kernel: Kernel = Kernel.GAUSSIAN) -> Tensor:
    """Moments [n, 6] (1, τ, v, ττ, τv, vv) of an image gradient [row, col] under each footprint."""
    n = projected.table.shape[0]
    result = projected.table.new_empty((n, 6))
    if n > 0:
        high, wide = _BLOCK
        _moments[(n,)](
            projected.table, projected.boxes, gradient, result, gradient.shape[1], HIGH=high, WIDE=wide,
            COMPACT=kernel.is_compact, num_warps=1,
        )  # fmt: skip
    return result


Parameters = tuple[Tensor, Tensor, Tensor, Tensor]  # means, scales (or their logarithms), rotations, densities


def _zeros(like: Parameters) -> Parameters:
    """Zeros in the shapes of the parameters, in one array."""
    parts = torch.zeros(sum(array.numel() for array in like), device=like[0].device)
    means, scales, rotations, densities = (
        part.view(array.shape) for part, array in zip(parts.split([a.numel() for a in like]), like, strict=True)
    )
    return means, scales, rotations, densities


class GpuPass:
    """One pass over a model: physical parameters, and the sum of gradients from its projections and voxel boxes."""

    def __init__(
        self, means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor, unit: float,
        kernel: Kernel = Kernel.GAUSSIAN,
    ) -> None:  # fmt: skip
        self._raw, self._unit, self.kernel = (quaternions, raw), unit, kernel
        scales, rotations, densities = activate(log_scales, quaternions, raw, unit)
        self.active = (means, scales, rotations, densities)
        self.gradient_sums = _zeros(self.active)

    def view(self, geometry: Geometry, view: int, faint: float, cut: float, model: RayModel) -> GpuView:
        beam = torch.from_numpy(beam_of(geometry, view)).to(self._raw[1].device)
        return GpuView(self, geometry, beam, faint, cut, model)

    def box(self, grid: Grid, faint: float, cut: float) -> GpuBox:
        return GpuBox(self, grid, faint, cut)

    def gradients(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        d_means, d_log_scales, d_rotations, d_densities = self.gradient_sums
        return d_means, d_log_scales, *activation_backward(*self._raw, self._unit, d_rotations, d_densities)


class GpuView:
    """One rendered projection: its image [row, col] and its backward pass."""

    def __init__(
        self, run: GpuPass, geometry: Geometry, beam: Tensor, faint: float, cut: float, model: RayModel,
        room: Room | None = None,
    ) -> None:  # fmt: skip
        """`beam`: the projection, from `beam_of`; `room`: room for its lists of tiles."""
        if geometry.width:
            raise ValueError(f"rays with a width ({geometry.width}) can only be projected on the CPU: use device 'cpu'")
        self._run, self._geometry, self._beam, self._length = run, geometry, beam, model.length(geometry)
        self.footprints = footprints(
            *run.active, geometry, beam, faint, cut, self._length, model.exact_above, run.kernel
        )  # fmt: skip
        self.image = render(self.footprints, geometry.detector_shape, run.kernel, room)
        self._rays: tuple[Tensor, GpuRays] | None = None
        if geometry.is_cone and model.exact_above < math.inf:  # their number is known only after waiting for the device
            exact = torch.nonzero(self.footprints.table[:, HU.value] == INEXACT)[:, 0]
            if exact.numel() > 0:
                means, scales, rotations, densities = (array[exact] for array in run.active)
                rays = GpuRays((means, scales, rotations, densities), geometry, beam, faint, cut, run.kernel)
                rays.add_to(self.image)
                self._rays = (exact, rays)

    def backward(self, gradient: Tensor) -> Tensor:
        run, projected = self._run, self.footprints
        centres = projected.table.new_empty((projected.table.shape[0], 2))
        footprints_backward(
            projected, moments(projected, gradient, run.kernel), *run.active, self._geometry, self._beam,
            *run.gradient_sums, centres, self._length, run.kernel,
        )  # fmt: skip
        if self._rays is not None:
            exact, rays = self._rays
            exact_gradients, exact_centres = _zeros(rays.parameters), centres.new_empty((exact.numel(), 2))
            rays.backward(gradient, *exact_gradients, exact_centres)
            centres[exact] = exact_centres
            for gradient_sum, exact_gradient in zip(run.gradient_sums, exact_gradients, strict=True):
                gradient_sum[exact] += exact_gradient  # no index is repeated, so the sum does not depend on the order
        return centres


class GpuBox:
    """One box of voxels: its density [z, y, x] and its backward pass."""

    def __init__(
        self, run: GpuPass, grid: Grid, faint: float, cut: float, corner: Tensor | None = None, room: Room | None = None
    ) -> None:
        self._run, self.placed = run, place(*run.active, grid, faint, cut, run.kernel, corner)
        self.density = fill(self.placed, room)

    def backward(self, gradient: Tensor, *, means_too: bool = True) -> None:
        fill_backward(self.placed, gradient, *self._run.active[1:], *self._run.gradient_sums, means_too=means_too)
