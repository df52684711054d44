"""Projector through voxels and its exact transpose, for parallel, fan and cone beams (Triton).

Joseph's interpolation, as in `cpu.joseph` and `cpu.cone`: a ray is sampled once in each plane perpendicular to the axis
closest to it, bilinearly between lines and slices. Volumes are [y, x, z], projections [view, col, row]; the last index
is the fastest.

    line(j) = AT + STEP j,   level(j, row) = HEIGHT + (RISE + CLIMB j) (row - MIDDLE)
    weight = max(0, 1 - |line(j) - line|) max(0, 1 - |level(j, row) - z|),   times the path from plane to plane

For a parallel beam CLIMB is 0. Planes, lines and slices are counted from the voxel [ny // 2, nx // 2, nz // 2]. With
2048 voxels, float32 then gives positions within 1e-4 of a voxel. Both directions compute their weights with the same
expressions, whose products and sums are fused in the same way. So each is the transpose of the other, up to the
rounding of its sums.

The transpose is gathered: for each voxel, it checks the few columns and rows whose rays may have weight on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from recon.base.arrays import F64
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.kernels.cpu import cone, joseph

# Columns of the table of rays, as in `cpu.joseph`, and 1 for a ray across planes of constant y, 0 for constant x.
AT, STEP, RISE, CLIMB, PATH, LEAN, STEEP = (tl.constexpr(column) for column in range(7))
_WIDTH = tl.constexpr(8)
# Columns of the table of views, as in `cpu.cone`.
DEPTH, DEPTH_Y, DEPTH_X, SIDE, SIDE_Y, SIDE_X, MIDDLE_COL, MIDDLE, HEIGHT = (tl.constexpr(c) for c in range(9))
_OF_VIEW = tl.constexpr(9)

_LANES, _PLANES = 64, 4  # rays per program; planes that it samples at once
_HIGH = 32  # largest number of neighbouring rows: a cache line
_DEEP = 64  # largest number of slices in a tile of voxels
_FLAT = tl.constexpr(1e-6)  # lines per plane; such a ray stays on its line to 1e-3 of 2048
_LEAST = tl.constexpr(1e-6)  # slices per row; a ray with less, or with the opposite direction, is outside the box
_EDGE = tl.constexpr(0.01)  # lines beyond the box that are also checked; rounding moves a ray by less
_MARGIN, _SCALE = 0.01, 1.001  # margin and factor for columns and rows, against rounding
_WHOLE = 1e-6  # slices; rows this close to a slice count as lying on it


@dataclass(frozen=True, eq=False)
class JosephRays:
    """The rays of straight projections through a box of voxels, on the device.

    Attributes:
        table: float32 [view, col, 8], columns above.
        views: float32 [view, 9], columns above: position of a voxel on the detector, see `cpu.cone.ray_table`.
        near: number of neighbouring columns and rows that contain all rays with possible weight on one voxel.
        is_cone: True if each column has its own climb and direction.
        on_slices: True if each row lies on one slice.
    """

    table: Tensor
    views: Tensor
    near: tuple[int, int]
    is_cone: bool
    on_slices: bool

    @classmethod
    def of(cls, geometry: Geometry, grid: Grid, device: str | torch.device) -> JosephRays:
        """The rays of all projections of `geometry`.

        Raises:
            ValueError: a projection is rolled, tilted or has a centre, or the box reaches the source.
        """
        if not geometry.is_straight:
            raise ValueError("these GPU kernels work only if no projection of the geometry has roll, tilt or centres")
        with np.errstate(invalid="ignore"):  # the source of a parallel beam is infinitely far away
            table, steep, views = cone.ray_table(geometry, grid)
        rise, (z, y, x) = geometry.pixel_pitch / grid.spacing[0], (n // 2 for n in grid.shape)
        if not geometry.is_cone:
            views[:, cone.CLIMB] = rise
        table[..., joseph.AT] += table[..., joseph.STEP] * np.where(steep, y, x) - np.where(steep, x, y)
        table[..., joseph.RISE] += table[..., joseph.CLIMB] * np.where(steep, y, x)
        for first in (cone.CLIMB, cone.SIDE):
            views[:, first] += views[:, first + 1] * y + views[:, first + 2] * x
        views[:, cone.HEIGHT] -= z
        level = views[:, cone.HEIGHT] - rise * views[:, cone.MIDDLE]
        off = max(abs(rise - 1) * geometry.detector_shape[0], np.abs(level - np.rint(level)).max())
        on_slices = not geometry.is_cone and bool(off < _WHOLE)
        if on_slices:  # exactly 1, so that rounding gives no row a weight on another slice
            views[:, cone.HEIGHT], views[:, cone.MIDDLE], table[..., joseph.RISE] = np.rint(level), 0.0, 1.0
        near = _near(views, grid.shape)
        cols, rows = min(near[0], steep.shape[1]), min(1 if on_slices else near[1], geometry.detector_shape[0])
        rays = np.zeros((*steep.shape, _WIDTH.value), np.float32)
        rays[..., :STEEP], rays[..., STEEP] = table, steep
        found = torch.from_numpy(rays).to(device), torch.from_numpy(views.astype(np.float32)).to(device)
        return cls(found[0], found[1], (cols, rows), geometry.is_cone, on_slices)


def _near(views: F64, shape: tuple[int, int, int]) -> tuple[int, int]:
    """Number of neighbouring columns and rows that contain all rays with weight on a voxel of a box of this shape.

    A ray with weight passes the centre of the voxel at less than one voxel: along x if it crosses planes of constant y,
    otherwise along y. Over this distance its column changes at most by the derivative of side / depth. Depth is linear,
    and side / depth has its extremes at corners. So the corners of the box, widened by one voxel, give the bound,
    including pitch and voxel size, magnification and perspective. On a ray, neighbouring slices are 1 / depth rows
    apart.
    """
    y, x = (ends.ravel() for ends in np.meshgrid(*((-(n // 2) - 1, n - n // 2) for n in shape[1:])))
    depth, depth_y, depth_x, side, side_y, side_x = views.T[: cone.MIDDLE_COL, :, None]
    depths = depth + depth_y * y + depth_x * x  # [view, corner]
    places, least = (side + side_y * y + side_x * x) / depths, depths.min(1, keepdims=True)
    if least.min() <= 0:
        raise ValueError("the volume reaches the X-ray source (with a margin of one voxel); use a smaller grid")
    columns = np.maximum(np.abs(side_y - places * depth_y), np.abs(side_x - places * depth_x)) / least
    cols, rows = (2 * (float(most) * _SCALE + _MARGIN) for most in (columns.max(), 1 / least.min()))
    return int(cols) + 1, int(rows) + 1


@triton.jit
def _weight(place, whole):
    return tl.maximum(1.0 - tl.abs(place - whole), 0.0)


@triton.jit
def _level(climb, row, middle, height):
    """The slice that a row hits at a sample."""
    return tl.fma(climb, row - middle, height)


@triton.jit
def _length(path, lean, row, middle):
    """mm along the ray from plane to plane."""
    slope = (row - middle) * lean
    return path * tl.sqrt(slope * slope + 1.0)


@triton.jit(do_not_specialize=["n_views", "cols", "rows", "ny", "nx", "nz"])
def _forward(
    volume, rays, views, out, n_views, cols, rows, ny, nx, nz,
    LANES: tl.constexpr, HIGH: tl.constexpr, PLANES: tl.constexpr, SLICES: tl.constexpr,
):  # fmt: skip
    wide = LANES // HIGH
    across = tl.cdiv(cols, wide)
    job, lane = tl.program_id(0), tl.arange(0, LANES)
    col, row = job % across * wide + lane // HIGH, job // (across * n_views) * HIGH + lane % HIGH
    live = (col < cols) & (row < rows)
    view = views + _OF_VIEW * (job // across % n_views)
    # Lanes beyond the end repeat the last column and store nothing.
    line = (job // across % n_views).to(tl.int64) * cols + tl.minimum(col, cols - 1)
    ray = rays + _WIDTH * line
    at, step, rise, climb = tl.load(ray + AT), tl.load(ray + STEP), tl.load(ray + RISE), tl.load(ray + CLIMB)
    steep = tl.load(ray + STEEP) > 0.0
    middle, height = tl.load(view + MIDDLE), tl.load(view + HEIGHT)
    planes, lines = tl.where(steep, ny, nx), tl.where(steep, nx, ny)
    plane0, line0 = planes // 2, lines // 2
    # Range of planes in which any of the rays is within the box, plus one on either side.
    run = tl.where(tl.abs(step) > _FLAT, step, _FLAT)
    enter, leave = (-1.0 - _EDGE - line0 - at) / run, (lines + _EDGE - line0 - at) / run
    first = tl.floor(tl.minimum(enter, leave)) - 1.0 + plane0
    last = tl.ceil(tl.maximum(enter, leave)) + 2.0 + plane0
    first = tl.min(tl.minimum(tl.maximum(first, 0.0), planes * 1.0)).to(tl.int32)
    last = tl.max(tl.minimum(tl.maximum(last, 0.0), planes * 1.0)).to(tl.int32)
    sums = tl.zeros((PLANES, LANES), tl.float32)
    for start in range(first, last, PLANES):
        plane = start + tl.arange(0, PLANES)[:, None]
        j = (plane - plane0[None, :]).to(tl.float32)
        place = tl.fma(step[None, :], j, at[None, :])
        level = _level(tl.fma(climb[None, :], j, rise[None, :]), row[None, :], middle, height)
        low, bottom = tl.floor(place), tl.floor(level)
        for side in tl.static_range(2):
            i = low.to(tl.int32) + side + line0[None, :]
            inside = (plane < planes[None, :]) & (i >= 0) & (i < lines[None, :])
            share = tl.where(inside, _weight(place, low + side), 0.0)
            voxel = tl.where(steep[None, :], plane * nx + i, i * nx + plane).to(tl.int64) * nz
            for up in tl.static_range(SLICES):
                z, weight = bottom.to(tl.int32) + up + nz // 2, share * _weight(level, bottom + up)
                sums += weight * tl.load(volume + voxel + z, (weight > 0.0) & (z >= 0) & (z < nz), 0.0)
    length = _length(tl.load(ray + PATH), tl.load(ray + LEAN), row, middle)
    tl.store(out + line * rows + row, tl.sum(sums, axis=0) * length, live)


@triton.jit(do_not_specialize=["n_views", "cols", "rows", "ny", "nx", "nz"])
def _adjoint(
    projections, rays, views, out, n_views, cols, rows, ny, nx, nz,
    EDGE: tl.constexpr, DEEP: tl.constexpr, COLS: tl.constexpr, ROWS: tl.constexpr, CONE: tl.constexpr,
):  # fmt: skip
    tiles_x, tiles_y = tl.cdiv(nx, EDGE), tl.cdiv(ny, EDGE)
    tile, lane = tl.program_id(0), tl.arange(0, EDGE * EDGE)
    x, y = tile % tiles_x * EDGE + lane % EDGE, tile // tiles_x % tiles_y * EDGE + lane // EDGE
    z = tile // (tiles_x * tiles_y) * DEEP + tl.arange(0, DEEP)
    # Lanes beyond the end repeat the last voxel and store nothing.
    x_off = (tl.minimum(x, nx - 1) - nx // 2).to(tl.float32)
    y_off = (tl.minimum(y, ny - 1) - ny // 2).to(tl.float32)
    level_of_z = (z - nz // 2).to(tl.float32)[None, :]
    sums = tl.zeros((EDGE * EDGE, DEEP), tl.float32)
    for v in range(n_views):
        view, line = views + _OF_VIEW * v, tl.cast(v, tl.int64) * cols
        middle, height = tl.load(view + MIDDLE), tl.load(view + HEIGHT)
        depth = tl.load(view + DEPTH) + tl.load(view + DEPTH_Y) * y_off + tl.load(view + DEPTH_X) * x_off
        side = tl.load(view + SIDE) + tl.load(view + SIDE_Y) * y_off + tl.load(view + SIDE_X) * x_off
        # The columns from c - COLS / 2 to c + COLS / 2, moved onto the detector as a whole.
        col = tl.ceil(tl.load(view + MIDDLE_COL) + side / depth - 0.5 * COLS)
        col = tl.minimum(tl.maximum(col, 0.0), cols - COLS * 1.0).to(tl.int32)
        if not CONE:  # columns differ only in their position
            first = rays + _WIDTH * line
            step, path, steep = tl.load(first + STEP), tl.load(first + PATH), tl.load(first + STEEP) > 0.0
            climb = tl.load(first + RISE)
            back = 1.0 / climb
        for _ in range(COLS):
            ray = rays + _WIDTH * (line + col)
            if CONE:
                step, path, lean = tl.load(ray + STEP), tl.load(ray + PATH)[:, None], tl.load(ray + LEAN)[:, None]
                steep = tl.load(ray + STEEP) > 0.0
            plane = tl.where(steep, y_off, x_off)
            share = _weight(tl.fma(step, plane, tl.load(ray + AT)), tl.where(steep, x_off, y_off))[:, None]
            if CONE:
                climb = tl.fma(tl.load(ray + CLIMB), plane, tl.load(ray + RISE))[:, None]
                back = 1.0 / tl.maximum(climb, _LEAST)
            row = tl.ceil(middle + (level_of_z - height) * back - 0.5 * ROWS)
            row = tl.minimum(tl.maximum(row, 0.0), rows - ROWS * 1.0).to(tl.int32)
            pixel = projections + (line + col)[:, None] * rows
            for _ in range(ROWS):
                weight = share * _weight(_level(climb, row, middle, height), level_of_z)
                length = _length(path, lean, row, middle) if CONE else path
                sums += weight * (length * tl.load(pixel + row, weight > 0.0, 0.0))
                row += 1
            col += 1
    voxel = (y * nx + x).to(tl.int64)[:, None] * nz + z[None, :]
    tl.store(out + voxel, sums, ((x < nx) & (y < ny))[:, None] & (z < nz)[None, :])


def forward(volume: Tensor, rays: JosephRays, out: Tensor) -> None:
    """Write line integrals of volume [y, x, z] to out [view, col, row], in mm times the volume's unit."""
    views, cols, rows = out.shape
    high = min(triton.next_power_of_2(rows), _HIGH)
    jobs = views * triton.cdiv(cols, _LANES // high) * triton.cdiv(rows, high)
    if jobs > 0:
        _forward[(jobs,)](
            volume, rays.table, rays.views, out, *out.shape, *volume.shape, LANES=_LANES, HIGH=high, PLANES=_PLANES,
            SLICES=1 if rays.on_slices else 2, num_warps=4,
        )  # fmt: skip


def adjoint(projections: Tensor, rays: JosephRays, out: Tensor) -> None:
    """The transpose of `forward`: from projections [view, col, row] to out [y, x, z] (overwritten)."""
    (edge, deep, jobs), (near_cols, near_rows) = tiles_of(out.shape), rays.near
    if jobs > 0:
        _adjoint[(jobs,)](
            projections, rays.table, rays.views, out, *projections.shape, *out.shape, EDGE=edge, DEEP=deep,
            COLS=near_cols, ROWS=near_rows, CONE=rays.is_cone, num_warps=4,
        )  # fmt: skip


def tiles_of(shape: Sequence[int]) -> tuple[int, int, int]:
    """Edge and slices of a tile of a volume [y, x, z] (at least 256 voxels), and the number of tiles."""
    ny, nx, nz = shape
    deep = min(triton.next_power_of_2(nz), _DEEP)
    edge = 16 if deep <= 2 else 8 if deep <= 8 else 4
    return edge, deep, triton.cdiv(ny, edge) * triton.cdiv(nx, edge) * triton.cdiv(nz, deep)
