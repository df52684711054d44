"""Packing: solids as flat arrays for the kernels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from simulators.samples.bodies import polyhedra
from simulators.samples.bodies.solids import (
    Box,
    Cylinder,
    Ellipsoid,
    Faceted,
    Octahedron,
    Plate,
    Polyhedron,
    Quaternion,
    Solid,
    TruncatedOctahedron,
    Tube,
)

Reals = NDArray[np.float64]
Wholes = NDArray[np.int64]

CYLINDER, ELLIPSOID, POLYHEDRON = 0, 1, 2


class Packed(NamedTuple):
    """Solids as flat arrays for numba, one entry a body (a tube is two: outer and, negative, its bore).

    Attributes:
        kind: int64 [n], CYLINDER, ELLIPSOID or POLYHEDRON.
        attenuation: float64 [n], 1/mm.
        centre, extent: float64 [n, 3], middle and half size of the axis-aligned box around the body, mm.
        owner: int64 [n], index of the solid.
        bore: int64 [n], the body that is this one's bore, or -1; a bore has -2.
        size: float64 [n, 2]. CYLINDER: (radius, half height); ELLIPSOID: (smallest semi-axis, 0).
        matrix: float64 [n, 3, 3]. ELLIPSOID: W with |W q| <= 1 inside, q from the centre.
        first_face: int64 [n + 1]; a POLYHEDRON's faces are first_face[i] to first_face[i + 1] of the next.
        faces: float64 [face, 4], unit normal and distance from the centre: normal · q <= distance inside.
        first_vertex: int64 [n + 1], likewise.
        vertices: float64 [vertex, 3], from the centre.
    """

    kind: Wholes
    attenuation: Reals
    centre: Reals
    extent: Reals
    owner: Wholes
    bore: Wholes
    size: Reals
    matrix: Reals
    first_face: Wholes
    faces: Reals
    first_vertex: Wholes
    vertices: Reals


def pack(solids: Sequence[Solid]) -> Packed:
    """Flat arrays for the kernels; see Packed."""
    bodies = [(i, body) for i, solid in enumerate(solids) for body in _bodies(solid)]
    n = len(bodies)
    kind, owner, bore = np.zeros(n, np.int64), np.array([i for i, _ in bodies], dtype=np.int64), np.full(n, -1)
    centre, extent, size, matrix = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 2)), np.zeros((n, 3, 3))
    faces, vertices = [np.zeros((0, 4))] * n, [np.zeros((0, 3))] * n
    for i, (_, body) in enumerate(bodies):
        centre[i] = body.centre
        if isinstance(body, Cylinder):
            kind[i], size[i] = CYLINDER, (body.radius, body.height / 2)
            extent[i] = body.radius, body.radius, body.height / 2
        elif isinstance(body, Ellipsoid):
            axes, half = rotation(body.quaternion).T, np.array(body.semi_axes)
            kind[i], size[i, 0], matrix[i] = ELLIPSOID, half.min(), axes / half[:, None]
            extent[i] = np.linalg.norm(axes * half[:, None], axis=0)
        else:
            kind[i] = POLYHEDRON
            hull, axes = _hull(body), rotation(body.quaternion).T
            normals, corners = hull.normals @ axes, hull.vertices @ axes
            low, high = corners.min(axis=0), corners.max(axis=0)
            middle, extent[i] = (low + high) / 2, (high - low) / 2
            centre[i] += middle
            faces[i] = np.column_stack([normals, hull.distances - normals @ middle])
            vertices[i] = corners - middle
        if i and isinstance(solids[owner[i]], Tube) and owner[i] == owner[i - 1]:
            bore[i - 1 : i + 1] = i, -2
    return Packed(
        kind, np.array([body.attenuation for _, body in bodies], dtype=np.float64), centre, extent, owner,
        bore.astype(np.int64), size, matrix, _starts(faces), np.concatenate([np.zeros((0, 4)), *faces]),
        _starts(vertices), np.concatenate([np.zeros((0, 3)), *vertices]),
    )  # fmt: skip


def rotation(quaternion: Quaternion) -> Reals:
    """Rotation matrix [3, 3] of a quaternion (w, x, y, z) of any length but zero."""
    length = math.hypot(*quaternion)  # numpy's norm overflows or underflows for 1e200 and 1e-200
    w, x, y, z = (part / length for part in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _bodies(solid: Solid) -> list[Cylinder | Ellipsoid | Faceted]:
    if isinstance(solid, Tube):
        return [
            Cylinder(solid.outer_radius, solid.height, solid.attenuation, solid.centre),
            Cylinder(solid.inner_radius, solid.height, -solid.attenuation, solid.centre),
        ]
    return [solid]


def _hull(solid: Faceted) -> polyhedra.Hull:
    match solid:
        case Box():
            return polyhedra.box([edge / 2 for edge in solid.edges])
        case Octahedron():
            return polyhedra.octahedron(solid.half_diagonals)
        case TruncatedOctahedron():
            return polyhedra.octahedron(solid.half_diagonals, solid.cut)
        case Plate():
            return polyhedra.plate(solid.width, solid.thickness)
        case Polyhedron():
            return solid.hull()


def _starts(parts: list[Reals]) -> Wholes:
    """Start of each part in their concatenation, and the end of the last."""
    return np.cumsum([0] + [len(part) for part in parts], dtype=np.int64)
