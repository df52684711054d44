"""Parallel-beam projector and its adjoint: Joseph's interpolation, the slices of a volume fastest (numba, threaded).

A ray is sampled once in every plane of voxels across the axis that is closest to its direction. Samples are
interpolated linearly between the two nearest lines (P. M. Joseph 1982, IEEE Trans. Med. Imaging 1, 192). Volumes are
[y, x, z] and projections [view, col, row] here, so one pair of weights serves a whole line of slices. Both directions
read their weights from one table of rays, so that each is the exact transpose of the other. The transpose runs plane by
plane, and no two threads write to the same voxel.
"""

from __future__ import annotations

import numpy as np
from numba import get_num_threads, njit, prange
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.kernels.cpu import lanes
from recon.kernels.cpu.activation import F32, OPTIONS

F64 = NDArray[np.float64]
Flags = NDArray[np.bool_]
_f = np.float32

# Columns of the table of rays. A ray crosses plane j at line AT + STEP j, where one detector row is RISE + CLIMB j
# slices high. It runs PATH mm from plane to plane in x and y; from row to row of a cone its slope changes by LEAN.
AT, STEP, RISE, CLIMB, PATH, LEAN = range(6)

_BLOCK = 64  # largest number of slices of one job
_GROUP = 16  # projections that share one pass over the volume
_ENOUGH = 4  # blocks per thread above which one remaining block costs little
TILE = 32  # voxels along each edge of a tile: 74 to 296 KB with its margin
EDGE = TILE + 2
_FLAT = 1e-9  # lines per plane; a ray with a smaller step is treated as staying on its line

CALL = 2**28
"""Approximate number of samples in one call of a kernel.

A call takes 0.1 to 0.5 s on two cores; signals are handled between calls.
"""


def ray_table(geometry: Geometry, grid: Grid) -> tuple[F64, Flags]:
    """The in-plane path of the ray to every column: float64 [view, col, 6] (columns above), and flags bool [view, col].

    A flag is set if the ray is closer to y than to x: it then crosses planes of constant y, and lines are counted along
    x; otherwise x and y change places.
    """
    _, cy, cx = grid.centre
    _, ny, nx = grid.shape
    h, pitch = grid.voxel_size, geometry.pixel_pitch
    rise = pitch / grid.spacing[0]
    cols = np.arange(geometry.detector_shape[1])
    t = (cols - (geometry.axis_col + geometry.shifts[:, :1])) * pitch
    cos, sin = np.cos(geometry.angles)[:, None], np.sin(geometry.angles)[:, None]
    if geometry.is_cone:
        origin_x, origin_y = geometry.sod * sin + 0 * t, -geometry.sod * cos + 0 * t
        run_x, run_y = t * cos - geometry.sdd * sin, t * sin + geometry.sdd * cos
    else:
        origin_x, origin_y = t * cos, t * sin
        run_x, run_y = -sin + 0 * t, cos + 0 * t
    steep = np.abs(run_y) >= np.abs(run_x)
    first_x, first_y = cx - (nx - 1) / 2 * h, cy - (ny - 1) / 2 * h
    reach = np.hypot(run_x, run_y)  # for a cone, mm from the source to the detector
    # Planes are counted along the axis closest to the ray (a), lines along the other one (b).
    run_a, run_b = np.where(steep, run_y, run_x), np.where(steep, run_x, run_y)
    from_a = np.where(steep, first_y - origin_y, first_x - origin_x)
    from_b = np.where(steep, origin_x - first_x, origin_y - first_y)
    slope = run_b / run_a
    table = np.empty((*t.shape, 6))
    table[..., AT] = (from_b + from_a * slope) / h
    table[..., STEP] = slope
    table[..., RISE] = rise * from_a / run_a if geometry.is_cone else rise
    table[..., CLIMB] = rise * h / run_a if geometry.is_cone else 0.0
    table[..., PATH] = h * reach / np.abs(run_a)
    table[..., LEAN] = pitch / reach if geometry.is_cone else 0.0
    return table, steep


@njit(cache=True, boundscheck=False, error_model="numpy")
def samples(first, step, low0, low1, j0, j1, across, along, at, share):
    """Samples of the ray first + step j, in planes j0..j1 (excluded), whose lower line is low0..low1 (excluded).

    Fills at [sample], the row of the tile with this line, and share [sample], the share of the next line. Returns the
    plane of the first sample and the number of samples. Fast arithmetic is not used, because each sample must be in
    exactly one tile, and rounding must be the same everywhere.

    Args:
        across, along: rows of the tile from plane to plane, and from line to line.
    """
    a, b = j0, j1
    if abs(step) > _FLAT:
        end0, end1 = (low0 - first) / step, (low1 - first) / step
        if end1 < end0:
            end0, end1 = end1, end0
        a, b = int(min(max(end0, j0), j1)), int(min(max(end1, j0), j1))
    while a < b and not low0 <= first + step * a < low1:
        a += 1
    while b > a and not low0 <= first + step * (b - 1) < low1:
        b -= 1
    while a > j0 and low0 <= first + step * (a - 1) < low1:
        a -= 1
    while b < j1 and low0 <= first + step * b < low1:
        b += 1
    for k in range(b - a):
        exact = first + step * (a + k)
        low = min(max(np.floor(exact), np.float64(low0)), np.float64(low1 - 1))
        at[k] = np.int32(a + k - j0) * np.int32(across) + np.int32(low - low0) * np.int32(
            along
        )  # AVX2 cannot convert a float64 to int64
        share[k] = exact - low
    return a, b - a


