"""Phantoms of solids, and the solids."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from recon.base.volume import Grid
from simulators.frame.mapping import SceneError, choose
from simulators.frame.shot import Detector
from simulators.samples.bodies.packing import pack
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import SOLIDS as KINDS
from simulators.samples.bodies.solids import (
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
from tests.messages import refused
from tests.refused_calls import refused_calls
from tests.simulators import bodies
from tests.simulators.bodies import SOLIDS, inside
from tests.slow_cases import others_slow


def _widest_shadow(phantom: Phantom, detector: Detector) -> float:
    """Over a turn, the largest |u| of a pixel that a body shadows: some view looks across the farthest point."""
    u = np.abs(detector.u())
    views = (phantom.line_integrals(angle, detector) for angle in np.linspace(0, 2 * np.pi, 120, endpoint=False))
    return max(float(u[(view > 0).any(axis=0)].max()) for view in views)


@pytest.mark.parametrize("name", others_slow(SOLIDS, 4))
def test_the_radius_is_the_widest_shadow(name: str) -> None:
    pitch = 2e-3
    phantom = Phantom.of([SOLIDS[name]])
    # A corner may lie between two rows or two angles.
    widest = _widest_shadow(phantom, Detector.centred((300, 601), pitch))
    loose = 0.1 if isinstance(SOLIDS[name], Ellipsoid) else 0.01
    assert widest - pitch <= phantom.radius <= (1 + loose) * widest


def test_the_radius_is_of_the_farthest_solid_and_0_without_solids() -> None:
    can = Cylinder(0.5, 1.0, 1.0)
    assert Phantom.of([can]).radius == 0.5  # not the corner of the box around it
    assert Phantom.of([can, Ellipsoid((0.1, 0.1, 0.1), 1.0, (3.0, 4.0, 0.0))]).radius == pytest.approx(5.1)
    assert Phantom.of([]).radius == 0.0


def _centres(grid: Grid) -> NDArray[np.float64]:
    """(x, y, z) of voxels' centres, [z, y, x, 3]."""
    return np.stack(np.meshgrid(*grid.coordinates(), indexing="ij")[::-1], axis=-1)


@pytest.mark.parametrize("name", SOLIDS)
def test_truth_has_the_solid_s_mass(name: str) -> None:
    solid = SOLIDS[name]
    grid = Grid((50, 56, 60), 0.018, centre=(0.02, -0.03, 0.04))
    truth = Phantom.of([solid]).attenuation(grid, supersample=4)
    assert truth.dtype == np.float32
    mass = truth.sum(dtype=np.float64) * grid.voxel_size**3
    # Faces along the voxels all fall between the same two sub-points: each edge is out by up to one sub-step.
    tolerance = {"upright box": sum(0.018 / 4 / edge for edge in (0.5, 0.3, 0.4)), "upright plate": 0.018 / 4 / 0.15}
    assert mass == pytest.approx(solid.attenuation * bodies.volume(solid), rel=tolerance.get(name, 3e-3))
    sure = (truth == 0) | (truth == np.float32(solid.attenuation))
    np.testing.assert_array_equal(truth[sure] > 0, inside(solid, _centres(grid))[sure])


def test_truth_on_a_face_is_the_filled_share() -> None:
    grid = Grid((1, 1, 8), 1.0)  # x at -3.5 ... 3.5
    truth = Phantom.of([Box((5.0, 9.0, 9.0), 4.0)]).attenuation(grid, supersample=2)
    np.testing.assert_allclose(truth[0, 0], [0, 2, 4, 4, 4, 4, 2, 0])


def test_truth_and_labels_of_tall_voxels() -> None:
    """Slices twice as far apart as voxels are wide: the same as every other slice where nothing changes along z."""
    phantom = Phantom.of([Cylinder(0.3, 0.8, 1.0), Box((0.2, 0.2, 0.4), 1.0, (0.1, 0.0, 0.1))])
    tall = Grid((10, 40, 40), 0.02, slice_pitch=0.08)
    np.testing.assert_allclose(
        phantom.attenuation(tall, supersample=4).sum() * 0.02**2 * 0.08, np.pi * 0.09 * 0.8 + 0.016, rtol=3e-3
    )
    expected = np.where(inside(phantom.solids[1], _centres(tall)), 2, inside(phantom.solids[0], _centres(tall)) * 1)
    np.testing.assert_array_equal(phantom.labels(tall), expected)


