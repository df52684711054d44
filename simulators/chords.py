"""Chord lengths of parallel rays through packed solids, and the share of a voxel that a solid fills: the hot loops.

A ray at (u, v) of a view at angle θ is p = u (cos θ, sin θ, 0) + v (0, 0, 1) + t (-sin θ, cos θ, 0), t in mm. Each row
of the detector may have an angle of its own (rolling shutter). Only the pixels in a body's shadow are touched.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simulators.solids import CYLINDER, ELLIPSOID

Reals = NDArray[np.float64]
Kinds = NDArray[np.int64]


@njit(cache=True, nogil=True)
def add_line_integrals(
    cos_row: Reals,
    sin_row: Reals,
    u0: float,
    v0: float,
    pitch: float,
    kind: Kinds,
    attenuation: Reals,
    centre: Reals,
    extent: Reals,
    planes: Reals,
    half: Reals,
    out: Reals,
) -> None:
    """Add attenuation x chord to `out`, float64 [row, col]; pixel (j, i) is at (v0, u0) + (j, i) * pitch."""
    rows = out.shape[0]
    for b in range(kind.size):
        first_row = max(0, math.ceil((centre[b, 2] - extent[b, 2] - v0) / pitch))
        last_row = min(rows - 1, math.floor((centre[b, 2] + extent[b, 2] - v0) / pitch))
        for j in range(first_row, last_row + 1):
            c, s = cos_row[j], sin_row[j]
            u_mid = centre[b, 0] * c + centre[b, 1] * s
            v = v0 + j * pitch - centre[b, 2]
            if kind[b] == CYLINDER:
                _cylinder_row(out[j], u0 - u_mid, pitch, attenuation[b], half[b, 0])
            elif kind[b] == ELLIPSOID:
                _ellipsoid_row(out[j], u0 - u_mid, v, pitch, attenuation[b], c, s, planes[b])
            else:
                _slabs_row(out[j], u0 - u_mid, v, pitch, attenuation[b], c, s, planes[b], half[b], extent[b])


@njit(cache=True, nogil=True)
def _columns(u0: float, pitch: float, low: float, high: float, cols: int) -> tuple[int, int]:
    """Columns first..last (inclusive) whose centres lie in low..high."""
    return max(0, math.ceil((low - u0) / pitch)), min(cols - 1, math.floor((high - u0) / pitch))


@njit(cache=True, nogil=True)
def _cylinder_row(row: Reals, u0: float, pitch: float, attenuation: float, radius: float) -> None:
    first, last = _columns(u0, pitch, -radius, radius, row.size)
    for i in range(first, last + 1):
        u = u0 + i * pitch
        row[i] += 2.0 * attenuation * math.sqrt(max(radius * radius - u * u, 0.0))


@njit(cache=True, nogil=True)
def _ellipsoid_row(
    row: Reals, u0: float, v: float, pitch: float, attenuation: float, c: float, s: float, W: Reals
) -> None:
    """|W (q + t d)|² = 1 is a quadratic in t; its discriminant is one in u, solved for the row (q = u e_u + v e_z)."""
    dd = du = dv = uu = uv = vv = 0.0
    for k in range(3):
        d, e, z = c * W[k, 1] - s * W[k, 0], c * W[k, 0] + s * W[k, 1], W[k, 2]
        dd, du, dv, uu, uv, vv = dd + d * d, du + d * e, dv + d * z, uu + e * e, uv + e * z, vv + z * z
    # Schur complement of the ray direction: the shadow is where su u² + 2 suv u v + sv v² <= 1
    su, suv, sv = uu - du * du / dd, uv - du * dv / dd, vv - dv * dv / dd
    shift = suv * v / su
    rest = 1.0 - (sv - suv * suv / su) * v * v
    if rest <= 0.0:
        return
    reach = math.sqrt(rest / su)
    first, last = _columns(u0, pitch, -shift - reach, -shift + reach, row.size)
    scale = 2.0 * attenuation / math.sqrt(dd)
    for i in range(first, last + 1):
        u = u0 + i * pitch + shift
        row[i] += scale * math.sqrt(max(rest - su * u * u, 0.0))


@njit(cache=True, nogil=True)
def _slabs_row(
    row: Reals,
    u0: float,
    v: float,
    pitch: float,
    attenuation: float,
    c: float,
    s: float,
    normals: Reals,
    half: Reals,
    extent: Reals,
) -> None:
    """The ray is inside between the latest entry into and the earliest exit out of all slabs (Kay and Kajiya 1986)."""
    reach = extent[0] * abs(c) + extent[1] * abs(s)
    first, last = _columns(u0, pitch, -reach, reach, row.size)
    for i in range(first, last + 1):
        u = u0 + i * pitch
        enter, leave = -np.inf, np.inf
        for k in range(half.size):
            if half[k] == np.inf:
                break
            across = u * (c * normals[k, 0] + s * normals[k, 1]) + v * normals[k, 2]
            along = c * normals[k, 1] - s * normals[k, 0]
            if abs(along) < 1e-12:  # the ray runs in the slab or beside it
                if abs(across) > half[k]:
                    leave = -np.inf
                continue
            middle, span = -across / along, half[k] / abs(along)
            enter, leave = max(enter, middle - span), min(leave, middle + span)
        if leave > enter:
            row[i] += attenuation * (leave - enter)


@njit(cache=True, nogil=True)
def _level(kind: int, x: float, y: float, z: float, planes: Reals, half: Reals) -> float:
    """Negative inside, positive outside; changes by at most 1 mm per mm, so it bounds the distance to the surface."""
    if kind == CYLINDER:
        return max(math.sqrt(x * x + y * y) - half[0], abs(z) - half[1])
    if kind == ELLIPSOID:
        r2 = 0.0
        for k in range(3):
            w = planes[k, 0] * x + planes[k, 1] * y + planes[k, 2] * z
            r2 += w * w
        return (math.sqrt(r2) - 1.0) * half[0]
    level = -np.inf
    for k in range(half.size):
        if half[k] == np.inf:
            break
        level = max(level, abs(planes[k, 0] * x + planes[k, 1] * y + planes[k, 2] * z) - half[k])
    return level


@njit(cache=True, nogil=True)
def add_attenuation(
    x0: float,
    y0: float,
    z0: float,
    voxel: float,
    supersample: int,
    kind: Kinds,
    attenuation: Reals,
    centre: Reals,
    extent: Reals,
    planes: Reals,
    half: Reals,
    out: Reals,
) -> None:
    """Add attenuation x filled share to `out`, float64 [z, y, x]; voxel (0, 0, 0) has its centre at (z0, y0, x0).

    The share is counted on supersample³ points, only in voxels that the surface can cross.
    """
    nz, ny, nx = out.shape
    corner = 0.5 * math.sqrt(3.0) * voxel
    step = voxel / supersample
    start = -0.5 * voxel + 0.5 * step
    for b in range(kind.size):
        k0, k1 = _voxels(z0 - centre[b, 2], voxel, extent[b, 2], nz)
        j0, j1 = _voxels(y0 - centre[b, 1], voxel, extent[b, 1], ny)
        i0, i1 = _voxels(x0 - centre[b, 0], voxel, extent[b, 0], nx)
        for k in range(k0, k1):
            z = z0 + k * voxel - centre[b, 2]
            for j in range(j0, j1):
                y = y0 + j * voxel - centre[b, 1]
                for i in range(i0, i1):
                    x = x0 + i * voxel - centre[b, 0]
                    level = _level(kind[b], x, y, z, planes[b], half[b])
                    if level <= -corner:
                        out[k, j, i] += attenuation[b]
                    elif level < corner:
                        share = _filled(kind[b], x + start, y + start, z + start, step, supersample, planes[b], half[b])
                        out[k, j, i] += attenuation[b] * share


@njit(cache=True, nogil=True)
def _filled(kind: int, x0: float, y0: float, z0: float, step: float, n: int, planes: Reals, half: Reals) -> float:
    """Share of n³ points, `step` apart from (x0, y0, z0) on, that lie inside."""
    inside = 0
    for k in range(n):
        for j in range(n):
            for i in range(n):
                if _level(kind, x0 + i * step, y0 + j * step, z0 + k * step, planes, half) <= 0.0:
                    inside += 1
    return inside / n**3


@njit(cache=True, nogil=True)
def _voxels(first: float, voxel: float, reach: float, n: int) -> tuple[int, int]:
    """Range of voxels that touch -reach..reach, the first voxel's centre being at `first`."""
    low = max(0, math.floor((-reach - first) / voxel + 0.5))
    return low, max(low, min(n, math.floor((reach - first) / voxel + 0.5) + 1))
