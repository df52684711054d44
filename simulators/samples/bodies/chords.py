"""Chords: lengths of the rays of one detector row inside one body, in a parallel beam and in a cone.

In the laboratory's axes (u, b, v) a parallel ray is (u, 0, v) + t (0, 1, 0) and a cone's (0, -sod, 0) + t (u, sod, v),
t = 1 being the plane of the rotation axis; `axes` [3, 3] has these axes as columns, in the sample's (x, y, z). Each
function adds attenuation x length in t to the pixels of a `Row` in the body's shadow and returns their range: the first
and the one after the last. In a cone the caller multiplies by the length of (u, sod, v). Positions are relative to the
body's middle, so that no digits cancel where the source is far.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simulators.samples.bodies.packing import ELLIPSOID, POLYHEDRON, Packed

Reals = NDArray[np.float64]
Triple = tuple[float, float, float]
Span = tuple[int, int]

EDGE_ON = 1e-12  # normal · ray below which a ray runs along a face or along an axis
KERNEL = {"nogil": True, "error_model": "numpy", "_nrt": False}
"""Options of these kernels. Without reference counts (_nrt): arrays are allocated outside, and counting references to
slices takes longer than a short chord. They are cached on disk within the kernels called from Python (see rows)."""


class Row(NamedTuple):
    """A row of the detector.

    Attributes:
        depth: float64 [col], to which chords are added.
        u: float64 [col], positions of the columns, mm.
        per_mm: columns a mm.
        v: position of the row, mm.
        sod: mm, infinite in a parallel beam.
    """

    depth: Reals
    u: Reals
    per_mm: float
    v: float
    sod: float


@njit(**KERNEL)
def locate(p: Packed, b: int, axes: Reals, origin: Reals, parallel: bool, place: Reals, facets: Reals) -> None:
    """Computes what is common to all rows of one pose: `place` float64 [7] of a body, `facets` float64 [face, 4].

    place: the middle (u, b, v); for a polyhedron also its bounds relative to it, least and greatest u, then b; for an
    ellipsoid in a parallel beam su, suv / su, sv - suv² / su and 2 attenuation / |D|, where the shadow is su u² + 2 suv
    u v + sv v² <= 1 (Schur complement of the ray's direction). facets, in a parallel beam: t = f0 - f1 v + f2 u on the
    face, and in f3 whether rays enter (-1), leave (1) or run along it (0).
    """
    x, y, z = p.centre[b, 0] - origin[0], p.centre[b, 1] - origin[1], p.centre[b, 2] - origin[2]
    for k in range(3):
        place[k] = x * axes[0, k] + y * axes[1, k] + z * axes[2, k]
    if p.kind[b] == POLYHEDRON:
        place[3], place[4], place[5], place[6] = np.inf, -np.inf, np.inf, -np.inf
        for i in range(p.first_vertex[b], p.first_vertex[b + 1]):
            across, deep, _ = in_lab(p.vertices[i], axes)
            place[3], place[4] = min(place[3], across), max(place[4], across)
            place[5], place[6] = min(place[5], deep), max(place[6], deep)
    if not parallel:
        return
    if p.kind[b] == ELLIPSOID:
        U, D, V = _times(p.matrix[b], axes, 0), _times(p.matrix[b], axes, 1), _times(p.matrix[b], axes, 2)
        X, Y, dd, det = _cross(D, U), _cross(D, V), _dot(D, D), 1.0
        for k in range(3):  # of W W^T, which is diagonal
            det *= p.matrix[b, k, 0] ** 2 + p.matrix[b, k, 1] ** 2 + p.matrix[b, k, 2] ** 2
        # Products instead of the differences in the complement's definition, which cancel for a needle.
        place[3], place[4], place[5] = _dot(X, X) / dd, _dot(X, Y) / _dot(X, X), det / _dot(X, X)
        place[6] = 2.0 * p.attenuation[b] / math.sqrt(dd)
    elif p.kind[b] == POLYHEDRON:
        for f in range(p.first_face[b], p.first_face[b + 1]):
            nu, nb, nv = in_lab(p.faces[f], axes)
            if abs(nb) < EDGE_ON:
                facets[f, 0], facets[f, 1], facets[f, 2], facets[f, 3] = p.faces[f, 3], nv, nu, 0.0
            else:
                facets[f, 0], facets[f, 1], facets[f, 2] = p.faces[f, 3] / nb, nv / nb, -nu / nb
                facets[f, 3] = 1.0 if nb > 0 else -1.0


@njit(**KERNEL)
def upright_cylinder(row: Reals, u: Reals, per_mm: float, middle: float, radius: float, attenuation: float) -> Span:
    """Parallel rays across an upright cylinder between its ends."""
    first, stop = columns(u, per_mm, middle - radius, middle + radius)
    part, at = row[first:stop], u[first:stop]
    for i in range(part.size):
        d = at[i] - middle
        part[i] += 2.0 * attenuation * math.sqrt(max(radius * radius - d * d, 0.0))
    return first, stop


@njit(**KERNEL)
def ellipsoid(rays: Row, place: Reals) -> Span:
    """Parallel rays; `place` from `locate`."""
    row, u, per_mm, v, _ = rays
    dv = v - place[2]
    rest = 1.0 - place[5] * dv * dv
    if rest <= 0.0:
        return 0, 0
    su, middle, scale = place[3], place[0] - place[4] * dv, place[6]
    reach = math.sqrt(rest / su)
    first, stop = columns(u, per_mm, middle - reach, middle + reach)
    part, at = row[first:stop], u[first:stop]
    for i in range(part.size):
        d = at[i] - middle
        part[i] += scale * math.sqrt(max(rest - su * d * d, 0.0))
    return first, stop


@njit(**KERNEL)
def cone_ellipsoid(rays: Row, matrix: Reals, attenuation: float, axes: Reals, place: Reals) -> Span:
    """A cone's rays, in the space where the ellipsoid is the unit ball: half a chord squared is |D|² - |R x D|² over
    |D|⁴, with R the ray's point next to the middle and D its direction, both linear in u."""
    row, u, per_mm, v, sod = rays
    near = (sod + place[1]) / sod
    middle, w = place[0] / near, near * v - place[2]
    U, B, V = _times(matrix, axes, 0), _times(matrix, axes, 1), _times(matrix, axes, 2)
    M = _sum(sod, B, v, V, middle, U)
    x0, x1 = _cross(V, M), _sum(near, _cross(U, M), w, _cross(V, U), 0.0, U)
    c0, c1, c2 = _dot(M, M) - w * w * _dot(x0, x0), 2.0 * (_dot(M, U) - w * _dot(x0, x1)), _dot(U, U) - _dot(x1, x1)
    root = c1 * c1 - 4.0 * c0 * c2
    if root <= 0.0 or c2 >= 0.0:
        return 0, 0
    top, reach = -c1 / (2.0 * c2), math.sqrt(root) / (-2.0 * c2)
    first, stop = columns(u, per_mm, middle + top - reach, middle + top + reach)
    part, at = row[first:stop], u[first:stop]
    d0, d1, d2 = _dot(M, M), 2.0 * _dot(M, U), _dot(U, U)
    for i in range(part.size):
        d = at[i] - middle
        part[i] += 2.0 * attenuation * math.sqrt(max(c0 + d * (c1 + d * c2), 0.0)) / (d0 + d * (d1 + d * d2))
    return first, stop


@njit(**KERNEL)
def leaning_cylinder(rays: Row, radius: float, half: float, attenuation: float, axes: Reals, place: Reals) -> Span:
    """Any rays: inside the round wall and between the ends."""
    row, u, per_mm, v, sod = rays
    reach = radius * math.hypot(axes[0, 0], axes[1, 0]) + half * abs(axes[2, 0])
    low, high, near, turn = place[0] - reach, place[0] + reach, 1.0, 0.0
    R0 = D0 = (axes[0, 1], axes[1, 1], axes[2, 1])
    U, B, V = R0, R0, R0
    U, V = (axes[0, 0], axes[1, 0], axes[2, 0]), (axes[0, 2], axes[1, 2], axes[2, 2])
    middle = place[0]
    if sod < np.inf:
        deep = radius * math.hypot(axes[0, 1], axes[1, 1]) + half * abs(axes[2, 1])
        front, back = sod / (sod + place[1] - deep), sod / (sod + place[1] + deep)
        low, high = min(low * front, low * back), max(high * front, high * back)
        near, turn = (sod + place[1]) / sod, 1.0
        middle = place[0] / near
        D0 = _sum(sod, B, v, V, middle, U)
    w = near * v - place[2]
    R0 = _sum(w, V, 0.0, V, 0.0, V)
    first, stop = columns(u, per_mm, low, high)
    part, at = row[first:stop], u[first:stop]
    for i in range(part.size):
        d = at[i] - middle
        rx, ry, rz = R0[0] + near * d * U[0], R0[1] + near * d * U[1], R0[2] + near * d * U[2]
        dx, dy, dz = D0[0] + turn * d * U[0], D0[1] + turn * d * U[1], D0[2] + turn * d * U[2]
        dd, cross = dx * dx + dy * dy, rx * dy - ry * dx
        size = EDGE_ON * EDGE_ON * (dd + dz * dz)
        inside = radius * radius * dd - cross * cross
        enter, leave = -np.inf, np.inf
        if dd > size:
            if inside <= 0.0:
                continue
            span, halfway = math.sqrt(inside) / dd, -(rx * dx + ry * dy) / dd
            enter, leave = halfway - span, halfway + span
        elif rx * rx + ry * ry > radius * radius:
            continue
        if dz * dz > size:
            span, halfway = half / abs(dz), -rz / dz
            enter, leave = max(enter, halfway - span), min(leave, halfway + span)
        elif abs(rz) > half:
            continue
        part[i] += attenuation * max(leave - enter, 0.0)
    return first, stop


@njit(**KERNEL)
def columns(u: Reals, per_mm: float, low: float, high: float) -> Span:
    """First column whose centre lies in low..high, and the one after the last; none where these are not numbers."""
    cols = float(u.size)
    left, right = (low - u[0]) * per_mm, (high - u[0]) * per_mm
    if not left <= right:
        return 0, 0
    first = math.ceil(min(max(left, 0.0), cols))
    stop = math.floor(min(max(right, -1.0), cols - 1.0)) + 1
    return first, max(first, stop)


@njit(**KERNEL)
def _times(matrix: Reals, axes: Reals, k: int) -> Triple:
    """The laboratory's k-th axis, multiplied by a matrix [3, 3]."""
    x, y, z = axes[0, k], axes[1, k], axes[2, k]
    return (
        matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z,
        matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z,
        matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z,
    )


@njit(**KERNEL)
def in_lab(q: Reals, axes: Reals) -> Triple:
    """The first three numbers of q, a vector in the sample's axes, in the laboratory's (u, b, v)."""
    return (
        q[0] * axes[0, 0] + q[1] * axes[1, 0] + q[2] * axes[2, 0],
        q[0] * axes[0, 1] + q[1] * axes[1, 1] + q[2] * axes[2, 1],
        q[0] * axes[0, 2] + q[1] * axes[1, 2] + q[2] * axes[2, 2],
    )


@njit(**KERNEL)
def _dot(x: Triple, y: Triple) -> float:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


@njit(**KERNEL)
def _cross(x: Triple, y: Triple) -> Triple:
    return x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]


@njit(**KERNEL)
def _sum(a: float, x: Triple, b: float, y: Triple, c: float, z: Triple) -> Triple:
    """a x + b y + c z."""
    return a * x[0] + b * y[0] + c * z[0], a * x[1] + b * y[1] + c * z[1], a * x[2] + b * y[2] + c * z[2]
