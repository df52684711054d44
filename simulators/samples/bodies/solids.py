"""Solids: analytic bodies with a constant attenuation, as values.

The attenuations of overlapping solids add up: a particle in a matrix has its contrast to the matrix as attenuation, and
a hole has a negative attenuation. Lengths are in mm, attenuation in 1/mm, positions (x, y, z) in the sample's frame (z
is the rotation axis). Orientations are quaternions (w, x, y, z) of any length that turn the body's axes into the
sample's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Annotated

import numpy as np
import scipy
from numpy.typing import NDArray

from recon.base.setting import Setting

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
ORIGIN: Vector = (0.0, 0.0, 0.0)
UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)
LEAST, MOST = 1e-9, 1e9  # mm: with much larger lengths, squares and quotients in the kernels overflow
Millimetres = Annotated[float, Setting(ge=LEAST, le=MOST)]
Micrometres = Annotated[float, Setting(ge=1e3 * LEAST, le=1e3 * MOST)]
Gap = Annotated[float, Setting(ge=0, le=1e3 * MOST)]  # um
DENSEST = 1e12  # 1/mm: with much larger attenuations, sums over chords overflow
FLAT = 1e-9  # Share of the size of a body: a corner closer than this to a plane counts as in the plane


@dataclass(frozen=True)
class Cylinder:
    """Full cylinder of finite height; its axis is parallel to z."""

    radius: float
    height: float
    attenuation: float
    centre: Vector = ORIGIN

    def __post_init__(self) -> None:
        _check(self, radius=self.radius, height=self.height)


@dataclass(frozen=True)
class Ellipsoid:
    """Ellipsoid of any orientation; three equal semi-axes make a sphere."""

    semi_axes: Vector
    attenuation: float
    centre: Vector = ORIGIN
    quaternion: Quaternion = UPRIGHT

    def __post_init__(self) -> None:
        _check(self, semi_axes=self.semi_axes)


@dataclass(frozen=True)
class Box:
    """Box of any orientation, given by its full edge lengths."""

    edges: Vector
    attenuation: float
    centre: Vector = ORIGIN
    quaternion: Quaternion = UPRIGHT

    def __post_init__(self) -> None:
        _check(self, edges=self.edges)

    def hull(self) -> Hull:
        half = np.array(self.edges) / 2
        signs = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=np.float64)
        return Hull(np.vstack([np.eye(3), -np.eye(3)]), np.append(half, half), signs * half)


@dataclass(frozen=True)
class Polyhedron:
    """Convex polyhedron of any orientation, given by its corners `vertices`, (x, y, z) in mm in its own axes."""

    vertices: tuple[Vector, ...]
    attenuation: float
    centre: Vector = ORIGIN
    quaternion: Quaternion = UPRIGHT

    def __post_init__(self) -> None:
        _check(self)
        if len(self.vertices) < 4 or not np.isfinite(self.vertices).all():
            raise ValueError(f"polyhedron: vertices must be 4 or more, finite, got {self.vertices}")
        for size in (float(np.abs(self.vertices).max()), float(np.ptp(self.vertices, axis=0).max())):
            if not LEAST <= size <= MOST:
                raise ValueError(f"polyhedron: its size must lie in {LEAST:g} ... {MOST:g} mm, got {size:g}")
        self.hull()

    def hull(self) -> Hull:
        """Raises ValueError if all corners lie in a plane, or a corner lies inside the hull of the others."""
        return _hull(tuple(map(tuple, self.vertices)))


@dataclass(frozen=True, eq=False)
class Hull:
    """A convex body in its own axes.

    Attributes:
        normals: float64 [face, 3], unit, outward.
        distances: float64 [face], mm: inside is normal · p <= distance.
        vertices: float64 [vertex, 3], mm.
    """

    normals: NDArray[np.float64]
    distances: NDArray[np.float64]
    vertices: NDArray[np.float64]


@lru_cache(4096)
def _hull(vertices: tuple[tuple[float, ...], ...]) -> Hull:
    """The hull of a convex polyhedron. A body keeps its hull if it is moved or turned, for example when a sample is
    packed."""
    points = np.array(vertices, dtype=np.float64)
    size = float(np.ptp(points, axis=0).max())
    try:
        convex = scipy.spatial.ConvexHull(points / size)
    except scipy.spatial.QhullError:
        raise ValueError(
            f"polyhedron: its {len(points)} vertices lie in a plane; a body needs four that do not"
        ) from None
    if others := set(range(len(points))) - set(convex.vertices.tolist()):
        which = f"vertex {min(others)} at {vertices[min(others)]} mm"
        raise ValueError(
            f"polyhedron: not convex: {which} is not a corner of the convex hull; omit the vertex, or "
            "describe the body by several convex ones"
        )
    # Faces of more than three corners come in triangles.
    _, once = np.unique(np.round(convex.equations / (1e3 * FLAT)) + 0.0, axis=0, return_index=True)
    faces = convex.equations[once]
    hull = Hull(faces[:, :3], -faces[:, 3] * size, points)
    for array in (hull.normals, hull.distances, hull.vertices):
        array.flags.writeable = False
    return hull


Solid = Cylinder | Ellipsoid | Box | Polyhedron
SOLIDS: Mapping[str, type[Solid]] = MappingProxyType(
    {"cylinder": Cylinder, "ellipsoid": Ellipsoid, "box": Box, "polyhedron": Polyhedron}
)
"""Every solid by the name that scenes and labels use."""

_KINDS = MappingProxyType({cls: kind for kind, cls in SOLIDS.items()})


def kind_of(solid: Solid) -> str:
    """The solid's name in SOLIDS."""
    return _KINDS[type(solid)]