@njit(cache=True, boundscheck=False, error_model="numpy")
def _columns(rays, v, low0, low1, j0, j1):
    """Columns first..end (excluded) outside which no ray of a parallel projection has samples there (see `samples`)."""
    cols, step = rays.shape[1], rays[v, 0, STEP]
    per_col = (rays[v, cols - 1, AT] - rays[v, 0, AT]) / max(cols - 1, 1)
    if per_col == 0.0:
        return 0, cols
    end0 = (low0 - max(step * j0, step * (j1 - 1)) - rays[v, 0, AT]) / per_col
    end1 = (low1 - min(step * j0, step * (j1 - 1)) - rays[v, 0, AT]) / per_col
    if end1 < end0:
        end0, end1 = end1, end0
    return int(min(max(end0 - 1.0, 0.0), cols)), int(min(max(end1 + 2.0, 0.0), cols))


@njit(inline="always")
def tile_of(axis, y0, y1, x0, x1):
    """How rays cross a tile: planes j0..j1 (excluded), and lower lines low0..low1 (excluded) of the samples that touch
    it.

    It also returns the rows of the tile from plane to plane and from line to line, and the row of the first sample."""
    if axis == 0:
        return y0, y1, x0 - 1, x1, EDGE, 1, EDGE
    return x0, x1, y0 - 1, y1, 1, EDGE, 1


@njit(**OPTIONS)
def _forward(
    volume: F32, rays: F64, steep: Flags, group: int, block: int, first: int, end: int, out: F32
) -> None:  # fmt: skip
    """Jobs first to end; there is one job for each group of projections and block of slices."""
    ny, nx, nz = volume.shape
    views, cols, _ = out.shape
    voxels, lines = volume.reshape(ny * nx, nz), out.reshape(views * cols, nz)
    groups = (views + group - 1) // group
    for job in prange(first, end):
        z0 = job // groups * block
        z1 = min(nz, z0 + block)
        v0 = job % groups * group
        v1 = min(views, v0 + group)
        out[v0:v1, :, z0:z1] = _f(0)
        tile = np.zeros((EDGE * EDGE, block), np.float32)
        at, share = np.empty(TILE, np.int64), np.empty(TILE, np.float32)
        for y0 in range(0, ny, TILE):
            for x0 in range(0, nx, TILE):
                y1, x1 = min(y0 + TILE, ny), min(x0 + TILE, nx)
                for y in range(y0 - 1, y1 + 1):
                    for x in range(x0 - 1, x1 + 1):
                        row, inside = (y - y0 + 1) * EDGE + x - x0 + 1, 0 <= y < ny and 0 <= x < nx
                        for z in range(z0, z1, lanes.WIDTH):
                            count = min(z1 - z, lanes.WIDTH) if inside else 0
                            lanes.store(tile, row, z - z0, lanes.load_first(voxels, y * nx + x, z, count))
                for v in range(v0, v1):
                    axis = 0 if steep[v, 0] else 1
                    j0, j1, low0, low1, across, along, base = tile_of(axis, y0, y1, x0, x1)
                    if low1 < (nx if axis == 0 else ny):
                        low1 -= 1  # samples whose lower line is the last one of the tile belong to the next tile
                    col0, col1 = _columns(rays, v, low0, low1, j0, j1)
                    for col in range(col0, col1):
                        _, n = samples(rays[v, col, 0], rays[v, col, 1], low0, low1, j0, j1, across, along, at, share)
                        if n == 0:
                            continue
                        line = v * cols + col
                        for z in range(z0, z1, lanes.WIDTH):
                            c, count = z - z0, min(z1 - z, lanes.WIDTH)
                            lower, upper = lanes.load_first(lines, line, z, count), lanes.zero()
                            for k in range(n):
                                high, i = share[k], base + at[k]
                                lower = lower + lanes.load(tile, i, c) * (_f(1) - high)
                                upper = upper + lanes.load(tile, i + along, c) * high
                            lanes.store_first(lines, line, z, lower + upper, count)
        for v in range(v0, v1):
            for col in range(cols):
                path = _f(rays[v, col, 4])
                for z in range(z0, z1):
                    out[v, col, z] *= path


