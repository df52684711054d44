"""Solids: volumes against closed forms and hulls, packing that keeps them, and what is no solid refused."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from simulators.frame.mapping import choose
from simulators.samples.bodies.packing import CYLINDER, ELLIPSOID, POLYHEDRON, pack
from simulators.samples.bodies.solids import (
    SOLIDS,
    Box,
    Cylinder,
    Ellipsoid,
    Octahedron,
    Plate,
    Polyhedron,
    Solid,
    TruncatedOctahedron,
    Tube,
    kind_of,
)
from tests.simulators import bodies


def test_every_solid_can_be_named() -> None:
    kinds = ("cylinder", "tube", "ellipsoid", "box", "octahedron", "plate", "truncated_octahedron", "polyhedron")
    assert tuple(SOLIDS) == kinds
    assert {kind_of(solid) for solid in bodies.SOLIDS.values()} == set(kinds)


def test_a_scene_can_give_a_polyhedron() -> None:
    faces = [[1, 0, 0, 0.1], [-1, 0, 0, 0.1], [0, 1, 0, 0.2], [0, -1, 0, 0.2], [0, 0, 2, 0.3], [0, 0, -1, 0.3]]
    solid = choose("here", SOLIDS, {"kind": "polyhedron", "attenuation": 2, "faces": faces})
    assert solid.volume == pytest.approx(0.2 * 0.4 * 0.6)
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    assert choose(
        "here", SOLIDS, {"kind": "polyhedron", "attenuation": 2, "vertices": corners}
    ).volume == pytest.approx(1 / 6)


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
    assert hull.volume == pytest.approx(solid.volume, rel=1e-12)
    assert set(hull.vertices) == set(range(len(corners)))
    planes = np.unique(np.round(hull.equations * [1, 1, 1, -1], 9), axis=0)
    ours = np.unique(np.round(faces, 9), axis=0)
    np.testing.assert_allclose(ours[np.lexsort(ours.T)], planes[np.lexsort(planes.T)], atol=2e-9)
    np.testing.assert_allclose(np.linalg.norm(faces[:, :3], axis=1), 1)
    np.testing.assert_allclose(corners.max(axis=0), p.extent[1], atol=1e-12)
    np.testing.assert_allclose(corners.min(axis=0), -p.extent[1], atol=1e-12)


def test_volumes_that_textbooks_give() -> None:
    edge = 0.3
    octahedron = (3 * edge / math.sqrt(2),) * 3  # a regular truncated octahedron has a third of its edges cut away
    assert TruncatedOctahedron(octahedron, 1.0).volume == pytest.approx(8 * math.sqrt(2) * edge**3)
    assert Plate(2 * edge, 0.1, 1.0).volume == pytest.approx(3 * math.sqrt(3) / 2 * edge**2 * 0.1)
    cuboctahedron = TruncatedOctahedron((edge * math.sqrt(2),) * 3, 1.0, cut=0.5)
    assert cuboctahedron.volume == pytest.approx(5 / 3 * math.sqrt(2) * edge**3)
    assert Octahedron((0.2, 0.3, 0.4), 1.0).volume == pytest.approx(4 / 3 * 0.024)
    nearly = TruncatedOctahedron((0.2, 0.3, 0.4), 1.0, cut=1 - 1e-6)
    assert nearly.volume == pytest.approx(4 / 3 * 0.024)


def test_a_tube_is_packed_with_its_bore() -> None:
    p = pack([Cylinder(1.0, 1.0, 1.0), Tube(1.0, 0.5, 1.0, 2.0), Tube(1.0, 0.7, 1.0, 3.0)])
    assert p.owner.tolist() == [0, 1, 1, 2, 2]
    assert p.bore.tolist() == [-1, 2, -2, 4, -2]
    assert p.attenuation.tolist() == [1, 2, -2, 3, -3]


def _sized(factor: float) -> tuple[tuple[float, float, float], ...]:
    return tuple((factor * x, factor * y, factor * z) for x, y, z in bodies.CORNERS)


@pytest.mark.parametrize("length", [1e-320, 1e-200, 1e200])
def test_quaternions_and_normals_may_have_any_length(length: float) -> None:
    """Where squares of them are no numbers, too."""
    w, x, y, z = bodies.QUATERNION
    turned = pack([Box((0.1, 0.2, 0.3), 1.0, quaternion=bodies.QUATERNION)])
    scaled = pack([Box((0.1, 0.2, 0.3), 1.0, quaternion=(w * length, x * length, y * length, z * length))])
    np.testing.assert_allclose(scaled.faces, turned.faces, atol=1e-3 if length < 1e-300 else 1e-15)
    faces = [(a * length, b * length, c * length, d) for a, b, c, d in bodies.WEDGE]
    wedge = Polyhedron(1.0, faces=tuple(faces))
    assert wedge.volume == pytest.approx(Polyhedron(1.0, faces=bodies.WEDGE).volume, rel=1e-3)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Cylinder(0.0, 1.0, 1.0), "cylinder: radius must be positive in mm, got 0.0"),
        (lambda: Tube(0.2, 0.3, 1.0, 1.0), "outer_radius must exceed the inner 0.3"),
        (lambda: Ellipsoid((0.1, -0.1, 0.1), 1.0), "ellipsoid: semi_axes must be"),
        (lambda: Box((0.1, 0.1, math.nan), 1.0), "box: edges must be"),
        (lambda: Box((0.1, 0.1, 0.1), 1.0, quaternion=(0, 0, 0, 0)), "finite and not all zero"),
        (lambda: Box((0.1, 0.1, 0.1), 1.0, quaternion=(math.nan, 0, 0, 0)), "finite and not all zero"),
        (lambda: Octahedron((0.1, 0.1, 0.1), math.inf), "must be finite"),
        (lambda: Ellipsoid((1e-308, 0.1, 0.1), 1.0), r"semi_axes must lie in 1e-09 \.\.\. 1e\+09 mm, got \(1e-308"),
        (lambda: Tube(1e308, 0.3, 1.0, 1.0), "outer_radius must lie in"),
        (lambda: Cylinder(0.1, 0.1, 1.0, (0, -1e10, 0)), r"centre must lie within 1e\+09 mm"),
        (lambda: Cylinder(0.1, 0.1, 1.0, (0, math.nan, 0)), "must be finite"),
        (lambda: Plate(0.1, 0.0, 1.0), "plate: thickness must be positive"),
        (lambda: TruncatedOctahedron((0.1, 0.1, 0.1), 1.0, 1.0), "truncated_octahedron: cut must be >= 0.5 and < 1"),
        (lambda: TruncatedOctahedron((0.1, 0.1, 0.1), 1.0, 0.4), "got 0.4"),
        (lambda: Ellipsoid((0.1, 0.1, 0.1), 1e300), r"attenuation must lie within 1e\+12 1/mm"),
        (lambda: Polyhedron(1.0, vertices=_sized(1e300)), r"size must lie in 1e-09 \.\.\. 1e\+09 mm, got 3e\+299"),
        (lambda: Polyhedron(1.0, vertices=_sized(1e-200)), "size must lie in"),
        (lambda: Polyhedron(1.0, faces=[(*f[:3], 1e200 * f[3]) for f in bodies.WEDGE]), "size must lie in"),
        (lambda: Polyhedron(1.0), "give either vertices or faces"),
        (lambda: Polyhedron(1.0, vertices=bodies.CORNERS, faces=bodies.WEDGE), "give either vertices or faces"),
        (lambda: Polyhedron(math.nan, vertices=bodies.CORNERS), "polyhedron: attenuation nan"),
    ],
)
def test_impossible_solids_are_refused(make: Callable[[], Solid], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()
