"""Solids: analytic bodies with a constant attenuation, as values, and their packing into flat arrays for the kernels.

Where solids overlap their attenuations add up: a particle in a matrix is given by its contrast to the matrix, a hole
by a negative attenuation. Lengths are in mm, attenuation in 1/mm, positions (x, y, z) in the sample's frame (z is the
rotation axis), orientations quaternions (w, x, y, z) of any length that turn the body's own axes into the sample's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

CYLINDER, ELLIPSOID, SLABS = 0, 1, 2
MAX_SLABS = 4  # an octahedron is the intersection of four slabs, a box of three

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
ORIGIN: Vector = (0.0, 0.0, 0.0)
UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)


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
        _check(self, inner_radius=self.inner_radius, height=self.height)
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


Solid = Cylinder | Tube | Ellipsoid | Box | Octahedron
SOLIDS: Mapping[str, type[Solid]] = MappingProxyType(
    {cls.__name__.lower(): cls for cls in (Cylinder, Tube, Ellipsoid, Box, Octahedron)}
)


@dataclass(frozen=True, eq=False)
class Packed:
    """Solids as flat arrays, one entry a body (a tube is two: outer and, negative, inner).

    Attributes:
        kind: int64 [n], CYLINDER, ELLIPSOID or SLABS.
        attenuation: float64 [n].
        centre, extent: float64 [n, 3], middle and half size of the axis-aligned box around the body.
        planes: float64 [n, MAX_SLABS, 3]. ELLIPSOID: rows 0..2 are W with |W q| <= 1 inside; SLABS: unit normals.
        half: float64 [n, MAX_SLABS]. CYLINDER: (radius, half height); ELLIPSOID: (smallest semi-axis,); SLABS:
            |normal · q| <= half inside, infinite for unused slabs.
    """

    kind: NDArray[np.int64]
    attenuation: NDArray[np.float64]
    centre: NDArray[np.float64]
    extent: NDArray[np.float64]
    planes: NDArray[np.float64]
    half: NDArray[np.float64]


def pack(solids: Sequence[Solid]) -> Packed:
    """Flat arrays for the kernels; see Packed."""
    bodies = [body for solid in solids for body in _bodies(solid)]
    n = len(bodies)
    packed = Packed(
        np.zeros(n, np.int64),
        np.zeros(n),
        np.zeros((n, 3)),
        np.zeros((n, 3)),
        np.zeros((n, MAX_SLABS, 3)),
        np.full((n, MAX_SLABS), np.inf),
    )
    for i, body in enumerate(bodies):
        packed.attenuation[i], packed.centre[i] = body.attenuation, body.centre
        if isinstance(body, Cylinder):
            packed.kind[i] = CYLINDER
            packed.half[i, :2] = body.radius, body.height / 2
            packed.extent[i] = body.radius, body.radius, body.height / 2
            continue
        axes = rotation(body.quaternion).T  # row k: the body's k-th axis in the sample's frame
        if isinstance(body, Ellipsoid):
            size = np.array(body.semi_axes)
            packed.kind[i] = ELLIPSOID
            packed.planes[i, :3] = axes / size[:, None]
            packed.half[i, 0] = size.min()
            packed.extent[i] = np.linalg.norm(axes * size[:, None], axis=0)
        elif isinstance(body, Box):
            size = np.array(body.edges) / 2
            packed.kind[i] = SLABS
            packed.planes[i, :3], packed.half[i, :3] = axes, size
            packed.extent[i] = np.abs(axes * size[:, None]).sum(axis=0)
        else:
            size = np.array(body.half_diagonals)
            normals = np.array([(1, 1, 1), (1, 1, -1), (1, -1, 1), (-1, 1, 1)]) / size
            length = np.linalg.norm(normals, axis=1)
            packed.kind[i] = SLABS
            packed.planes[i], packed.half[i] = (normals / length[:, None]) @ axes, 1 / length
            packed.extent[i] = np.abs(axes * size[:, None]).max(axis=0)
    return packed


def rotation(quaternion: Quaternion) -> NDArray[np.float64]:
    """Rotation matrix [3, 3] of a quaternion (w, x, y, z) of any length but zero."""
    w, x, y, z = np.array(quaternion, dtype=np.float64) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _bodies(solid: Solid) -> list[Cylinder | Ellipsoid | Box | Octahedron]:
    if isinstance(solid, Tube):
        return [
            Cylinder(solid.outer_radius, solid.height, solid.attenuation, solid.centre),
            Cylinder(solid.inner_radius, solid.height, -solid.attenuation, solid.centre),
        ]
    return [solid]


def _check(solid: Solid, **lengths: float | Vector) -> None:
    """Raises ValueError for a length that is not positive, a non-finite number or a zero quaternion."""
    name = type(solid).__name__.lower()
    for key, value in lengths.items():
        if not all(math.isfinite(v) and v > 0 for v in (value if isinstance(value, tuple) else (value,))):
            raise ValueError(f"{name}: {key} must be positive in mm, got {value}")
    if not all(math.isfinite(v) for v in (solid.attenuation, *solid.centre)):
        raise ValueError(f"{name}: attenuation {solid.attenuation} and centre {solid.centre} must be finite")
    if isinstance(solid, Ellipsoid | Box | Octahedron) and not math.hypot(*solid.quaternion) > 0:
        raise ValueError(f"{name}: quaternion must be four numbers (w, x, y, z), not all zero")
