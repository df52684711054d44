"""Cone-beam projector and its adjoint: Joseph's interpolation, sixteen rows or slices at once (numba, threaded).

All rays to one column of the detector lie in one plane parallel to the rotation axis, so they share their path in x and
y. In every plane of voxels that these rays cross, the rays of successive rows meet a line of slices at equal steps. A
ray is sampled once in each plane, bilinearly. Volumes are [y, x, z], projections [view, col, row].

Sixteen rows cross at most 32 neighbouring slices, and sixteen slices at most 32 rows. The kernels pick values from
these 32 (see `picks`). If the steps are longer, fewer rows or slices are processed at once. Tiles of the volume remain
in the cache, as in `cpu.joseph`. The transpose uses the same weights and runs tile by tile, so that no two threads
write to the same voxel.
"""

from __future__ import annotations

import math

import numpy as np
from numba import get_num_threads, njit, prange

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.kernels.cpu import joseph, lanes
from recon.kernels.cpu.activation import F32, OPTIONS
from recon.kernels.cpu.joseph import CALL, EDGE, F64, TILE, Flags, calls, samples, shares, tile_of
from recon.kernels.cpu.picks import NEAR_STEP, bilinear, bilinear_near, lanes_per_window, least, pick, pick_near, whole

_f = np.float32
_WIDTH = lanes.WIDTH
_BLOCK = 64  # largest number of rows or slices of one job
_ZEROS = 2 * _WIDTH + 2  # zeros around a line, so that values picked there are 0
_LEAST = 1e-3  # slices per row; no sample with a smaller step exists, because it would be nearer to the source

# Columns of the table of views. At line y and x of voxels one row is CLIMB + CLIMB_Y y + CLIMB_X x slices high. This,
# divided into SIDE + SIDE_Y y + SIDE_X x, gives columns from MIDDLE_COL. z = 0 is at row MIDDLE and slice HEIGHT.
CLIMB, CLIMB_Y, CLIMB_X, SIDE, SIDE_Y, SIDE_X, MIDDLE_COL, MIDDLE, HEIGHT = range(9)


def ray_table(geometry: Geometry, grid: Grid) -> tuple[F64, Flags, F64]:
    """The rays as in `joseph.ray_table`, and a table of the projections: float64 [view, 9], with the columns above."""
    (_, cy, cx), (nz, ny, nx), h = grid.centre, grid.shape, grid.voxel_size
    x, y, rise = cx - (nx - 1) / 2 * h, cy - (ny - 1) / 2 * h, geometry.pixel_pitch / grid.spacing[0]
    cos, sin = np.cos(geometry.angles), np.sin(geometry.angles)
    views = np.empty((geometry.n_views, 9))
    views[:, CLIMB] = geometry.sod - x * sin + y * cos
    views[:, CLIMB_Y], views[:, CLIMB_X] = h * cos, -h * sin
    views[:, :SIDE] *= rise / geometry.sdd
    views[:, SIDE], views[:, SIDE_Y], views[:, SIDE_X] = x * cos + y * sin, h * sin, h * cos
    views[:, SIDE:MIDDLE_COL] /= grid.spacing[0]
    views[:, MIDDLE_COL] = geometry.axis_col + geometry.shifts[:, 0]
    views[:, MIDDLE] = geometry.axis_row + geometry.shifts[:, 1]
    views[:, HEIGHT] = (nz - 1) / 2 - grid.centre[0] / grid.spacing[0]
    return *joseph.ray_table(geometry, grid), views


@njit(inline="always")
def _box(view, y0, y1, x0, x1):
    """Smallest and largest climb, and first and last position of the columns, over lines y0 - 1..y1 and x0 - 1..x1."""
    low, high, left, right = math.inf, _LEAST, math.inf, -math.inf
    for corner in range(4):
        y, x = y0 - 1 if corner < 2 else y1, x0 - 1 if corner % 2 else x1
        climb = max(view[0] + view[1] * y + view[2] * x, _LEAST)
        col = view[6] + (view[3] + view[4] * y + view[5] * x) / climb
        low, high, left, right = min(low, climb), max(high, climb), min(left, col), max(right, col)
    if low <= _LEAST:
        left, right = -math.inf, math.inf
    return low, high, left, right


@njit(inline="always")
def _columns(view, y0, y1, x0, x1, cols):
    """Columns first..end (excluded) beyond which no ray has samples in a tile."""
    _, _, left, right = _box(view, y0, y1, x0, x1)
    return math.floor(min(max(left, 0.0), cols)), math.floor(min(max(right + 2.0, 0.0), cols))


