"""Solids: analytic bodies with a constant attenuation, as values.

Where solids overlap their attenuations add up: a particle in a matrix is given by its contrast to the matrix, a hole
by a negative attenuation. Lengths are in mm, attenuation in 1/mm, positions (x, y, z) in the sample's frame (z is the
rotation axis), orientations quaternions (w, x, y, z) of any length that turn the body's own axes into the sample's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from simulators.samples.bodies.polyhedra import Hull, hull_of_faces, hull_of_vertices

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Face = tuple[float, float, float, float]
ORIGIN: Vector = (0.0, 0.0, 0.0)
UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)
LEAST, MOST = 1e-9, 1e9
"""mm: with lengths far beyond, squares and quotients in the kernels overflow."""
DENSEST = 1e12
"""1/mm: with far larger ones, sums over chords overflow."""


@dataclass(frozen=True)
class Cylinder:
    """Full cylinder of finite height; its axis is parallel to z."""

    radius: float
    height: float
    attenuation: float
    centre: Vector = ORIGIN

    def __post_init__(self) -> None:
        _check(self, radius=self.radius, height=self.height)

    @property
    def volume(self) -> float:
        return math.pi * self.radius**2 * self.height


@dataclass(frozen=True)
class Tube:
    """Wall between two coaxial cylinders of the same height, open at both ends; its axis is parallel to z."""

    outer_radius: float
    inner_radius: float
    height: float
    attenuation: float
    centre: Vector = ORIGIN

    def __post_init__(self) -> None:
        _check(self, inner_radius=self.inner_radius, outer_radius=self.outer_radius, height=self.height)
        if not math.inf > self.outer_radius > self.inner_radius:
            raise ValueError(
                f"tube: outer_radius must exceed the inner {self.inner_radius} mm, got {self.outer_radius}"
            )

    @property
    def volume(self) -> float:
        return math.pi * (self.outer_radius**2 - self.inner_radius**2) * self.height


@dataclass(frozen=True)
class Ellipsoid:
    """Ellipsoid of any orientation; three equal semi-axes make a sphere."""

    semi_axes: Vector
    attenuation: float
    centre: Vector = ORIGIN
    quaternion: Quaternion = UPRIGHT

    def __post_init__(self) -> None:
        _check(self, semi_axes=self.semi_axes)

    @property
    def volume(self) -> float:
        return 4 / 3 * math.pi * math.prod(self.semi_axes)


@dataclass(frozen=True)
class Box:
    """Box of any orientation, given by its full edge lengths."""

    edges: Vector
    attenuation: float
    centre: Vector = ORIGIN
    quaternion: Quaternion = UPRIGHT

    def __post_init__(self) -> None:
        _check(self, edges=self.edges)

    @property
    def volume(self) -> float:
        return math.prod(self.edges)


@dataclass(frozen=True)
class Octahedron:
    """Octahedron |x|/a + |y|/b + |z|/c <= 1 in its own axes, (a, b, c) being `half_diagonals`; any orientation."""

    half_diagonals: Vector
    attenuation: float
    centre: Vector = ORIGIN
    quaternion: Quaternion = UPRIGHT

    def __post_init__(self) -> None:
        _check(self, half_diagonals=self.half_diagonals)

    @property
    def volume(self) -> float:
        return 4 / 3 * math.prod(self.half_diagonals)


@dataclass(frozen=True)
class Plate:
    """Hexagonal plate, the habit of layered oxides such as LiCoO2; any orientation.

    The hexagon lies in its own x and y with corners on the x axis; `width` is measured from corner to corner.
    """

    width: float
    thickness: float
    attenuation: float
    centre: Vector = ORIGIN
    quaternion: Quaternion = UPRIGHT

    def __post_init__(self) -> None:
        _check(self, width=self.width, thickness=self.thickness)

    @property
    def volume(self) -> float:
        return 3 * math.sqrt(3) / 8 * self.width**2 * self.thickness


@dataclass(frozen=True)
class TruncatedOctahedron:
    """Octahedron whose corners are cut off, the habit of well-grown spinel and layered oxides; any orientation.

    |x|/a + |y|/b + |z|/c <= 1 and |x|/a, |y|/b, |z|/c <= `cut` in its own axes, (a, b, c) being `half_diagonals`:
    at 1/2 the squares touch at their corners, at 2/3 all edges are equal, and towards 1 the octahedron is whole.
    """

    half_diagonals: Vector
    attenuation: float
    cut: float = 2 / 3
    centre: Vector = ORIGIN
    quaternion: Quaternion = UPRIGHT

    def __post_init__(self) -> None:
        _check(self, half_diagonals=self.half_diagonals)
        if not 0.5 <= self.cut < 1:
            raise ValueError(f"truncated_octahedron: cut must be >= 0.5 and < 1, got {self.cut}")

    @property
    def volume(self) -> float:
        return 4 * math.prod(self.half_diagonals) * (1 / 3 - (1 - self.cut) ** 3)


@dataclass(frozen=True)
class Polyhedron:
    """Convex polyhedron, given by its corners or by its faces; any orientation.

    `vertices` are (x, y, z) in mm in its own axes. `faces` are (nx, ny, nz, distance): inside is where n · (x, y, z) <=
    distance in mm for the unit normal n, which is given at any length.
    """

    attenuation: float
    vertices: tuple[Vector, ...] | None = None
    faces: tuple[Face, ...] | None = None
    centre: Vector = ORIGIN
    quaternion: Quaternion = UPRIGHT

    def __post_init__(self) -> None:
        _check(self)
        if (self.vertices is None) == (self.faces is None):
            raise ValueError("polyhedron: give either vertices or faces")
        given = [c for p in self.vertices or () for c in p] or [face[-1] for face in self.faces or () if face]
        self._check_size(max(map(abs, given), default=1.0))  # first, since their products may overflow
        corners = self.hull().vertices
        self._check_size(float(np.ptp(corners, axis=0).max()))
        self._check_size(float(np.abs(corners).max()))

    def _check_size(self, length: float) -> None:
        if math.isfinite(length) and not LEAST <= length <= MOST:
            raise ValueError(f"polyhedron: its size must lie in {LEAST:g} ... {MOST:g} mm, got {length:g}")

    def hull(self) -> Hull:
        """In its own axes."""
        if self.vertices is not None:
            return hull_of_vertices(self.vertices)
        return hull_of_faces(self.faces or ())

    @property
    def volume(self) -> float:
        return self.hull().volume


Faceted = Box | Octahedron | Plate | TruncatedOctahedron | Polyhedron
Solid = Cylinder | Tube | Ellipsoid | Faceted
SOLIDS: Mapping[str, type[Solid]] = MappingProxyType(
    {
        "cylinder": Cylinder,
        "tube": Tube,
        "ellipsoid": Ellipsoid,
        "box": Box,
        "octahedron": Octahedron,
        "plate": Plate,
        "truncated_octahedron": TruncatedOctahedron,
        "polyhedron": Polyhedron,
    }
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
    if not isinstance(solid, Cylinder | Tube) and not 0 < math.hypot(*solid.quaternion) < math.inf:
        raise ValueError(f"{name}: quaternion must be four numbers (w, x, y, z), finite and not all zero")
