"""Polyhedra against another implementation (Qhull): corners of faces, faces of corners, volumes; and what is none."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, HalfspaceIntersection

from simulators.samples.bodies.polyhedra import hull_of_faces, hull_of_vertices

CUBE = [(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]
SIDES = [(1, 0, 0, 1), (-1, 0, 0, 1), (0, 1, 0, 1), (0, -1, 0, 1), (0, 0, 1, 1), (0, 0, -1, 1)]


def _sorted(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    rows = np.unique(np.round(rows, 7), axis=0)
    return rows[np.lexsort(rows.T)]


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(4, 14), size=st.sampled_from([1e-3, 1.0, 50.0]))
def test_the_hull_of_points_on_a_ball(seed: int, n: int, size: float) -> None:
    """All are corners. Planes and volume are Qhull's; and from the planes come the same corners."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3))
    points *= size / np.linalg.norm(points, axis=1, keepdims=True)
    points += rng.normal(size=3) * size
    ours, theirs = hull_of_vertices(points.tolist()), ConvexHull(points)
    planes = np.column_stack([ours.normals, -ours.distances / size])
    np.testing.assert_allclose(_sorted(planes), _sorted(theirs.equations / [1, 1, 1, size]), atol=1e-6)
    assert ours.volume == pytest.approx(theirs.volume, rel=1e-6)
    back = hull_of_faces(
        np.column_stack([ours.normals * rng.uniform(0.1, 9, (len(ours.normals), 1)), ours.distances]).tolist()
    )
    assert back.volume == pytest.approx(theirs.volume, rel=1e-6)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(4, 12))
def test_faces_around_a_ball(seed: int, n: int) -> None:
    """Planes that touch the unit ball in points all around it; corners are Qhull's."""
    rng = np.random.default_rng(seed)
    normals = np.vstack([rng.normal(size=(n, 3)), [(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ours = hull_of_faces(np.column_stack([normals, np.ones(len(normals))]).tolist())
    theirs = HalfspaceIntersection(np.column_stack([normals, -np.ones(len(normals))]), np.zeros(3))
    np.testing.assert_allclose(_sorted(ours.vertices), _sorted(theirs.intersections), atol=1e-5)
    assert ours.volume == pytest.approx(ConvexHull(theirs.intersections).volume, rel=1e-6)
    assert len(ours.normals) == len(normals)  # each touches the ball, so each is a face


def test_coplanar_corners_make_one_face() -> None:
    cube = hull_of_vertices(CUBE)
    assert len(cube.normals) == 6
    np.testing.assert_allclose(
        _sorted(np.column_stack([cube.normals, cube.distances])), _sorted(np.array(SIDES, float))
    )
    assert cube.volume == pytest.approx(8)
    turn = np.arange(32) * np.pi / 16
    prism = hull_of_vertices([(np.cos(a), np.sin(a), z) for a in turn for z in (0.0, 0.5)])
    assert len(prism.normals) == 34
    assert prism.volume == pytest.approx(16 * np.sin(np.pi / 16) * 0.5)


def test_a_face_that_cuts_nothing_off_is_left_out() -> None:
    cube = hull_of_faces([*SIDES, (1, 1, 1, 9), (1, 1, 1, np.sqrt(3)), (2, 0, 0, 1)])  # far off; at a corner; twice
    assert len(cube.normals) == 6
    assert cube.volume == pytest.approx(8)
    assert len(hull_of_faces([*SIDES, (1, 1, 1, 1.5)]).normals) == 7


@pytest.mark.parametrize(
    ("vertices", "words"),
    [
        (CUBE[:3], "vertices must be 4 to 64 lists of 3 numbers, got 3"),
        ([(*corner, 0.0) for corner in CUBE], "vertices must be 4 to 64 lists of 3"),
        ([*CUBE[:4], (0, 0, np.inf)], "vertices must be finite"),
        (CUBE[:4], "its 4 vertices lie in a plane"),
        ([(0, 0, 0)] * 5, "its 5 vertices lie in a plane"),
        ([(0, 0, 0), (1, 1, 1), (2, 2, 2), (5, 5, 5)], "lie in a plane"),
        ([*CUBE, (0.1, 0.2, 0.3)], r"not convex: vertex 8 at \(0.1, 0.2, 0.3\) mm is not a corner"),
        ([*CUBE, (1, 1, 0)], "vertex 8 at .* leave it out"),
        ([(0, 0, 1), *CUBE], r"vertex 0 at \(0.0, 0.0, 1.0\)"),
    ],
)
def test_vertices_that_are_no_body(vertices: Sequence[Sequence[float]], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        hull_of_vertices(vertices)


@pytest.mark.parametrize(
    ("faces", "words"),
    [
        (SIDES[:3], "faces must be 4 to 64 lists of 4 numbers, got 3"),
        (SIDES[:5], "its 5 faces do not close it"),
        (SIDES[:4], "do not close it"),
        ([*SIDES[:5], (0, 0.5, 1, 1)], "do not close it"),
        ([*SIDES[:5], (0, 0, 0, 1)], "face 5 has a normal of length zero"),
        ([*SIDES[:5], (0, 0, -1, -2)], "nothing is inside all of its 6 faces"),
        ([*SIDES, (1, 1, 1, -2)], "nothing is inside"),
        ([*SIDES[:5], (0, 0, -1, -1)], "is flat; a body has a volume"),
        ([*SIDES[:5], (0, 0, np.nan, 1)], "faces must be finite"),
    ],
)
def test_faces_that_are_no_body(faces: Sequence[Sequence[float]], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        hull_of_faces(faces)
