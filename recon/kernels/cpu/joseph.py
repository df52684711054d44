"""Parallel-beam projector and its adjoint: Joseph's interpolation, the slices of a volume fastest (numba, threaded).

A ray is sampled once in every plane of voxels across the axis that is closest to its direction, by linear
interpolation between the two nearest lines (P. M. Joseph 1982, IEEE Trans. Med. Imaging 1, 192). Volumes are [y, x, z]
and projections [view, col, row] here, so one pair of weights serves a whole line of slices. Both directions read their
weights from one table of rays, so each is the exact transpose of the other; the transpose runs plane by plane, and no
two threads write to one voxel.
"""

from __future__ import annotations

import math

import numpy as np
from numba import get_num_threads, njit, prange
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.kernels.cpu.activation import F32, OPTIONS

F64 = NDArray[np.float64]
Flags = NDArray[np.bool_]
_f = np.float32

# Columns of the table of rays. A ray crosses plane j at line AT + STEP j, where one detector row is RISE + CLIMB j
# slices high; it runs PATH mm from plane to plane, and REACH mm from the source to the detector (both in the plane).
AT, STEP, RISE, CLIMB, PATH, REACH = range(6)

_BLOCK = 256  # slices of one job
_GROUP = 16  # views that share one pass over the volume


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
    reach = np.hypot(run_x, run_y)
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
    table[..., REACH] = reach
    return table, steep


@njit(**OPTIONS)
def _forward(lines: F32, shape: tuple[int, int], rays: F64, steep: Flags, group: int, block: int, out: F32) -> None:
    nz = lines.shape[1]
    views, cols, _ = out.shape
    groups, blocks = (views + group - 1) // group, (nz + block - 1) // block
    for job in prange(groups * blocks):
        z0 = job // groups * block
        z1 = min(nz, z0 + block)
        v0 = job % groups * group
        v1 = min(views, v0 + group)
        out[v0:v1, :, z0:z1] = _f(0)
        for axis in range(2):
            planes, n = shape[axis], shape[1 - axis]
            plane_stride, line_stride = (shape[1], 1) if axis == 0 else (1, shape[1])
            for j in range(planes):
                for v in range(v0, v1):
                    for col in range(cols):
                        if steep[v, col] == axis:
                            continue
                        at = rays[v, col, 0] + rays[v, col, 1] * j
                        if not (at > -1.0 and at < n):
                            continue
                        low = math.floor(at)
                        high_part = _f(at - low)
                        low_part = _f(1) - high_part if low >= 0 else _f(0)
                        if low + 1 >= n:
                            high_part = _f(0)
                        first = j * plane_stride
                        a = lines[first + max(low, 0) * line_stride, z0:z1]
                        b = lines[first + min(low + 1, n - 1) * line_stride, z0:z1]
                        target = out[v, col, z0:z1]
                        for z in range(z1 - z0):
                            target[z] += low_part * a[z] + high_part * b[z]
        for v in range(v0, v1):
            for col in range(cols):
                path = _f(rays[v, col, 4])
                target = out[v, col, z0:z1]
                for z in range(z1 - z0):
                    target[z] *= path


@njit(**OPTIONS)
def _adjoint(projections: F32, rays: F64, steep: Flags, shape: tuple[int, int], block: int, lines: F32) -> None:
    nz = lines.shape[1]
    views, cols, _ = projections.shape
    blocks = (nz + block - 1) // block
    for axis in range(2):
        planes, n = shape[axis], shape[1 - axis]
        plane_stride, line_stride = (shape[1], 1) if axis == 0 else (1, shape[1])
        for job in prange(planes * blocks):
            j = job % planes
            z0 = job // planes * block
            z1 = min(nz, z0 + block)
            if axis == 0:
                lines[j * plane_stride : j * plane_stride + n, z0:z1] = _f(0)
            for v in range(views):
                if steep[v, 0] == axis:  # parallel rays are all closest to the same axis
                    continue
                path = _f(rays[v, 0, 4])
                start = rays[v, 0, 0] + rays[v, 0, 1] * j
                per_col = (rays[v, cols - 1, 0] - rays[v, 0, 0]) / max(cols - 1, 1)
                for i in range(n):
                    col0, col1 = 0, cols
                    if per_col != 0.0:
                        middle, half = (i - start) / per_col, 1.0 / abs(per_col)
                        if not (middle + half >= 0.0 and middle - half <= cols - 1):
                            continue
                        col0, col1 = max(0, math.ceil(middle - half)), min(cols, math.floor(middle + half) + 1)
                    target = lines[j * plane_stride + i * line_stride, z0:z1]
                    for col in range(col0, col1):
                        part = _f(1.0 - abs(rays[v, col, 0] + rays[v, col, 1] * j - i)) * path
                        if part > _f(0):
                            source = projections[v, col, z0:z1]
                            for z in range(z1 - z0):
                                target[z] += part * source[z]


def shares(views: int, nz: int) -> tuple[int, int]:
    """Views and slices of one job, so that all threads have work and one pass over the volume serves many views."""
    threads = get_num_threads()
    rounds = -(-views // (_GROUP * threads))
    group = -(-views // (rounds * threads))
    busy = -(-views // group)
    return group, _BLOCK if busy >= threads else max(16, min(_BLOCK, -(-nz // threads)))


def forward(volume: F32, rays: F64, steep: Flags, out: F32) -> None:
    """Line integrals of volume [y, x, z] into out [view, col, z], in mm times the unit of the volume."""
    group, block = shares(out.shape[0], out.shape[2])
    _forward(volume.reshape(-1, volume.shape[2]), volume.shape[:2], rays, steep, group, block, out)


def adjoint(projections: F32, rays: F64, steep: Flags, out: F32) -> None:
    """The transpose of `forward`: projections [view, col, z] into out [y, x, z] (overwritten)."""
    _adjoint(projections, rays, steep, out.shape[:2], _BLOCK, out.reshape(-1, out.shape[2]))
