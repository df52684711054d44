"""Cone-beam projector and its adjoint: Joseph's interpolation, the detector's rows fastest (numba, threaded).

All rays to one column of the detector lie in one plane parallel to the rotation axis, so they share their path in x and
y. In every plane of voxels that they cross, the detector's rows meet a line of slices at equal steps. A ray is sampled
once in each plane, bilinearly. Volumes are [y, x, z], projections [view, col, row]; the table of rays is that of
`cpu.joseph`. The transpose reads the same weights and runs plane by plane: no two threads write to one voxel.
"""

from __future__ import annotations

import math

import numpy as np
from numba import get_num_threads, njit, prange
from numpy.typing import NDArray

from recon.kernels.cpu.activation import F32, OPTIONS
from recon.kernels.cpu.joseph import CALL, F64, Flags, calls, shares

_f = np.float32
_PAD = 2  # zeros at both ends of a line of slices


@njit(inline="always", fastmath=True)
def _rows(height, climb, middle, n, rows):
    """Rows first..end (excluded) that are less than one slice outside the line of n slices.

    `climb`: slices a row; `height`: the slice at z = 0; `middle`: the row at z = 0.
    """
    first = max(0.0, middle + (-1.0 - height) / climb)
    end = min(rows * 1.0, middle + (n - height) / climb + 1.0)
    return math.ceil(first), math.floor(end)


@njit(**OPTIONS)
def _forward(
    lines: F32, shape: tuple[int, int], rays: F64, steep: Flags, middles: F64, height: float, pitch: float,
    group: int, start: int, end: int, out: F32,
) -> None:  # fmt: skip
    """Groups of views start to end."""
    nz = lines.shape[1]
    views, cols, rows = out.shape
    for job in prange(start, end):
        v0 = job * group
        v1 = min(views, v0 + group)
        out[v0:v1] = _f(0)
        padded = np.zeros(nz + 2 * _PAD + 1, np.float32)
        line = padded[_PAD : _PAD + nz]
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
                        climb = rays[v, col, 2] + rays[v, col, 3] * j
                        row0, row1 = _rows(height, climb, middles[v], nz, rows)
                        if row1 <= row0:
                            continue
                        low = math.floor(at)
                        high_part = _f(at - low)
                        low_part = _f(1) - high_part if low >= 0 else _f(0)
                        if low + 1 >= n:
                            high_part = _f(0)
                        first = j * plane_stride
                        a = lines[first + max(low, 0) * line_stride]
                        b = lines[first + min(low + 1, n - 1) * line_stride]
                        for z in range(nz):
                            line[z] = low_part * a[z] + high_part * b[z]
                        base = height + climb * (row0 - middles[v]) + _PAD
                        target = out[v, col, row0:row1]
                        for row in range(row1 - row0):
                            level = base + climb * row
                            k = np.uint32(level)
                            part = _f(level - k)
                            target[row] += padded[k] + part * (padded[k + np.uint32(1)] - padded[k])
        for v in range(v0, v1):
            for col in range(cols):
                _lengthen(out[v, col], out[v, col], rays[v, col, 4], rays[v, col, 5], middles[v], pitch)


@njit(inline="always", fastmath=True)
def _lengthen(source, out, path, reach, middle, pitch):
    """out = source times the ray's path from plane to plane, which is longer for rays inclined to the mid-plane."""
    for row in range(out.size):
        slope = (row - middle) * pitch / reach
        out[row] = source[row] * _f(path * math.sqrt(1.0 + slope * slope))


@njit(**OPTIONS)
def _weigh(projections: F32, rays: F64, middles: F64, pitch: float, out: F32) -> None:
    views, cols, _ = projections.shape
    for job in prange(views * cols):
        v, col = job // cols, job % cols
        _lengthen(projections[v, col], out[v, col], rays[v, col, 4], rays[v, col, 5], middles[v], pitch)


@njit(**OPTIONS)
def _adjoint(
    weighed: F32, rays: F64, steep: Flags, middles: F64, height: float, shape: tuple[int, int], axis: int, start: int,
    end: int, lines: F32,
) -> None:  # fmt: skip
    """Planes start to end across one axis; those across axis 0 come first, and overwrite."""
    nz = lines.shape[1]
    views, cols, rows = weighed.shape
    n = shape[1 - axis]
    plane_stride, line_stride = (shape[1], 1) if axis == 0 else (1, shape[1])
    for j in prange(start, end):
        first = j * plane_stride
        if axis == 0:
            lines[first : first + n] = _f(0)
        padded = np.zeros(nz + 2 * _PAD + 1, np.float32)
        line = padded[_PAD : _PAD + nz]
        for v in range(views):
            for col in range(cols):
                if steep[v, col] == axis:
                    continue
                at = rays[v, col, 0] + rays[v, col, 1] * j
                if not (at > -1.0 and at < n):
                    continue
                climb = rays[v, col, 2] + rays[v, col, 3] * j
                row0, row1 = _rows(height, climb, middles[v], nz, rows)
                if row1 <= row0:
                    continue
                base = height + climb * (row0 - middles[v]) + _PAD
                source = weighed[v, col, row0:row1]
                padded[:] = _f(0)
                for row in range(row1 - row0):
                    level = base + climb * row
                    k = np.uint32(level)
                    up = _f(level - k) * source[row]
                    padded[k] += source[row] - up
                    padded[k + np.uint32(1)] += up
                low = math.floor(at)
                high_part = _f(at - low)
                low_part = _f(1) - high_part
                if low >= 0:
                    target = lines[first + low * line_stride]
                    for z in range(nz):
                        target[z] += low_part * line[z]
                if low + 1 < n:
                    target = lines[first + (low + 1) * line_stride]
                    for z in range(nz):
                        target[z] += high_part * line[z]


def forward(
    volume: F32, rays: F64, steep: Flags, middles: NDArray[np.float64], height: float, pitch: float, out: F32
) -> None:
    """Line integrals of volume [y, x, z] into out [view, col, row], mm times the volume's unit.

    Args:
        rays, steep: see `cpu.joseph.ray_table`.
        middles: [view], row at the height z = 0.
        height: slice at z = 0.
        pitch: detector pixel, mm.
    """
    (views, cols, rows), lines = out.shape, volume.reshape(-1, volume.shape[2])
    samples = cols * rows * min(volume.shape[:2])
    group = max(1, min(shares(views, 1)[0], CALL // max(samples * get_num_threads(), 1)))
    for part in calls(-(-views // group), group * samples):
        _forward(lines, volume.shape[:2], rays, steep, middles, height, pitch, group, part.start, part.stop, out)


def adjoint(
    projections: F32, rays: F64, steep: Flags, middles: NDArray[np.float64], height: float, pitch: float, out: F32
) -> None:
    """The transpose of `forward`: projections [view, col, row] into out [y, x, z] (overwritten).

    Needs memory for one copy of the projections.
    """
    weighed = np.empty_like(projections)
    _weigh(projections, rays, middles, pitch, weighed)
    shape, lines = out.shape[:2], out.reshape(-1, out.shape[2])
    for axis in range(2):
        for part in calls(shape[axis], projections.size):
            _adjoint(weighed, rays, steep, middles, height, shape, axis, part.start, part.stop, lines)