@njit(**OPTIONS)
def _adjoint(projections: F32, rays: F64, steep: Flags, block: int, first: int, end: int, volume: F32) -> None:
    """Jobs first to end; there is one job for each tile and block of slices."""
    ny, nx, nz = volume.shape
    views, cols, _ = projections.shape
    voxels, lines = volume.reshape(ny * nx, nz), projections.reshape(views * cols, nz)
    across_x, blocks = (nx + TILE - 1) // TILE, (nz + block - 1) // block
    for job in prange(first, end):
        z0 = job % blocks * block
        z1 = min(nz, z0 + block)
        y0, x0 = job // blocks // across_x * TILE, job // blocks % across_x * TILE
        y1, x1 = min(y0 + TILE, ny), min(x0 + TILE, nx)
        tile = np.zeros((EDGE * EDGE, block), np.float32)
        at, share = np.empty(TILE, np.int64), np.empty(TILE, np.float32)
        for v in range(views):
            axis = 0 if steep[v, 0] else 1
            j0, j1, low0, low1, across, along, base = tile_of(axis, y0, y1, x0, x1)
            col0, col1 = _columns(rays, v, low0, low1, j0, j1)
            for col in range(col0, col1):
                _, n = samples(rays[v, col, 0], rays[v, col, 1], low0, low1, j0, j1, across, along, at, share)
                if n == 0:
                    continue
                path, line = _f(rays[v, col, 4]), v * cols + col
                for z in range(z0, z1, lanes.WIDTH):
                    c = z - z0
                    ray = lanes.load_first(lines, line, z, min(z1 - z, lanes.WIDTH)) * path
                    for k in range(n):
                        high, i = share[k], base + at[k]
                        h = i + along
                        lanes.store(tile, i, c, lanes.load(tile, i, c) + ray * (_f(1) - high))
                        lanes.store(tile, h, c, lanes.load(tile, h, c) + ray * high)
        for y in range(y0, y1):
            for x in range(x0, x1):
                row = (y - y0 + 1) * EDGE + x - x0 + 1
                for z in range(z0, z1, lanes.WIDTH):
                    count = min(z1 - z, lanes.WIDTH)
                    lanes.store_first(voxels, y * nx + x, z, lanes.load(tile, row, z - z0), count)


def shares(views: int, nz: int) -> tuple[int, int]:
    """Projections and slices of one job, so that all threads have work and a pass serves many projections."""
    threads, blocks = get_num_threads(), -(-nz // _BLOCK)
    if blocks % threads == 0 or blocks >= _ENOUGH * threads:  # the blocks of slices alone give all threads work
        return -(-views // -(-views // _GROUP)), _BLOCK
    rounds = -(-views // (_GROUP * threads))
    group = -(-views // (rounds * threads))
    busy = -(-views // group)
    return group, _BLOCK if busy >= threads else max(16, min(_BLOCK, -(-nz // threads)))


def forward(volume: F32, rays: F64, steep: Flags, out: F32) -> None:
    """Line integrals of volume [y, x, z] into out [view, col, z], in mm times the unit of the volume."""
    (views, cols, nz), planes = out.shape, min(volume.shape[:2])
    group, block = shares(views, nz)
    block, voxels = _whole_lanes(nz, block), np.ascontiguousarray(volume)
    for part in calls(-(-views // group) * -(-nz // block), min(group, views) * min(block, nz) * cols * planes):
        _forward(voxels, rays, steep, group, block, part.start, part.stop, out)


def adjoint(projections: F32, rays: F64, steep: Flags, out: F32) -> None:
    """The transpose of `forward`: projections [view, col, z] into out [y, x, z] (overwritten)."""
    (ny, nx, nz), views = out.shape, projections.shape[0]
    block, lines = _whole_lanes(nz, _BLOCK), np.ascontiguousarray(projections)
    jobs = -(-ny // TILE) * -(-nx // TILE) * -(-nz // block)
    for part in calls(jobs, views * TILE**2 * min(block, nz)):
        _adjoint(lines, rays, steep, block, part.start, part.stop, out)


def calls(jobs: int, samples: int) -> list[range]:
    """Divides jobs of `samples` samples each evenly into calls of about `CALL`, with a job for each thread."""
    threads = get_num_threads()
    most = max(threads, CALL // max(samples, 1) // threads * threads)
    return [range(first, min(first + most, jobs)) for first in range(0, jobs, most)]


def _whole_lanes(nz: int, most: int) -> int:
    """Number of slices of one job, at most `most`: whole Lanes, the same for all jobs."""
    jobs = -(-nz // most)
    return -(-nz // (jobs * lanes.WIDTH)) * lanes.WIDTH
