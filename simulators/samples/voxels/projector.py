"""Voxel projector: kernels for line integrals through a volume by Joseph's method.

The volume is the function that its voxels' centres interpolate linearly, falling to 0 one voxel beyond the outermost. A
ray is sampled at the points where it crosses the planes of centres across its main axis, and interpolated in each
plane. (Joseph, "An improved algorithm for reprojecting rays through pixel images", IEEE Trans. Med. Imaging 1, 1982).
In a parallel beam through an upright sample each row is in one slice, with one interpolation per plane.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.base.jit import njit
from simulators.frame.shot import Detector, Pose
from simulators.pixels.bands import share_rows

Reals = NDArray[np.float64]
Voxels32 = NDArray[np.float32]

_EDGE = 1e-7  # voxels: distance kept from the outer edge


class Lattice(NamedTuple):
    """A padded volume and its place; see `project`."""

    volume: Voxels32
    spacing: Reals
    first: Reals


class VoxelRays(NamedTuple):
    """(u, v) of pixel (0, 0), the pitch, and the distance from the source to the axis, all in mm."""

    u0: float
    v0: float
    pitch: float
    sod: float


def padded(values: NDArray[np.floating]) -> Voxels32:
    """The volume with one voxel of zeros on all sides, float32, for `project`."""
    return np.pad(np.asarray(values, dtype=np.float32), 1)


def project(volume: Voxels32, spacing: Reals, first: Reals, pose: Pose, detector: Detector) -> Reals:
    """Line integrals, float64 [row, col].

    Args:
        volume: float32 [z + 2, y + 2, x + 2], from `padded`, in 1/mm.
        spacing: float64 (x, y, z), mm from voxel to voxel.
        first: float64 (x, y, z) in mm, centre of the first voxel that is not padding.
    """
    out = np.zeros(detector.shape)
    lattice = Lattice(volume, spacing, first)
    pitch = float(detector.pitch)
    rays = VoxelRays(-detector.axis_col * pitch, -detector.axis_row * pitch, pitch, float(detector.sod))

    if pose.tilt is None and math.isinf(detector.sod):
        shift = np.zeros((detector.shape[0], 3)) if pose.shift is None else np.ascontiguousarray(pose.shift)
        cosine, sine = np.cos(pose.angle), np.sin(pose.angle)

        def rows(low: int, high: int) -> None:
            _upright(lattice, rays, cosine, sine, shift, low, high, out)
    else:
        axes, origin = pose.frames()

        def rows(low: int, high: int) -> None:
            _any(lattice, rays, axes, origin, low, high, out)

    share_rows(rows, detector.shape, bands=8)  # rows near the middle take longer than rows next to the sample
    return out


@njit(cache=True, nogil=True)
def _upright(
    lattice: Lattice, rays: VoxelRays, cosine: Reals, sine: Reals, shift: Reals, low: int, high: int, out: Reals
) -> None:
    """Rows low ... high - 1 of a parallel beam across z: in each, x = u cos θ - t sin θ and y = u sin θ + t cos θ."""
    volume, spacing, first = lattice
    u0, v0, pitch, _ = rays
    nz, ny, nx = volume.shape[0] - 2, volume.shape[1] - 2, volume.shape[2] - 2
    between = np.empty(volume.shape[1:], np.float32)
    for j in range(low, high):
        height = (v0 + j * pitch - shift[j, 2] - first[2]) / spacing[2]
        if not -1.0 + _EDGE < height < nz - _EDGE:
            continue
        k = int(height + 1.0)
        part = np.float32(height + 1.0 - k)
        below, above = volume[k], volume[k + 1]
        for b in range(ny + 2):
            for a in range(nx + 2):
                between[b, a] = below[b, a] + part * (above[b, a] - below[b, a])
        c, s, left = cosine[j], sine[j], u0 - shift[j, 0]
        row = out[j]
        if abs(c) / spacing[1] >= abs(s) / spacing[0]:  # from plane to plane of y: x = u / cos θ - y tan θ
            step = pitch / c / spacing[0]
            for b in range(ny):
                y = first[1] + b * spacing[1]
                at = ((left - s * y) / c - first[0]) / spacing[0] + 1.0
                start, stop = _columns(at, step, nx, row.size)
                line = between[b + 1]
                for i in range(start, stop):
                    place = at + i * step
                    a = min(max(int(place), 0), nx)
                    row[i] += line[a] + (place - a) * (line[a + 1] - line[a])
            length = spacing[1] / abs(c)
        else:  # from plane to plane of x: y = u / sin θ - x cot θ
            step = pitch / s / spacing[1]
            for a in range(nx):
                x = first[0] + a * spacing[0]
                at = ((left - c * x) / s - first[1]) / spacing[1] + 1.0
                start, stop = _columns(at, step, ny, row.size)
                for i in range(start, stop):
                    place = at + i * step
                    b = min(max(int(place), 0), ny)
                    row[i] += between[b, a + 1] + (place - b) * (between[b + 1, a + 1] - between[b, a + 1])
            length = spacing[0] / abs(s)
        for i in range(row.size):
            row[i] *= length


@njit(cache=True, nogil=True)
def _columns(position: float, step: float, n: int, cols: int) -> tuple[int, int]:
    """Columns start ... stop - 1 with 0 < at + i step < n + 1, the padded line's inside."""
    one, other = (_EDGE - position) / step, (n + 1 - _EDGE - position) / step
    start, stop = max(0.0, min(min(one, other), 1.0 * cols)), max(-1.0, min(max(one, other), cols - 1.0))
    return math.ceil(start), math.floor(stop) + 1