@pytest.mark.parametrize("name", SOLIDS)
def test_a_label_names_the_solid_at_the_voxels_centre(name: str) -> None:
    grid = Grid((40, 44, 48), 0.021, centre=(0.02, -0.03, 0.04))
    labels = Phantom.of([SOLIDS[name]]).labels(grid)
    assert labels.dtype == np.uint8
    np.testing.assert_array_equal(labels == 1, inside(SOLIDS[name], _centres(grid)))
    assert 0 < labels.sum() == (labels > 0).sum()


def test_later_solids_lie_over_earlier_ones() -> None:
    can, bore, liquid = Cylinder(0.4, 0.6, 2.0), Cylinder(0.3, 0.6, -2.0), Cylinder(0.3, 0.6, 0.5)
    ball, hole = Ellipsoid((0.15, 0.15, 0.15), 1.0), Ellipsoid((0.05, 0.05, 0.05), -1.0)
    grid = Grid((1, 1, 9), 0.1)  # x at -0.4 ... 0.4
    full = Phantom.of([can, bore, liquid, ball, hole], names=["wall", "wall", "liquid", "grain", "pore"])
    assert full.names == ("wall", "liquid", "grain", "pore")
    np.testing.assert_array_equal(full.labels(grid)[0, 0, [0, 2, 3, 4, 5, 6, 8]], [1, 2, 3, 4, 3, 2, 1])


def test_solids_may_share_a_name() -> None:
    balls = [Ellipsoid((0.1, 0.1, 0.1), 1.0, (x, 0.0, 0.0)) for x in (-0.3, 0.0, 0.3)]
    phantom = Phantom.of(balls, names=["a", "b", "a"])
    assert phantom.names == ("a", "b")
    np.testing.assert_array_equal(phantom.labels(Grid((1, 1, 3), 0.3))[0, 0], [1, 2, 1])
    assert Phantom.of(list(SOLIDS.values())).names == tuple(dict.fromkeys(map(kind_of, SOLIDS.values())))
    assert set(Phantom.of(list(SOLIDS.values())).names) == set(KINDS)


def test_names_that_do_not_fit_are_refused() -> None:
    ball = Ellipsoid((0.1, 0.1, 0.1), 1.0)
    with refused(ValueError):
        Phantom.of([ball] * 3, names=["a", "b"])
    Phantom.of([ball] * 255, names=[f"grain {i}" for i in range(255)])
    with refused(ValueError):
        Phantom.of([ball] * 256, names=[f"grain {i}" for i in range(256)])


def test_solids_outside_the_grid() -> None:
    far: list[Solid] = [Ellipsoid((0.1, 0.1, 0.1), 1.0, (5.0, 0.0, 0.0)), Box((0.1, 0.1, 0.1), 1.0, (0.0, 0.0, -5.0))]
    assert not Phantom.of(far).attenuation(Grid((8, 8, 8), 0.02)).any()
    assert not Phantom.of(far).labels(Grid((8, 8, 8), 0.02)).any()
    wide = Phantom.of([Cylinder(3.0, 9.0, 1.0)])
    assert wide.attenuation(Grid((2, 2, 2), 0.02)).min() == 1.0
    assert wide.labels(Grid((2, 2, 2), 0.02)).min() == 1


CUBE = [(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]


def test_a_scene_can_give_a_polyhedron_by_its_corners_alone() -> None:
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    solid = choose("here", KINDS, {"kind": "polyhedron", "attenuation": 2, "vertices": corners})
    assert bodies.volume(solid) == pytest.approx(1 / 6)
    with refused(SceneError):
        choose("here", KINDS, {"kind": "polyhedron", "attenuation": 2, "faces": []})


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


test_calls_that_are_refused = refused_calls(__file__, globals())
