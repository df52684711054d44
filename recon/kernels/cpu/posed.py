"""Projector of rolled and tilted projections, and its adjoint: Joseph's interpolation for every ray (numba, threaded).

With roll, tilt or centres, the rays to one column are not in one plane, so each ray has its own weights. A ray is
sampled once in every plane of voxels across one axis: the axis closest to the ray at the middle of its column. In a
plane, voxel coordinates are ratios of linear functions of the row, so a short table for each column serves all its
rays. Volumes are [y, x, z], projections [view, col, row]. The transpose reads the same weights and runs plane by plane,
so that no two threads write to the same voxel.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.kernels.cpu.activation import F32, OPTIONS
from recon.kernels.cpu.joseph import F64, calls

_f = np.float32
_COLS = 16  # columns of one job
_FLAT = 1e-15  # voxels per row; with a smaller step, a line of samples stays at its position
_LEAST = 0.05  # least share of the run across the planes, relative to the run in the middle of a column

Axes = NDArray[np.int8]


def ray_table(geometry: Geometry, grid: Grid) -> tuple[F64, Axes]:
    """The path of the rays of every column: float64 [view, col, 12], and the axis across its planes, int8 [view, col].

    The axis is 0 for planes of constant y, 1 for x, 2 for z. The other two are (x, z), (y, z) or (y, x), in this order.
    In plane j the ray to a row is at voxel (t0 + t1 j + (t2 + t3 j) row) / (1 + t8 row) of the first one. For the
    second one, t4 to t7 replace t0 to t3. The path of the ray from plane to plane is sqrt(t9 + t10 row + t11 row²) / (1
    + t8 row) mm.

    Raises:
        ValueError: rays of one column differ so much that they do not cross the same planes.
    """
    views, (rows, cols) = geometry.n_views, geometry.detector_shape
    axes = np.stack([geometry.axes(view) for view in range(views)])
    origin = np.array([geometry.origin(view) for view in range(views)])
    along_col, along_row, beam = (axes[:, k, ::-1] for k in range(3))  # (z, y, x), as the grid
    pitch, edges = geometry.pixel_pitch, np.array(grid.spacing)
    offset = (np.arange(cols) - origin[:, :1]) * pitch  # [view, col]
    at_row_0 = offset[..., None] * along_col[:, None] - (origin[:, 1] * pitch)[:, None, None] * along_row[:, None]
    a_row = np.broadcast_to(along_row[:, None] * pitch, at_row_0.shape)
    beams, nothing = np.broadcast_to(beam[:, None], at_row_0.shape), np.zeros_like(at_row_0)
    if geometry.is_cone:
        start, start_row = geometry.centres[:, None, ::-1] - geometry.sod * beams, nothing
        run, run_row = at_row_0 + geometry.sdd * beams, a_row
    else:
        start, start_row, run, run_row = at_row_0, a_row, beams, nothing
    middle = np.abs(run + (rows - 1) / 2 * run_row)
    across = np.where(middle[..., 1] >= middle[..., 2], 1, 2)  # of (z, y, x)
    across = np.where(middle[..., 0] > middle[..., 1:].max(axis=-1), 0, across)
    length = np.stack([(run * run).sum(-1), 2 * (run * run_row).sum(-1), (run_row * run_row).sum(-1)], axis=-1)
    start = (start - np.array(grid.first)) / edges  # in voxels from the first one
    start_row, run, run_row = start_row / edges, run / edges, run_row / edges

    def along(of: F64, axis: NDArray[np.int64]) -> F64:
        return np.take_along_axis(of, axis[..., None], axis=-1)[..., 0]

    planes = along(run, across)
    narrow = along(run_row, across) / planes
    last = 1 + narrow * (rows - 1)
    if (np.minimum(last, 1) < _LEAST * (1 + last) / 2).any():
        raise ValueError(
            "use a narrower cone or fewer rows: with this tilt, rays of one detector column differ in direction by "
            "almost a right angle"
        )
    table = np.empty((views, cols, 12))
    for part, axis in ((0, np.where(across == 2, 1, np.where(across == 1, 2, 1))), (4, np.where(across == 0, 2, 0))):
        first, slope, slope_row = along(start, axis), along(run, axis) / planes, along(run_row, axis) / planes
        from_plane = along(start, across)
        table[..., part] = first - from_plane * slope
        table[..., part + 1] = slope
        table[..., part + 2] = along(start_row, axis) - along(start_row, across) * slope
        table[..., part + 2] += first * narrow - from_plane * slope_row
        table[..., part + 3] = slope_row
    table[..., 8] = narrow
    table[..., 9:] = length / planes[..., None] ** 2
    return table, np.array((2, 0, 1), np.int8)[across]


@njit(inline="always", error_model="numpy")
def _crossed(n0, n1, narrow, low, high, first, end):
    """Rows first..end (excluded) in which low < (n0 + n1 row) / (1 + narrow row) < high."""
    for _ in range(2):
        at, slope = n0 - low, n1 - low * narrow
        if slope > _FLAT:
            first = max(first, -at / slope)
        elif slope < -_FLAT:
            end = min(end, -at / slope + 1.0)
        elif at <= 0.0:
            end = 0.0
        n0, n1, low = -n0, -n1, -high
    return first, end


@njit(inline="always", error_model="numpy")
def _rows(t, j, n_b, n_c, rows):
    """Rows first..end (excluded) of a column whose samples in plane j are less than one voxel outside the plane."""
    b0, b1, c0, c1 = t[0] + t[1] * j, t[2] + t[3] * j, t[4] + t[5] * j, t[6] + t[7] * j
    first, end = _crossed(b0, b1, t[8], -1.0, n_b, 0.0, rows * 1.0)
    first, end = _crossed(c0, c1, t[8], -1.0, n_c, first, end)
    first, end = math.ceil(min(first, rows * 1.0)), math.floor(max(end, 0.0))
    return first, max(first, end)


@njit(inline="always")
def _strides(axis, ny, nx, nz):
    """Voxels along the three coordinates (plane, b, c), and the distance of neighbours in memory along them."""
    if axis == 0:
        return ny, nx, nz, nx * nz, nz, 1
    if axis == 1:
        return nx, ny, nz, nz, nx * nz, 1
    return nz, ny, nx, 1, nx * nz, nz


@njit(inline="always", fastmath=True, error_model="numpy")
def _samples(t, j, row0, row1, n_b, n_c, of_b, of_c, at, low_b, high_b, low_c, high_c):
    """The samples of rows row0..row1 (excluded) of a column in plane j, as arrays from row0 on.

    at: the first of four voxels. low, high: weights of the lower and the upper line, and of their voxels. A line beyond
    the last one has weight 0, so samples outside the outermost lines use only these.
    """
    b0, b1, c0, c1, narrow = t[0] + t[1] * j, t[2] + t[3] * j, t[4] + t[5] * j, t[6] + t[7] * j, t[8]
    last_b, last_c = max(n_b - 2, 0), max(n_c - 2, 0)
    up_b, up_c = _f(min(n_b - 1, 1)), _f(min(n_c - 1, 1))
    for s in range(row1 - row0):
        row = row0 + s
        scale = 1.0 / (1.0 + narrow * row)
        b, c = (b0 + b1 * row) * scale, (c0 + c1 * row) * scale
        i, k = min(max(np.int32(b), np.int32(0)), last_b), min(max(np.int32(c), np.int32(0)), last_c)
        p, q = _f(b - i), _f(c - k)
        at[s] = i * of_b + k * of_c
        low_b[s], high_b[s] = max(_f(1) - abs(p), _f(0)), max(_f(1) - abs(p - _f(1)), _f(0)) * up_b
        low_c[s], high_c[s] = max(_f(1) - abs(q), _f(0)), max(_f(1) - abs(q - _f(1)), _f(0)) * up_c


@njit(**OPTIONS)
def _forward(voxels: F32, shape: tuple[int, int, int], rays: F64, axes: Axes, start: int, end: int, out: F32) -> None:
    """Jobs start to end; there is one job for each projection and block of columns."""
    _, cols, rows = out.shape
    blocks = (cols + _COLS - 1) // _COLS
    for job in prange(start, end):
        v, first_col = job // blocks, job % blocks * _COLS
        last_col = min(first_col + _COLS, cols)
        out[v, first_col:last_col] = _f(0)
        at, weights = np.empty(rows, np.int64), np.empty((4, rows), np.float32)
        low_b, high_b, low_c, high_c = weights[0], weights[1], weights[2], weights[3]
        for axis in range(3):
            planes, n_b, n_c, of_plane, of_b, of_c = _strides(axis, shape[0], shape[1], shape[2])
            along_b, along_c = of_b * min(n_b - 1, 1), of_c * min(n_c - 1, 1)
            for j in range(planes):
                for col in range(first_col, last_col):
                    if axes[v, col] != axis:
                        continue
                    row0, row1 = _rows(rays[v, col], j, n_b, n_c, rows)
                    _samples(rays[v, col], j, row0, row1, n_b, n_c, of_b, of_c, at, low_b, high_b, low_c, high_c)
                    target, plane = out[v, col, row0:row1], voxels[j * of_plane :]
                    for s in range(row1 - row0):
                        i = at[s]
                        h = i + along_b
                        target[s] += low_b[s] * (low_c[s] * plane[i] + high_c[s] * plane[i + along_c]) + high_b[s] * (
                            low_c[s] * plane[h] + high_c[s] * plane[h + along_c]
                        )
        for col in range(first_col, last_col):
            _lengthen(out[v, col], out[v, col], rays[v, col])


@njit(inline="always", fastmath=True)
def _lengthen(source, out, t):
    """out = source times the path of each ray from plane to plane."""
    for row in range(out.size):
        out[row] = source[row] * _f(math.sqrt(t[9] + row * (t[10] + row * t[11])) / (1.0 + t[8] * row))


@njit(**OPTIONS)
def _weigh(projections: F32, rays: F64, out: F32) -> None:
    views, cols, _ = projections.shape
    for job in prange(views * cols):
        v, col = job // cols, job % cols
        _lengthen(projections[v, col], out[v, col], rays[v, col])


@njit(**OPTIONS)
def _adjoint(
    weighed: F32, shape: tuple[int, int, int], rays: F64, axes: Axes, axis: int, start: int, end: int, voxels: F32
) -> None:  # fmt: skip
    """Planes start to end across one axis, added to the voxels."""
    views, cols, rows = weighed.shape
    _, n_b, n_c, of_plane, of_b, of_c = _strides(axis, shape[0], shape[1], shape[2])
    along_b, along_c = of_b * min(n_b - 1, 1), of_c * min(n_c - 1, 1)
    for j in prange(start, end):
        at, weights = np.empty(rows, np.int64), np.empty((4, rows), np.float32)
        low_b, high_b, low_c, high_c = weights[0], weights[1], weights[2], weights[3]
        plane = voxels[j * of_plane :]
        for v in range(views):
            for col in range(cols):
                if axes[v, col] != axis:
                    continue
                row0, row1 = _rows(rays[v, col], j, n_b, n_c, rows)
                _samples(rays[v, col], j, row0, row1, n_b, n_c, of_b, of_c, at, low_b, high_b, low_c, high_c)
                source = weighed[v, col, row0:row1]
                for s in range(row1 - row0):
                    i = at[s]
                    h = i + along_b
                    low, high = low_b[s] * source[s], high_b[s] * source[s]
                    plane[i] += low * low_c[s]
                    plane[i + along_c] += low * high_c[s]
                    plane[h] += high * low_c[s]
                    plane[h + along_c] += high * high_c[s]


def forward(volume: F32, rays: F64, axes: Axes, out: F32) -> None:
    """Line integrals of volume [y, x, z] into out [view, col, row], mm times the volume's unit; see `ray_table`."""
    views, cols, rows = out.shape
    voxels, jobs = np.ascontiguousarray(volume).reshape(-1), views * -(-cols // _COLS)
    for part in calls(jobs, 8 * _COLS * rows * min(volume.shape[:2])):
        _forward(voxels, volume.shape, rays, axes, part.start, part.stop, out)


def adjoint(projections: F32, rays: F64, axes: Axes, out: F32) -> None:
    """The transpose of `forward`: projections [view, col, row] into out [y, x, z], contiguous (overwritten).

    Needs memory for one copy of the projections.
    """
    weighed, voxels = np.empty(projections.shape, np.float32), out.reshape(-1)
    _weigh(projections, rays, weighed)
    out[...] = 0
    for axis in np.unique(axes):
        for part in calls(out.shape[(0, 1, 2)[axis]], 8 * projections.size):
            _adjoint(weighed, out.shape, rays, axes, int(axis), part.start, part.stop, voxels)
