"""Polyhedra: convex bodies as face planes and corners, computed from either; others are refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]

FLAT = 1e-9  # of the body's size: corners closer than this to a plane count as in it
MOST = 64  # corners or faces: all triples of them are tried


@dataclass(frozen=True, eq=False)
class Hull:
    """A bounded convex body with a volume, in its own axes.

    Attributes:
        normals: float64 [face, 3], unit, outward.
        distances: float64 [face], mm: inside is normal · p <= distance.
        vertices: float64 [vertex, 3], mm.
    """

    normals: Reals
    distances: Reals
    vertices: Reals

    @property
    def volume(self) -> float:
        """mm³: a pyramid from the middle of the corners on each face, cut into triangles."""
        middle = self.vertices.mean(axis=0)
        size = np.linalg.norm(self.vertices - middle, axis=1).max()
        volume = 0.0
        for normal, distance in zip(self.normals, self.distances, strict=True):
            corners = self.vertices[np.abs(self.vertices @ normal - distance) <= 10 * FLAT * size]
            spokes = corners - corners.mean(axis=0)
            first = spokes[np.linalg.norm(spokes, axis=1).argmax()]
            around = np.arctan2(spokes @ np.cross(normal, first), spokes @ first)
            spokes = spokes[around.argsort()]
            area = np.cross(spokes, np.roll(spokes, -1, axis=0)).sum(axis=0) @ normal / 2
            volume += area * float(distance - middle @ normal) / 3
        return float(volume)


def box(half: Sequence[float]) -> Hull:
    """|x|, |y|, |z| <= half."""
    signs = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=np.float64)
    return _scaled(np.vstack([np.eye(3), -np.eye(3)]), np.ones(6), signs, half)


def octahedron(half: Sequence[float], cut: float = 1.0) -> Hull:
    """|x|/a + |y|/b + |z|/c <= 1 with (a, b, c) = half, and |x|/a, |y|/b, |z|/c <= cut, from 1/2 to 1 (not cut)."""
    signs = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=np.float64)
    ends = np.vstack([np.eye(3), -np.eye(3)])
    if cut == 1:
        return _scaled(signs, np.ones(8), ends, half)
    rim = (1 - cut) * ends
    corners = np.array([cut * end + side for end in ends for side in rim if not (end * side).any()])
    corners = np.unique(np.round(corners, 15), axis=0)  # at 1/2 they meet in pairs
    return _scaled(np.vstack([signs, ends]), np.append(np.ones(8), np.full(6, cut)), corners, half)


def plate(width: float, thickness: float) -> Hull:
    """Hexagon in x and y with corners on the x axis, `width` from corner to corner."""
    turn = np.arange(6) * np.pi / 3
    hexagon = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    sides = np.stack([np.cos(turn + np.pi / 6), np.sin(turn + np.pi / 6), np.zeros(6)], axis=1)
    corners = np.array([(*corner, z) for corner in hexagon * (width / 2) for z in (-thickness / 2, thickness / 2)])
    normals = np.vstack([sides, [(0, 0, 1), (0, 0, -1)]])
    return Hull(normals, np.append(np.full(6, np.sqrt(3) / 4 * width), [thickness / 2] * 2), corners)


def hull_of_vertices(vertices: Sequence[Sequence[float]]) -> Hull:
    """The convex polyhedron with these corners, mm.

    Raises:
        ValueError: fewer than 4 or too many, all in a plane, or one that is not a corner of their hull.
    """
    points = _numbers("vertices", vertices, 3)
    size = float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())
    a, b, c = (points[list(index)] for index in zip(*combinations(range(len(points)), 3), strict=True))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    some = length > FLAT * size**2
    normals, distances = normals[some] / length[some, None], np.einsum("ij,ij->i", normals, a)[some] / length[some]
    heights = normals @ points.T - distances[:, None]
    low, high = heights.min(axis=1, initial=0), heights.max(axis=1, initial=0)
    if not (np.maximum(high, -low) > 1e3 * FLAT * size).any():
        raise ValueError(f"polyhedron: its {len(points)} vertices lie in a plane; a body needs four that do not")
    up, down = high <= FLAT * size, low >= -FLAT * size
    normals, distances = _distinct(
        np.vstack([normals[up], -normals[down]]), np.append(distances[up], -distances[down]), size
    )
    on = np.abs(normals @ points.T - distances[:, None]) <= 10 * FLAT * size
    for i, point in enumerate(points):
        if np.linalg.matrix_rank(normals[on[:, i]], tol=1e-6) < 3:
            raise ValueError(
                f"polyhedron: not convex: vertex {i} at {tuple(point.tolist())} mm is not a corner of the hull of all; "
                f"leave it out, or describe the body by several convex ones"
            )
    return Hull(normals, distances, points)


def hull_of_faces(faces: Sequence[Sequence[float]]) -> Hull:
    """The convex polyhedron inside these half-spaces (nx, ny, nz, distance): n · p <= distance in mm for the unit
    normal; redundant ones are dropped.

    Raises:
        ValueError: a normal of length zero, fewer than 4 faces or too many, nothing inside all of them, or a body
            without bounds.
    """
    planes = _numbers("faces", faces, 4)
    largest = np.abs(planes[:, :3]).max(axis=1)
    if not largest.all():
        raise ValueError(f"polyhedron: face {int(largest.argmin())} has a normal of length zero")
    normals, distances = (
        planes[:, :3] / largest[:, None],
        planes[:, 3],
    )  # scaled first, since their squares may overflow
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # Bounded if no direction leads away from all faces: the normals then span space with positive weights. The extreme
    # directions are among those along two faces.
    i, j = np.array(list(combinations(range(len(normals)), 2))).T
    along = np.cross(normals[i], normals[j])
    reach = np.linalg.norm(along, axis=1)
    along = along[reach > 1e-9] / reach[reach > 1e-9, None]
    ways = np.vstack([along, -along])
    if np.linalg.matrix_rank(normals, tol=1e-9) < 3 or (ways @ normals.T <= 1e-9).all(axis=1).any():
        raise ValueError(f"polyhedron: its {len(normals)} faces do not close it: it has no bounds in some direction")
    triples = np.array(list(combinations(range(len(normals)), 3)))
    corner = np.abs(np.linalg.det(normals[triples])) > 1e-9
    points = np.linalg.solve(normals[triples[corner]], distances[triples[corner]][..., None])[..., 0]
    size = max(float(np.abs(distances).max()), 1e-300)
    inside = (points @ normals.T <= distances + FLAT * size).all(axis=1)
    vertices = _distinct_points(points[inside], size)
    if len(vertices) < 4:
        raise ValueError(f"polyhedron: nothing is inside all of its {len(normals)} faces")
    size = float(np.linalg.norm(vertices - vertices.mean(axis=0), axis=1).max())
    if np.linalg.matrix_rank(vertices - vertices[0], tol=1e-6 * size) < 3:
        raise ValueError(f"polyhedron: the space inside its {len(normals)} faces is flat; a body has a volume")
    normals, distances = _distinct(normals, distances, size)
    on = np.abs(normals @ vertices.T - distances[:, None]) <= 10 * FLAT * size
    needed = [np.linalg.matrix_rank(vertices[row] - vertices[row][:1], tol=1e-6 * size) == 2 for row in on]
    return Hull(normals[needed], distances[needed], vertices)


def _numbers(name: str, values: Sequence[Sequence[float]], width: int) -> Reals:
    """[n, width], 4 <= n <= MOST, all finite."""
    if not 4 <= len(values) <= MOST or any(len(value) != width for value in values):
        raise ValueError(f"polyhedron: {name} must be 4 to {MOST} lists of {width} numbers, got {len(values)}")
    numbers = np.array(values, dtype=np.float64)
    if not np.isfinite(numbers).all():
        raise ValueError(f"polyhedron: {name} must be finite, got {numbers[~np.isfinite(numbers).all(axis=1)][0]}")
    return numbers


def _scaled(normals: Reals, distances: Reals, vertices: Reals, half: Sequence[float]) -> Hull:
    """A body of half size 1, stretched."""
    size = np.array(half, dtype=np.float64)
    stretched = normals / size
    length = np.linalg.norm(stretched, axis=1)
    return Hull(stretched / length[:, None], distances / length, vertices * size)


def _distinct(normals: Reals, distances: Reals, size: float) -> tuple[Reals, Reals]:
    """Each plane once."""
    kept: list[int] = []
    for i, normal in enumerate(normals):
        near = np.linalg.norm(normals[kept] - normal, axis=1) + np.abs(distances[kept] - distances[i]) / size
        if not (near < 1e-6).any():
            kept.append(i)
    return normals[kept], distances[kept]


def _distinct_points(points: Reals, size: float) -> Reals:
    """Each point once."""
    kept: list[int] = []
    for i, point in enumerate(points):
        if not (np.linalg.norm(points[kept] - point, axis=1) < 1e-6 * size).any():
            kept.append(i)
    return points[kept]
