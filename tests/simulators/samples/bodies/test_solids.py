"""Solids: volumes against closed forms and hulls, packing that keeps them, and what is no solid refused."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from simulators.frame.mapping import SceneError, choose
from simulators.samples.bodies.packing import CYLINDER, ELLIPSOID, POLYHEDRON, pack
from simulators.samples.bodies.solids import (
    SOLIDS,
    Box,
    Cylinder,
    Ellipsoid,
    Polyhedron,
    Solid,
    kind_of,
    octahedron,
    plate,
    truncated_octahedron,
)
from tests.simulators import bodies

CUBE = [(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]


def test_every_solid_can_be_named() -> None:
    assert tuple(SOLIDS) == ("cylinder", "ellipsoid", "box", "polyhedron")
    assert {kind_of(solid) for solid in bodies.SOLIDS.values()} == set(SOLIDS)


def test_a_scene_can_give_a_polyhedron_by_its_corners_and_no_removed_solid() -> None:
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    solid = choose("here", SOLIDS, {"kind": "polyhedron", "attenuation": 2, "vertices": corners})
    assert bodies.volume(solid) == pytest.approx(1 / 6)
    for removed in ("tube", "octahedron", "truncated_octahedron", "plate"):
        with pytest.raises(SceneError, match=f"'{removed}' is"):
            choose("here", SOLIDS, {"kind": removed, "attenuation": 2})
    with pytest.raises(SceneError, match="'faces'"):
        choose("here", SOLIDS, {"kind": "polyhedron", "attenuation": 2, "faces": []})


@pytest.mark.parametrize("name", bodies.SOLIDS)
def test_packed_faces_and_corners_are_the_hull(name: str) -> None:
    """A hull of the packed corners has the packed faces' planes, the solid's volume and the box that is given."""
    solid = bodies.SOLIDS[name]
    p = pack([Cylinder(1.0, 1.0, 1.0), solid, Ellipsoid((1.0, 1.0, 1.0), 1.0)])
    assert p.kind[[0, -1]].tolist() == [CYLINDER, ELLIPSOID]
    if p.kind[1] != POLYHEDRON:
        assert p.faces.size == p.vertices.size == 0
        return
    faces = p.faces[p.first_face[1] : p.first_face[2]]
    corners = p.vertices[p.first_vertex[1] : p.first_vertex[2]]
    hull = ConvexHull(corners)
    assert hull.volume == pytest.approx(bodies.volume(solid), rel=1e-12)
    assert set(hull.vertices) == set(range(len(corners)))
    planes = np.unique(np.round(hull.equations * [1, 1, 1, -1], 9), axis=0)
    ours = np.unique(np.round(faces, 9), axis=0)
    np.testing.assert_allclose(ours[np.lexsort(ours.T)], planes[np.lexsort(planes.T)], atol=2e-9)
    np.testing.assert_allclose(np.linalg.norm(faces[:, :3], axis=1), 1)
    np.testing.assert_allclose(corners.max(axis=0), p.extent[1], atol=1e-12)
    np.testing.assert_allclose(corners.min(axis=0), -p.extent[1], atol=1e-12)


def test_habits_have_the_volumes_that_textbooks_give() -> None:
    edge = 0.3
    thirds = truncated_octahedron((3 * edge / math.sqrt(2),) * 3, 2 / 3)  # regular: a third of its edges is cut away
    for corners, volume in (
        (thirds, 8 * math.sqrt(2) * edge**3),
        (plate(2 * edge, 0.1), 3 * math.sqrt(3) / 2 * edge**2 * 0.1),
        (octahedron((0.2, 0.3, 0.4)), 4 / 3 * 0.024),
        (truncated_octahedron((0.2, 0.3, 0.4), 0.8), 4 * 0.024 * (1 / 3 - 0.2**3)),
    ):
        assert ConvexHull(corners).volume == pytest.approx(volume)


def test_coplanar_corners_make_one_face() -> None:
    turn = np.arange(32) * np.pi / 16
    prism = tuple((float(np.cos(a)), float(np.sin(a)), z) for a in turn for z in (0.0, 0.5))
    for corners, faces in ((CUBE, 6), (prism, 34), (octahedron((0.2, 0.3, 0.4)), 8), (plate(0.5, 0.1), 8)):
        for scale in (1e-6, 1.0, 1e6):
            sized = tuple((scale * x, scale * y, scale * z) for x, y, z in corners)
            hull = Polyhedron(sized, 1.0).hull()
            assert len(hull.normals) == faces
            assert (np.array(sized) @ hull.normals.T <= hull.distances + 1e-12 * scale).all()


def _sized(factor: float) -> tuple[tuple[float, float, float], ...]:
    return tuple((factor * x, factor * y, factor * z) for x, y, z in bodies.CORNERS)


@pytest.mark.parametrize("length", [1e-320, 1e-200, 1e200])
def test_quaternions_may_have_any_length(length: float) -> None:
    """Where squares of them are no numbers, too."""
    w, x, y, z = bodies.QUATERNION
    turned = pack([Box((0.1, 0.2, 0.3), 1.0, quaternion=bodies.QUATERNION)])
    scaled = pack([Box((0.1, 0.2, 0.3), 1.0, quaternion=(w * length, x * length, y * length, z * length))])
    np.testing.assert_allclose(scaled.faces, turned.faces, atol=1e-3 if length < 1e-300 else 1e-15)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Cylinder(0.0, 1.0, 1.0), "cylinder: radius must be positive in mm, got 0.0"),
        (lambda: Ellipsoid((0.1, -0.1, 0.1), 1.0), "ellipsoid: semi_axes must be"),
        (lambda: Box((0.1, 0.1, math.nan), 1.0), "box: edges must be"),
        (lambda: Box((0.1, 0.1, 0.1), 1.0, quaternion=(0, 0, 0, 0)), "finite and not all zero"),
        (lambda: Box((0.1, 0.1, 0.1), 1.0, quaternion=(math.nan, 0, 0, 0)), "finite and not all zero"),
        (lambda: Ellipsoid((1e-308, 0.1, 0.1), 1.0), r"semi_axes must lie in 1e-09 \.\.\. 1e\+09 mm, got \(1e-308"),
        (lambda: Cylinder(0.1, 0.1, 1.0, (0, -1e10, 0)), r"centre must lie within 1e\+09 mm"),
        (lambda: Cylinder(0.1, 0.1, 1.0, (0, math.nan, 0)), "must be finite"),
        (lambda: Ellipsoid((0.1, 0.1, 0.1), 1e300), r"attenuation must lie within 1e\+12 1/mm"),
        (lambda: Polyhedron(_sized(1e300), 1.0), r"size must lie in 1e-09 \.\.\. 1e\+09 mm, got 3e\+299"),
        (lambda: Polyhedron(_sized(1e-200), 1.0), "size must lie in"),
        (lambda: Polyhedron(bodies.CORNERS, math.nan), "polyhedron: attenuation nan"),
        (lambda: Polyhedron(tuple(CUBE[:3]), 1.0), "vertices must be 4 or more, finite"),
        (lambda: Polyhedron((*CUBE[:4], (0, 0, np.inf)), 1.0), "vertices must be 4 or more, finite"),
        (lambda: Polyhedron(tuple(CUBE[:4]), 1.0), "its 4 vertices lie in a plane"),
        (lambda: Polyhedron(((0, 0, 0), (1, 1, 1), (2, 2, 2), (5, 5, 5)), 1.0), "lie in a plane"),
        (lambda: Polyhedron((*CUBE, (0.1, 0.2, 0.3)), 1.0), r"vertex 8 at \(0.1, 0.2, 0.3\) mm is not a corner"),
        (lambda: Polyhedron((*CUBE, (1, 1, 0)), 1.0), "vertex 8 at .* leave it out"),
        (lambda: Polyhedron(((0, 0, 1), *CUBE), 1.0), r"vertex 0 at \(0, 0, 1\)"),
    ],
)
def test_impossible_solids_are_refused(make: Callable[[], Solid], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()
