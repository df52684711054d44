"""Corners of polyhedra around the origin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from simulators.samples.bodies.solids import Vector


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
