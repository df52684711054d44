"""Packing: solids as flat arrays for the kernels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from simulators.samples.bodies.solids import Cylinder, Ellipsoid, Quaternion, Solid

Reals = NDArray[np.float64]
Wholes = NDArray[np.int64]

CYLINDER, ELLIPSOID, POLYHEDRON = 0, 1, 2


class Packed(NamedTuple):
    """Solids as flat arrays for numba, one entry a solid.

    Attributes:
        kind: int64 [n], CYLINDER, ELLIPSOID or POLYHEDRON.
        attenuation: float64 [n], 1/mm.
        centre, extent: float64 [n, 3], middle and half size of the axis-aligned box around the body, mm.
        size: float64 [n, 2]. CYLINDER: (radius, half height); ELLIPSOID: (smallest, largest semi-axis); POLYHEDRON: (0,
            distance of the farthest corner).
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
    size: Reals
    matrix: Reals
    first_face: Wholes
    faces: Reals
    first_vertex: Wholes
    vertices: Reals


def pack(solids: Sequence[Solid]) -> Packed:
    """Flat arrays for the kernels; see Packed."""
    n = len(solids)
    kind, size, matrix = np.zeros(n, np.int64), np.zeros((n, 2)), np.zeros((n, 3, 3))
    centre, extent = np.array([solid.centre for solid in solids]).reshape(n, 3), np.zeros((n, 3))
    faces, vertices = [np.zeros((0, 4))] * n, [np.zeros((0, 3))] * n
    for i, solid in enumerate(solids):
        if isinstance(solid, Cylinder):
            kind[i], size[i] = CYLINDER, (solid.radius, solid.height / 2)
            extent[i] = solid.radius, solid.radius, solid.height / 2
        elif isinstance(solid, Ellipsoid):
            axes, half = rotation(solid.quaternion).T, np.array(solid.semi_axes)
            kind[i], size[i], matrix[i] = ELLIPSOID, (half.min(), half.max()), axes / half[:, None]
            extent[i] = np.linalg.norm(axes * half[:, None], axis=0)
        else:
            kind[i] = POLYHEDRON
            hull, axes = solid.hull(), rotation(solid.quaternion).T
            normals, corners = hull.normals @ axes, hull.vertices @ axes
            low, high = corners.min(axis=0), corners.max(axis=0)
            middle, extent[i] = (low + high) / 2, (high - low) / 2
            centre[i] += middle
            faces[i] = np.column_stack([normals, hull.distances - normals @ middle])
            vertices[i] = corners - middle
            size[i, 1] = np.linalg.norm(vertices[i], axis=1).max()
    attenuation = np.array([solid.attenuation for solid in solids], dtype=np.float64)
    return Packed(
        kind, attenuation, centre, extent, size, matrix,
        _starts(faces), np.concatenate([np.zeros((0, 4)), *faces]),
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


def _starts(parts: list[Reals]) -> Wholes:
    """Start of each part in their concatenation, and the end of the last."""
    return np.cumsum([0] + [len(part) for part in parts], dtype=np.int64)