def _check(solid: Solid, **lengths: float | Vector) -> None:
    """Raises ValueError for a length that is not positive or out of range, a non-finite number or a zero quaternion."""
    name = kind_of(solid)
    for key, value in lengths.items():
        each = value if isinstance(value, tuple) else (value,)
        if not all(math.isfinite(v) and v > 0 for v in each):
            raise ValueError(f"{name}: {key} must be positive in mm, got {value}")
        if not all(LEAST <= v <= MOST for v in each):
            raise ValueError(f"{name}: {key} must lie in {LEAST:g} ... {MOST:g} mm, got {value}")
    if not all(math.isfinite(v) for v in (solid.attenuation, *solid.centre)):
        raise ValueError(f"{name}: attenuation {solid.attenuation} and centre {solid.centre} must be finite")
    if abs(solid.attenuation) > DENSEST:
        raise ValueError(f"{name}: attenuation must lie within {DENSEST:g} 1/mm, got {solid.attenuation}")
    if max(map(abs, solid.centre)) > MOST:
        raise ValueError(f"{name}: centre must lie within {MOST:g} mm, got {solid.centre}")
    if not isinstance(solid, Cylinder) and not 0 < math.hypot(*solid.quaternion) < math.inf:
        raise ValueError(f"{name}: quaternion must be four numbers (w, x, y, z), finite and not all zero")


def octahedron(half: Vector) -> tuple[Vector, ...]:
    """Corners of |x|/a + |y|/b + |z|/c <= 1 with (a, b, c) = half, mm."""
    return corners(np.vstack([np.eye(3), -np.eye(3)]) * half)


def truncated_octahedron(half: Vector, cut: float) -> tuple[Vector, ...]:
    """Corners of an octahedron with |x|/a, |y|/b, |z|/c <= cut, above 1/2 and below 1; mm."""
    ends = np.vstack([np.eye(3), -np.eye(3)])
    ends_cut = np.array([cut * end + side for end in ends for side in (1 - cut) * ends if not (end * side).any()])
    return corners(np.unique(np.round(ends_cut, 15), axis=0) * half)


def plate(width: float, thickness: float) -> tuple[Vector, ...]:
    """Corners of a hexagon in x and y with corners on the x axis, `width` mm from corner to corner."""
    turn = np.arange(6) * np.pi / 3
    hexagon = np.stack([np.cos(turn), np.sin(turn)], axis=1) * (width / 2)
    return corners(np.array([(*corner, z) for corner in hexagon for z in (-thickness / 2, thickness / 2)]))


def corners(points: NDArray[np.float64]) -> tuple[Vector, ...]:
    """The points [corner, 3], mm, as a `Polyhedron` takes them."""
    return tuple((x, y, z) for x, y, z in points.tolist())
