"""Projector of one slice and its adjoint: Joseph's interpolation, sixteen lines of voxels at once (numba, threaded).

The kernels for many slices process sixteen slices at once; for one slice, fifteen of sixteen lanes would be idle. All
rays lie in the plane of the slice: a parallel beam, or a fan. Slices are [y, x], projections [view, col]. A ray is
sampled once in every line of voxels across its axis, as the table of `cpu.joseph` says.

Sixteen neighbouring lines form a band. The kernel shifts the lines of a band by whole voxels so that rays of one
direction are upright, and then transposes the band. The sixteen samples of a ray are then between four rows of the
band. Rays of a fan form groups with about the same direction. The transpose reads the same weights band by band, so
that no two threads write to the same voxel.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from recon.kernels.cpu import lanes
from recon.kernels.cpu.activation import F32, OPTIONS
from recon.kernels.cpu.joseph import F64, Flags, calls

_f = np.float32
_BAND = lanes.WIDTH
# voxels per line; the slopes of rays of a group differ by less, so these rays stay within one voxel of each other in a
# band
_ALIKE = 1 / 16
_BEFORE, _BEHIND = 2 * _BAND, 4 * _BAND  # zeros around a line


@njit(inline="always")
def _group(rays, steep, v, axis, col):
    """The next columns first..end (excluded), from `col` on, whose rays cross these lines in about one direction."""
    cols = steep.shape[1]
    while col < cols and steep[v, col] == axis:
        col += 1
    first = col
    while col < cols and steep[v, col] != axis and abs(rays[v, col, 1] - rays[v, first, 1]) < _ALIKE:
        col += 1
    return first, col


@njit(inline="always")
def _crossing(rays, v, first, end, j, n):
    """Columns low..high (excluded) of a group whose rays may have samples in the band from line j on."""
    middle = j + _BAND / 2
    rising = rays[v, end - 1, 0] + rays[v, end - 1, 1] * middle >= rays[v, first, 0] + rays[v, first, 1] * middle
    low = first
    for side in range(2):
        bound = -1.0 - _BAND / 2 if rising == (side == 0) else n + _BAND / 2
        a, b = low if side == 1 else first, end
        while a < b:
            col = (a + b) // 2
            beyond = rays[v, col, 0] + rays[v, col, 1] * middle >= bound
            if beyond == rising:
                b = col
            else:
                a = col + 1
        if side == 0:
            low = a
    return low, a


@njit(inline="always")
def _shifts_of_lines(rays, v, first, end, shifts, offsets):
    """Number of voxels by which each line of a band is shifted for this group of rays."""
    step = (rays[v, first, 1] + rays[v, end - 1, 1]) / 2
    for i in range(_BAND):
        shifts[i] = round(step * i)
        offsets[0, i] = -shifts[i]


@njit(inline="always")
def _row_and_distance(rays, v, col, j):
    """The first of the four rows between which a ray runs, and the distance of the ray from it in line j, for the first
    lane.

    If a ray meets a voxel exactly, compiled calls may round differently, and rows then differ by one.
    """
    position = rays[v, col, 0] + rays[v, col, 1] * j
    row = math.floor(position - 1.0)
    return row, _f(position - row)


@njit(**OPTIONS)
def _forward(ys: F32, xs: F32, shape: tuple[int, int], rays: F64, steep: Flags, start: int, end: int, out: F32) -> None:
    """Views start to end, through lines along x [y, x] and lines along y [x, y], both padded."""
    cols = out.shape[1]
    for v in prange(start, end):
        band = np.empty((max(ys.shape[1], xs.shape[1]), _BAND), np.float32)
        total = np.zeros((cols, _BAND), np.float32)
        shifts, offsets = np.empty(_BAND, np.intp), np.empty((1, _BAND), np.float32)
        for axis in range(2):
            lines = ys if axis == 0 else xs
            first, last = _group(rays, steep, v, axis, 0)
            while first < last:
                _shifts_of_lines(rays, v, first, last, shifts, offsets)
                for j in range(0, lines.shape[0], _BAND):
                    low, high = _crossing(rays, v, first, last, j, shape[1 - axis])
                    if high <= low:
                        continue
                    row_low = _row_and_distance(rays, v, low, j)[0]
                    row_high = _row_and_distance(rays, v, high - 1, j)[0]
                    top, bottom = min(row_low, row_high) - 1, max(row_low, row_high) + 5  # see _row_and_distance
                    for row in range(0, bottom - top, _BAND):
                        lanes.load_transposed(lines, j, _BEFORE + top + row, shifts, band, row)
                    offset = lanes.load(offsets, 0, 0)
                    for col in range(low, high):
                        row, distance = _row_and_distance(rays, v, col, j)
                        row -= top
                        position = lanes.iota() * _f(rays[v, col, 1]) + offset + distance
                        a, b = lanes.load(band, row, 0), lanes.load(band, row + 1, 0)
                        c, d = lanes.load(band, row + 2, 0), lanes.load(band, row + 3, 0)
                        value = a + (b - a) * lanes.clamp(position, _f(0), _f(1))
                        value = value + (c - b) * lanes.clamp(position - _f(1), _f(0), _f(1))
                        value = value + (d - c) * lanes.clamp(position - _f(2), _f(0), _f(1))
                        lanes.store(total, col, 0, lanes.load(total, col, 0) + value)
                first, last = _group(rays, steep, v, axis, last)
        for col in range(cols):
            out[v, col] = lanes.total(lanes.load(total, col, 0)) * _f(rays[v, col, 4])


@njit(**OPTIONS)
def _adjoint(
    projections: F32, n: int, rays: F64, steep: Flags, axis: int, start: int, end: int, lines: F32
) -> None:  # fmt: skip
    """Bands start to end of the padded lines across one axis, overwritten."""
    views = projections.shape[0]
    for job in prange(start, end):
        j = job * _BAND
        lines[j : j + _BAND] = _f(0)
        band = np.empty((lines.shape[1], _BAND), np.float32)
        shifts, offsets = np.empty(_BAND, np.intp), np.empty((1, _BAND), np.float32)
        for v in range(views):
            first, last = _group(rays, steep, v, axis, 0)
            while first < last:
                _shifts_of_lines(rays, v, first, last, shifts, offsets)
                low, high = _crossing(rays, v, first, last, j, n)
                if high > low:
                    row_low = _row_and_distance(rays, v, low, j)[0]
                    row_high = _row_and_distance(rays, v, high - 1, j)[0]
                    top, bottom = min(row_low, row_high) - 1, max(row_low, row_high) + 5  # see _row_and_distance
                    count = (bottom - top + _BAND - 1) // _BAND * _BAND
                    band[:count] = _f(0)
                    offset = lanes.load(offsets, 0, 0)
                    for col in range(low, high):
                        row, distance = _row_and_distance(rays, v, col, j)
                        row -= top
                        position = lanes.iota() * _f(rays[v, col, 1]) + offset + distance
                        ray = projections[v, col] * _f(rays[v, col, 4])
                        b = lanes.clamp(position, _f(0), _f(1)) * ray
                        c = lanes.clamp(position - _f(1), _f(0), _f(1)) * ray
                        d = lanes.clamp(position - _f(2), _f(0), _f(1)) * ray
                        lanes.store(band, row, 0, lanes.load(band, row, 0) + (ray - b))
                        lanes.store(band, row + 1, 0, lanes.load(band, row + 1, 0) + (b - c))
                        lanes.store(band, row + 2, 0, lanes.load(band, row + 2, 0) + (c - d))
                        lanes.store(band, row + 3, 0, lanes.load(band, row + 3, 0) + d)
                    for row in range(0, count, _BAND):
                        lanes.add_transposed(lines, j, _BEFORE + top + row, shifts, band, row)
                first, last = _group(rays, steep, v, axis, last)


@njit(**OPTIONS)
def _pad(image: F32, ys: F32, xs: F32) -> None:
    """An image [y, x] as padded lines along x [y, x] and along y [x, y]."""
    ny, nx = image.shape
    for y in prange(len(ys)):
        ys[y] = _f(0)
        if y < ny:
            ys[y, _BEFORE : _BEFORE + nx] = image[y]
    for band in prange(len(xs) // _BAND):
        x, no_shifts = band * _BAND, np.zeros(_BAND, np.intp)
        tile = np.empty((_BAND, _BAND), np.float32)
        xs[x : x + _BAND] = _f(0)
        for y in range(0, len(ys), _BAND):
            lanes.load_transposed(ys, y, _BEFORE + x, no_shifts, tile, 0)
            for k in range(_BAND):
                lanes.store(xs, x + k, _BEFORE + y, lanes.load(tile, k, 0))


@njit(**OPTIONS)
def _join(ys: F32, xs: F32, out: F32) -> None:
    """out [y, x]: the sum of padded lines along x and along y."""
    ny, nx = out.shape
    for band in prange(len(ys) // _BAND):
        y, no_shifts = band * _BAND, np.zeros(_BAND, np.intp)
        tile = np.empty((_BAND, _BAND), np.float32)
        for x in range(0, nx, _BAND):
            lanes.load_transposed(xs, x, _BEFORE + y, no_shifts, tile, 0)
            for k in range(min(_BAND, ny - y)):
                sum_of_both = lanes.load(ys, y + k, _BEFORE + x) + lanes.load(tile, k, 0)
                lanes.store_first(out, y + k, x, sum_of_both, min(_BAND, nx - x))


def forward(image: F32, rays: F64, steep: Flags, out: F32) -> None:
    """Line integrals of image [y, x] into out [view, col], in mm times the unit of the image."""
    ys, xs = (_lines(lines.shape) for lines in (image, image.T))
    _pad(image, ys, xs)
    for part in calls(len(out), image.size):
        _forward(ys, xs, image.shape, rays, steep, part.start, part.stop, out)


def adjoint(projections: F32, rays: F64, steep: Flags, out: F32) -> None:
    """The transpose of `forward`: projections [view, col] into out [y, x] (overwritten)."""
    ys, xs = _lines(out.shape), _lines(out.T.shape)
    for axis, lines in enumerate((ys, xs)):
        for part in calls(len(lines) // _BAND, _BAND * projections.size):
            _adjoint(projections, out.shape[1 - axis], rays, steep, axis, part.start, part.stop, lines)
    _join(ys, xs, out)


def _lines(shape: tuple[int, ...]) -> F32:
    """Room for lines [line, voxel] in whole bands, between zeros."""
    return np.empty((-(-shape[0] // _BAND) * _BAND, _BEFORE + shape[1] + _BEHIND), np.float32)