@njit(cache=True, nogil=True)
def _any(lattice: Lattice, rays: VoxelRays, axes: Reals, origin: Reals, low: int, high: int, out: Reals) -> None:
    """Rows low ... high - 1 for any pose and source; coordinates in voxels of the padded volume."""
    volume, spacing, first = lattice
    u0, v0, pitch, sod = rays
    size = np.array([volume.shape[2] - 2, volume.shape[1] - 2, volume.shape[0] - 2])
    point, along, step = np.empty(3), np.empty(3), np.empty(3)
    for j in range(low, high):
        v = v0 + j * pitch
        for i in range(out.shape[1]):
            u = u0 + i * pitch
            length = 1.0 if math.isinf(sod) else math.sqrt(u * u + v * v + sod * sod)
            main = 0
            for n in range(3):
                across = u * axes[j, n, 0] + v * axes[j, n, 2]
                point[n] = (origin[j, n] + across - first[n]) / spacing[n] + 1.0
                toward = axes[j, n, 1] if math.isinf(sod) else (across + sod * axes[j, n, 1]) / length
                along[n] = toward / spacing[n]
                if abs(along[n]) > abs(along[main]):
                    main = n
            # The ray is point + t along; plane k of the main axis is met at t = (k - point) / along there.
            start, stop = 1.0, float(size[main])
            for n in range(3):
                step[n] = along[n] / along[main]
                if n == main:
                    continue
                at = point[n] - point[main] * step[n]
                if abs(step[n]) < 1e-12:
                    if not _EDGE < at < size[n] + 1 - _EDGE:
                        stop = 0.0
                    continue
                one, other = (_EDGE - at) / step[n], (size[n] + 1 - _EDGE - at) / step[n]
                start, stop = max(start, min(one, other)), min(stop, max(one, other))
            if not start <= stop:  # checked here, because far outside they exceed the range of integers
                continue
            total = 0.0
            for k in range(math.ceil(start), math.floor(stop) + 1):
                t = k - point[main]
                if main == 0:
                    total += _bilinear(volume[:, :, k], point[2] + t * step[2], point[1] + t * step[1])
                elif main == 1:
                    total += _bilinear(volume[:, k, :], point[2] + t * step[2], point[0] + t * step[0])
                else:
                    total += _bilinear(volume[k], point[1] + t * step[1], point[0] + t * step[0])
            out[j, i] = total / abs(along[main])


@njit(cache=True, nogil=True, inline="always")
def _bilinear(plane: Voxels32, down: float, across: float) -> float:
    # On the plane, also if the rounding of a distant ray differs.
    j, i = min(max(int(down), 0), plane.shape[0] - 2), min(max(int(across), 0), plane.shape[1] - 2)
    q, p = down - j, across - i
    upper = plane[j, i] + p * (plane[j, i + 1] - plane[j, i])
    lower = plane[j + 1, i] + p * (plane[j + 1, i + 1] - plane[j + 1, i])
    return upper + q * (lower - upper)
