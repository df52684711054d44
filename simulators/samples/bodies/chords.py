"""Chords: line integrals of a frame through packed solids, row by row. A row is the sum over the bodies that shadow it.

In the laboratory's axes (u, b, v) a parallel ray is (u, 0, v) + t (0, 1, 0) and a cone's (0, -sod, 0) + t (u, sod, v),
t = 1 being the plane of the rotation axis. Seen from a body's middle, the ray of the column at `middle` + d is

    R + t D,    R = w V + near d U,    D = D0 + turn d U,

where U, B and V are the laboratory's axes in the sample's (x, y, z), and turn is 0 in a parallel beam and 1 in a cone.
R is the point next to the middle, so that no digits cancel if the source is far. A chord is a difference of t;
in a cone it is multiplied by the length of (u, sod, v) at the end.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.base.jit import njit
from simulators.pixels.bands import share_rows
from simulators.samples.bodies.packing import CYLINDER, ELLIPSOID, Packed, View

Reals = NDArray[np.float64]
Triple = tuple[float, float, float]

EDGE_ON = 1e-12  # a ray with a smaller scalar product with the normal counts as parallel to a face or an axis
_KERNEL = {"nogil": True, "error_model": "numpy", "_nrt": False}
"""Without reference counts (_nrt): counting references to slices takes longer than a short chord. Arrays are allocated
outside."""


class ChordRays(NamedTuple):
    """The rays of one row through the neighbourhood of one body; see the module's docstring.

    Attributes:
        offset: float64 [col], mm, the distance d of each column that the body may shadow. R0, D0, U: R and D at d = 0,
            and U, in the axes of the sample. near, turn: factors of d U in R and in D. scale: order of magnitude of the
            length of D.
    """

    offset: Reals
    R0: Triple
    D0: Triple
    U: Triple
    near: float
    turn: float
    scale: float


def depths(p: Packed, view: View) -> Reals:
    """Line integrals, float64 [row, col]; they do not depend on the number of threads."""
    out = np.zeros((view.v.size, view.u.size))
    if view.upright and view.axes.shape[0] == 1:
        _add_upright(p, view, out)
    share_rows(lambda first, end: _add_rows(p, view, first, end, np.empty((3, view.u.size)), out), out.shape)
    return out


def _add_upright(p: Packed, view: View, out: Reals) -> None:
    """Add upright cylinders in a parallel beam: their shadow is the same in all rows between their ends."""
    profiles: dict[tuple[int, int], Reals] = {}
    for b in np.flatnonzero(p.kind == CYLINDER):
        middle = p.centre[b] - view.origin[0]
        # bit for bit the same as `_dot`; `@` may fuse and round once
        across, _, up = (middle[:, None] * view.axes[0]).sum(axis=0)
        rows = np.flatnonzero(np.abs(view.v - up) <= p.size[b, 1] + 1e-9 * view.pitch)
        if rows.size:
            profile = profiles.setdefault((int(rows[0]), int(rows[-1])), np.zeros(view.u.size))
            _add_circle(profile, view.u - across, p.size[b, 0], p.attenuation[b])
    for (first, last), profile in profiles.items():
        out[first : last + 1] += profile


@njit(cache=True, **_KERNEL)
def _add_rows(p: Packed, view: View, begin: int, end: int, spare: Reals, out: Reals) -> None:
    """Add the line integrals of rows begin ... end - 1, without the bodies that `_add_upright` has added.

    Args:
        spare: float64 [3, col].
    """
    cone, added = view.sod < np.inf, view.upright and view.axes.shape[0] == 1
    for j in range(begin, end):
        row, pose = out[j], j if view.axes.shape[0] > 1 else 0
        for k in range(view.first[j], view.first[j + 1]):
            if not (added and p.kind[view.bodies[k]] == CYLINDER):
                _add_body(row, view, j, p, view.bodies[k], view.axes[pose], view.origin[pose], spare)
        if cone:  # converts t to a length
            square = view.sod * view.sod + view.v[j] * view.v[j]
            for i in range(row.size):
                row[i] *= math.sqrt(square + view.u[i] * view.u[i])


@njit(**_KERNEL)
def _add_body(row: Reals, view: View, j: int, p: Packed, b: int, axes: Reals, origin: Reals, spare: Reals) -> None:
    """Add attenuation x chord to the columns of a row in the shadow of the box around a body."""
    U, B, V = (_axis(axes, 0), _axis(axes, 1), _axis(axes, 2))
    middle = (p.centre[b, 0] - origin[0], p.centre[b, 1] - origin[1], p.centre[b, 2] - origin[2])
    extent = (p.extent[b, 0], p.extent[b, 1], p.extent[b, 2])
    across, deep, up = _dot(middle, U), _dot(middle, B), _dot(middle, V)
    reach, v, near, turn, scale, D0 = _along(extent, U), view.v[j], 1.0, 0.0, 1.0, B
    if view.sod == np.inf and p.kind[b] != CYLINDER:  # the columns must be within the ball around the body, too
        reach = min(reach, math.sqrt(max(p.size[b, 1] ** 2 - (v - up) ** 2, 0.0)) + 1e-9 * p.size[b, 1])
    low, high = across - reach, across + reach
    if view.sod < np.inf:
        front, back = view.sod + deep - _along(extent, B), view.sod + deep + _along(extent, B)
        if front > 0.0:
            low, high = min(low / front, low / back) * view.sod, max(high / front, high / back) * view.sod
        else:  # the box reaches behind the source, but not the body
            low, high = -np.inf, np.inf
        near, turn, scale = (view.sod + deep) / view.sod, 1.0, view.sod
        across /= near
        D0 = _sum(view.sod, B, v, V, across, U)
    first, stop = columns(view.u, 1.0 / view.pitch, low, high)
    part, offset = row[first:stop], spare[0, first:stop]
    for i in range(part.size):
        offset[i] = view.u[first + i] - across
    rays = ChordRays(offset, _sum(near * v - up, V, 0.0, V, 0.0, V), D0, U, near, turn, scale)
    if p.kind[b] == CYLINDER and view.upright:
        if abs(v - up) <= p.size[b, 1] + 1e-9 * view.pitch:
            _add_circle(part, offset, p.size[b, 0], p.attenuation[b])
    elif p.kind[b] == CYLINDER:
        _add_cylinder(part, rays, p.size[b, 0], p.size[b, 1], p.attenuation[b])
    elif p.kind[b] == ELLIPSOID:
        _add_ellipsoid(part, rays, p.matrix[b], p.attenuation[b])
    else:
        faces = p.faces[p.first_face[b] : p.first_face[b + 1]]
        _add_polyhedron(part, rays, faces, p.attenuation[b], spare[1, first:stop], spare[2, first:stop])


@njit(cache=True, **_KERNEL)
def _add_circle(part: Reals, offset: Reals, radius: float, attenuation: float) -> None:
    """An upright cylinder in a parallel beam, between its ends."""
    for i in range(part.size):
        d = offset[i]
        part[i] += 2.0 * attenuation * math.sqrt(max(radius * radius - d * d, 0.0))


@njit(**_KERNEL)
def _add_cylinder(part: Reals, rays: ChordRays, radius: float, half: float, attenuation: float) -> None:
    """Inside the round wall and between the ends."""
    offset, R0, D0, U, near, turn, scale = rays
    size = EDGE_ON * EDGE_ON * scale * scale
    for i in range(part.size):
        d = offset[i]
        rx, ry, rz = R0[0] + near * d * U[0], R0[1] + near * d * U[1], R0[2] + near * d * U[2]
        dx, dy, dz = D0[0] + turn * d * U[0], D0[1] + turn * d * U[1], D0[2] + turn * d * U[2]
        dd, cross = dx * dx + dy * dy, rx * dy - ry * dx
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


@njit(**_KERNEL)
def _add_ellipsoid(part: Reals, rays: ChordRays, matrix: Reals, attenuation: float) -> None:
    """In the space where the ellipsoid is the unit ball half a chord squared is |D|² - |R x D|² over |D|⁴."""
    R, M, U = _times(matrix, rays.R0), _times(matrix, rays.D0), _times(matrix, rays.U)
    x0 = _cross(R, M)
    x1 = _sum(rays.near, _cross(U, M), rays.turn, _cross(R, U), 0.0, U)
    d0, d1, d2 = _dot(M, M), 2.0 * rays.turn * _dot(M, U), rays.turn * _dot(U, U)
    for i in range(part.size):
        d = rays.offset[i]
        x, y, z = x0[0] + d * x1[0], x0[1] + d * x1[1], x0[2] + d * x1[2]
        dd = d0 + d * (d1 + d * d2)
        part[i] += 2.0 * attenuation * math.sqrt(max(dd - (x * x + y * y + z * z), 0.0)) / dd


@njit(**_KERNEL)
def _add_polyhedron(part: Reals, rays: ChordRays, faces: Reals, attenuation: float, enter: Reals, leave: Reals) -> None:
    """A ray is inside behind all faces where it enters, and before all where it leaves.

    Cyrus & Beck 1978, Computers & Graphics 3, 23. Face by face, for the processor's vector lanes.
    """
    enter[:], leave[:] = -np.inf, np.inf
    least = EDGE_ON * rays.scale
    for f in range(faces.shape[0]):
        normal = (faces[f, 0], faces[f, 1], faces[f, 2])
        room, along, slope = faces[f, 3] - _dot(normal, rays.R0), _dot(normal, rays.D0), _dot(normal, rays.U)
        closing, turning = rays.near * slope, rays.turn * slope
        if turning == 0.0 and along < -least:
            for i in range(part.size):
                enter[i] = max(enter[i], (room - closing * rays.offset[i]) * (1.0 / along))
            continue
        if turning == 0.0 and along > least:
            for i in range(part.size):
                leave[i] = min(leave[i], (room - closing * rays.offset[i]) * (1.0 / along))
            continue
        for i in range(part.size):
            d = rays.offset[i]
            distance, toward = room - closing * d, along + turning * d
            at = distance / toward
            enter[i] = max(enter[i], at if toward < -least else -np.inf)
            edge_on = np.inf if distance >= 0.0 or toward < -least else -np.inf
            leave[i] = min(leave[i], at if toward > least else edge_on)
    for i in range(part.size):
        part[i] += attenuation * max(leave[i] - enter[i], 0.0)


@njit(**_KERNEL)
def columns(u: Reals, per_mm: float, low: float, high: float) -> tuple[int, int]:
    """First column whose centre lies in low..high, and the column after the last one. The range is empty if low or high
    is NaN."""
    cols = float(u.size)
    left, right = (low - u[0]) * per_mm, (high - u[0]) * per_mm
    if not left <= right:
        return 0, 0
    first = math.ceil(min(max(left, 0.0), cols))
    stop = math.floor(min(max(right, -1.0), cols - 1.0)) + 1
    return first, max(first, stop)


@njit(**_KERNEL)
def _axis(axes: Reals, k: int) -> Triple:
    return axes[0, k], axes[1, k], axes[2, k]


@njit(**_KERNEL)
def _times(matrix: Reals, x: Triple) -> Triple:
    return (
        matrix[0, 0] * x[0] + matrix[0, 1] * x[1] + matrix[0, 2] * x[2],
        matrix[1, 0] * x[0] + matrix[1, 1] * x[1] + matrix[1, 2] * x[2],
        matrix[2, 0] * x[0] + matrix[2, 1] * x[1] + matrix[2, 2] * x[2],
    )


@njit(**_KERNEL)
def _along(extent: Triple, axis: Triple) -> float:
    """Half the size of a box along an axis."""
    return extent[0] * abs(axis[0]) + extent[1] * abs(axis[1]) + extent[2] * abs(axis[2])


@njit(**_KERNEL)
def _dot(x: Triple, y: Triple) -> float:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


@njit(**_KERNEL)
def _cross(x: Triple, y: Triple) -> Triple:
    return x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]


@njit(**_KERNEL)
def _sum(a: float, x: Triple, b: float, y: Triple, c: float, z: Triple) -> Triple:
    """a x + b y + c z."""
    return a * x[0] + b * y[0] + c * z[0], a * x[1] + b * y[1] + c * z[1], a * x[2] + b * y[2] + c * z[2]