@njit(cache=True)
def _slices(views, row0, row1, y0, y1, x0, x1, nz):
    """Slices first..end (excluded) of a tile that the rays of rows row0..row1 (excluded) cross, and the zeros before
    them."""
    bottom, top = math.inf, -math.inf
    for v in range(len(views)):
        low, high, _, _ = _box(views[v], y0, y1, x0, x1)
        first, last, height = row0 - views[v, 7], row1 - 1 - views[v, 7], views[v, 8]
        bottom = min(bottom, height + min(first * low, first * high))
        top = max(top, height + max(last * low, last * high))
    return math.floor(min(max(bottom, -1.0 * _ZEROS), nz)), math.floor(min(max(top + 2.0, -1.0 * _ZEROS), nz))


@njit(cache=True)
def _room(views, row0, row1, shape):
    """Largest number of slices of a tile that the rays of rows row0..row1 (excluded) cross, with zeros: an odd number
    of Lanes."""
    most = 0
    for y0 in range(0, shape[0], TILE):
        for x0 in range(0, shape[1], TILE):
            y1, x1 = min(y0 + TILE, shape[0]), min(x0 + TILE, shape[1])
            first, end = _slices(views, row0, row1, y0, y1, x0, x1, shape[2])
            most = max(most, end - first)
    return ((most + _ZEROS) // _WIDTH + 2 | 1) * _WIDTH


@njit(**OPTIONS)
def _forward(
    volume: F32, rays: F64, steep: Flags, views: F64, group: int, start: int, end: int, out: F32
) -> None:  # fmt: skip
    """Jobs start to end; there is one job for each group of projections and block of rows."""
    ny, nx, nz = volume.shape
    _, cols, rows = out.shape
    voxels, lines = volume.reshape(ny * nx, nz), out.reshape(out.shape[0] * cols, rows)
    groups = (len(views) + group - 1) // group
    for job in prange(start, end):
        row0 = job // groups * _BLOCK
        row1 = min(rows, row0 + _BLOCK)
        v0 = job % groups * group
        v1 = min(len(views), v0 + group)
        out[v0:v1, :, row0:row1] = _f(0)
        tile = np.zeros((EDGE * EDGE, _room(views[v0:v1], row0, row1, volume.shape)), np.float32)
        at, share = np.empty(TILE, np.int64), np.empty(TILE, np.float32)
        climbs, steps = np.empty(TILE), np.empty(TILE, np.float32)
        slices, far = np.empty(TILE, np.int32), np.empty(TILE, np.float32)
        for y0 in range(0, ny, TILE):
            for x0 in range(0, nx, TILE):
                y1, x1 = min(y0 + TILE, ny), min(x0 + TILE, nx)
                z0, z1 = _slices(views[v0:v1], row0, row1, y0, y1, x0, x1, nz)
                if z1 <= max(z0, 0):
                    continue
                for y in range(y0 - 1, y1 + 1):
                    for x in range(x0 - 1, x1 + 1):
                        row, inside = (y - y0 + 1) * EDGE + x - x0 + 1, 0 <= y < ny and 0 <= x < nx
                        for z in range(z0, 0, _WIDTH):
                            lanes.store(tile, row, z - z0, lanes.zero())
                        for z in range(max(z0, 0), z1 + _ZEROS, _WIDTH):
                            count = max(min(nz - z, _WIDTH), 0) if inside else 0
                            lanes.store(tile, row, z - z0, lanes.load_first(voxels, y * nx + x, z, count))
                for v in range(v0, v1):
                    col0, col1 = _columns(views[v], y0, y1, x0, x1, cols)
                    for col in range(col0, col1):
                        axis = 0 if steep[v, col] else 1
                        j0, j1, low0, low1, across, along, base = tile_of(axis, y0, y1, x0, x1)
                        if low1 < (nx if axis == 0 else ny):
                            low1 -= 1  # samples whose lower line is the last one of the tile belong to the next tile
                        j, n = samples(rays[v, col, 0], rays[v, col, 1], low0, low1, j0, j1, across, along, at, share)
                        if n == 0:
                            continue
                        line, highest = v * cols + col, _climbs(rays, v, col, j, n, climbs, steps)[1]
                        wide = _count_at_once(1.0 / highest)
                        for row in range(row0, row1, wide):
                            count = min(row1 - row, wide)
                            for k in range(n):
                                level = views[v, 8] + climbs[k] * (row - views[v, 7])
                                whole_level = min(max(np.floor(level), z0 * 1.0), z1 * 1.0)
                                slices[k], far[k] = np.int32(whole_level - z0), level - whole_level
                            total = lanes.load_first(lines, line, row, count)
                            for k in range(n):
                                i, z, high = base + at[k], slices[k], share[k]
                                level = lanes.iota() * steps[k] + far[k]
                                if steps[k] <= NEAR_STEP:
                                    total = total + bilinear_near(tile, i, i + along, high, z, level)
                                else:
                                    total = total + bilinear(tile, i, i + along, high, z, level)
                            lanes.store_first(lines, line, row, total, count)
        for v in range(v0, v1):
            for col in range(cols):
                for row in range(row0, row1):
                    slope = (row - views[v, 7]) * rays[v, col, 5]
                    out[v, col, row] *= _f(rays[v, col, 4] * math.sqrt(1.0 + slope * slope))


@njit(inline="always")
def _count_at_once(apart):
    """Number of rows or slices that are processed at once, if the position moves by 1 / apart from one to the next."""
    lanes_sharing = lanes_per_window()
    steps = (2 * lanes_sharing - 3) * apart  # number that fits into a window, including rounding and one more value
    return _WIDTH if steps >= lanes_sharing - 1 else math.floor(steps + 1.0)


@njit(inline="always")
def _climbs(rays, v, col, j, n, climbs, steps):
    """Slices per row at samples 0..n of a ray from plane j on; returns the smallest and the largest."""
    for k in range(n):
        climbs[k] = max(rays[v, col, 2] + rays[v, col, 3] * (j + k), _LEAST)
        steps[k] = climbs[k]
    return min(climbs[0], climbs[n - 1]), max(climbs[0], climbs[n - 1])


@njit(inline="always")
def _ray(lines, line, path, lean, middle, low, high, margin, ray):
    """Rows low..high (excluded) of a ray, times its path from plane to plane, with zeros around them.

    The path is longer if the ray is inclined to the mid-plane.
    """
    for i in range(0, margin, _WIDTH):
        lanes.store(ray, 0, i, lanes.zero())
    for row in range(low, high, _WIDTH):
        slope = lanes.iota() * lean + (row - middle) * lean
        length = lanes.root(slope * slope + _f(1)) * path
        found = lanes.load_first(lines, line, row, min(high - row, _WIDTH)) * length
        lanes.store(ray, 0, margin + row - low, found)
    for i in range(margin + high - low, 2 * margin + high - low, _WIDTH):
        lanes.store(ray, 0, i, lanes.zero())


@njit(**OPTIONS)
def _adjoint(
    projections: F32, rays: F64, steep: Flags, views: F64, block: int, start: int, end: int, volume: F32
) -> None:  # fmt: skip
    """Jobs start to end; there is one job for each tile and block of slices."""
    ny, nx, nz = volume.shape
    _, cols, rows = projections.shape
    voxels, lines = volume.reshape(ny * nx, nz), projections.reshape(len(views) * cols, rows)
    across_x, blocks = (nx + TILE - 1) // TILE, (nz + block - 1) // block
    for job in prange(start, end):
        z0 = job % blocks * block
        z1 = min(nz, z0 + block)
        y0, x0 = job // blocks // across_x * TILE, job // blocks % across_x * TILE
        y1, x1 = min(y0 + TILE, ny), min(x0 + TILE, nx)
        tile = np.zeros((EDGE * EDGE, block + _WIDTH), np.float32)
        at, share = np.empty(TILE, np.int64), np.empty(TILE, np.float32)
        climbs, steps, back = np.empty(TILE), np.empty(TILE, np.float32), np.empty(TILE, np.float32)
        first, far = np.empty(TILE, np.int32), np.empty(TILE, np.float32)
        lowest = math.inf
        for v in range(len(views)):
            lowest = min(lowest, _box(views[v], y0, y1, x0, x1)[0])
        margin = _ZEROS + math.ceil(2.0 / lowest) + 1
        ray = np.empty((1, rows + 2 * (margin + _WIDTH)), np.float32)
        for v in range(len(views)):
            low, high, _, _ = _box(views[v], y0, y1, x0, x1)
            middle, bottom, top = views[v, 7], z0 - 1 - views[v, 8], z1 - views[v, 8]
            low_row = math.floor(min(max(middle + min(bottom / low, bottom / high), 0.0), rows))
            high_row = math.floor(min(max(middle + max(top / low, top / high) + 2.0, 0.0), rows))
            if high_row <= low_row:
                continue
            col0, col1 = _columns(views[v], y0, y1, x0, x1, cols)
            for col in range(col0, col1):
                axis = 0 if steep[v, col] else 1
                j0, j1, low0, low1, across, along, base = tile_of(axis, y0, y1, x0, x1)
                j, n = samples(rays[v, col, 0], rays[v, col, 1], low0, low1, j0, j1, across, along, at, share)
                if n == 0:
                    continue
                low, high = _climbs(rays, v, col, j, n, climbs, steps)
                path, lean = _f(rays[v, col, 4]), _f(rays[v, col, 5])
                _ray(lines, v * cols + col, path, lean, _f(middle), low_row, high_row, margin, ray)
                for k in range(n):
                    back[k] = 1.0 / climbs[k]
                wide = _count_at_once(low)
                most = math.floor(2.0 / low) + 1  # rows within one slice of any of these slices
                for z in range(z0, z1, wide):
                    for k in range(n):
                        edge = middle + (z - 1 - views[v, 8]) / climbs[k]
                        row = min(max(np.ceil(edge), low_row - margin * 1.0), high_row * 1.0)
                        first[k], far[k] = np.int32(row - (low_row - margin)), edge - row + 1.0
                    for k in range(n):
                        c, step, height = first[k], z - z0, steps[k]
                        places = lanes.iota() * back[k] + far[k]
                        weight = (whole(places) - places) * height + height  # slices from the lower end to that row
                        if low >= 1.0 / NEAR_STEP and high <= 2.0:
                            beyond = _f(2) - weight
                            found = pick_near(ray, 0, c, places, 0) * least(weight, beyond)
                            found = found + pick_near(ray, 0, c, places, 1) * lanes.positive(beyond - height)
                        elif most == 3 and high <= 1.0:
                            further = weight + height
                            beyond = _f(2) - further
                            found = pick(ray, 0, c, places, 0) * weight
                            found = found + pick(ray, 0, c, places, 1) * least(further, beyond)
                            found = found + pick(ray, 0, c, places, 2) * lanes.positive(beyond - height)
                        else:
                            found = pick(ray, 0, c, places, 0) * lanes.positive(least(weight, _f(2) - weight))
                            for m in range(1, most):
                                weight = weight + height
                                found = found + pick(ray, 0, c + m, places, 0) * lanes.positive(
                                    least(weight, _f(2) - weight)
                                )
                        if wide < _WIDTH:
                            found = lanes.between(found, 0, wide)
                        i = base + at[k]
                        h, up = i + along, found * share[k]
                        lanes.store(tile, i, step, lanes.load(tile, i, step) + (found - up))
                        lanes.store(tile, h, step, lanes.load(tile, h, step) + up)
        for y in range(y0, y1):
            for x in range(x0, x1):
                row = (y - y0 + 1) * EDGE + x - x0 + 1
                for z in range(z0, z1, _WIDTH):
                    lanes.store_first(voxels, y * nx + x, z, lanes.load(tile, row, z - z0), min(z1 - z, _WIDTH))


def forward(volume: F32, rays: F64, steep: Flags, views: F64, out: F32) -> None:
    """Line integrals of volume [y, x, z] into out [view, col, row], mm times the volume's unit; see `ray_table`."""
    (count, cols, rows), voxels = out.shape, np.ascontiguousarray(volume)
    of_view = cols * min(_BLOCK, rows) * min(volume.shape[:2])
    # One pass over the volume serves few projections if a call would otherwise take more than about half a second.
    group = max(1, min(shares(count, 1)[0], 4 * CALL // (of_view * get_num_threads())))
    for part in calls(-(-count // group) * -(-rows // _BLOCK), group * of_view):
        _forward(voxels, rays, steep, views, group, part.start, part.stop, out)


def adjoint(projections: F32, rays: F64, steep: Flags, views: F64, out: F32) -> None:
    """The transpose of `forward`: projections [view, col, row] into out [y, x, z] (overwritten)."""
    (ny, nx, nz), lines = out.shape, np.ascontiguousarray(projections)
    block = -(-nz // (-(-nz // _BLOCK) * _WIDTH)) * _WIDTH
    jobs = -(-ny // TILE) * -(-nx // TILE) * -(-nz // block)
    for part in calls(jobs, len(views) * TILE**2 * min(block, nz)):
        _adjoint(lines, rays, steep, views, block, part.start, part.stop, out)
