"""Projections' laws: mass and centre of mass over angle, and sums along axes of the voxel truth."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from recon.base.volume import Grid
from simulators.frame.shot import Detector
from simulators.samples.bodies.packing import pack
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Box, Polyhedron, Solid
from simulators.samples.composed import battery
from tests.simulators.bodies import SOLIDS, volume

ANGLES = st.floats(-7.0, 7.0)
FINE = Detector((1440, 1920), 6.25e-4, axis_col=959.3, axis_row=639.6)
LINE = Detector((1, 1_200_000), 1e-6, axis_col=600_000.3, axis_row=-0.05e6)  # through the middle of upright solids
HEIGHTS = {"cylinder": 0.5, "upright box": 0.4, "upright plate": 0.15}


def _centroid(solid: Solid) -> NDArray[np.float64]:
    """Centre of mass; a polyhedron's by sampling nothing: its tetrahedra from one corner, each face fanned."""
    if not isinstance(solid, Polyhedron):
        return np.array(solid.centre)
    corners = solid.hull().vertices
    hull = ConvexHull(corners)
    simplices = np.concatenate([corners[hull.simplices], np.broadcast_to(corners[:1], (len(hull.simplices), 1, 3))], 1)
    volumes = np.abs(np.linalg.det(simplices[:, :3] - simplices[:, 3:])) / 6
    assert volumes.sum() == pytest.approx(volume(solid), rel=1e-9)
    w, x, y, z = solid.quaternion
    middle = volumes @ simplices.mean(axis=1) / volumes.sum()
    return np.array(solid.centre) + Rotation.from_quat([x, y, z, w]).apply(middle)


@pytest.mark.parametrize("name", SOLIDS)
@settings(max_examples=3, deadline=None)
@given(angle=ANGLES)
def test_orders_0_and_1_of_helgason_and_ludwig(name: str, angle: float) -> None:
    """Mass is the same at every angle; the first moments are a cos θ + b sin θ and z of the centre of mass (Helgason
    1965, Ludwig 1966), to 1e-5 of the mass: what is left is the pixels' sampling."""
    solid = SOLIDS[name]
    # A frame is out by what its pixels miss at a face that rays run along; it is no mistake of the chords.
    normals = pack([solid]).faces[:, :2] @ (-math.sin(angle), math.cos(angle))
    assume(name in HEIGHTS or np.abs(normals).min(initial=1.0) > 0.02)
    detector = LINE if name in HEIGHTS else FINE
    view = Phantom.of([solid]).line_integrals(angle, detector) * detector.pitch * HEIGHTS.get(name, detector.pitch)
    mass = solid.attenuation * volume(solid)
    x, y, z = _centroid(solid)
    assert view.sum() == pytest.approx(mass, rel=1e-5)
    along_u = (view.sum(axis=0) @ detector.u()) / mass
    assert along_u == pytest.approx(x * math.cos(angle) + y * math.sin(angle), abs=1e-5)
    assert (view.sum(axis=1) @ detector.v()) / mass == pytest.approx(z, abs=1e-5)


def test_line_sums_of_the_truth_are_the_projection() -> None:
    """The voxel truth and the analytic projection meet in a third thing: plain sums over an axis of the truth."""
    phantom = Phantom.of(battery(np.random.default_rng(1), (0.9, 0.9), n_particles=30))
    n, fine = 48, 4
    grid = Grid((n, n, n), 0.9 / n)
    truth = phantom.attenuation(grid, supersample=4).astype(np.float64)
    detector = Detector.centred((n * fine, n * fine), grid.voxel_size / fine)
    sums = {
        0.0: truth.sum(axis=1),
        math.pi / 2: truth.sum(axis=2),
        math.pi: truth.sum(axis=1)[:, ::-1],
        -math.pi / 2: truth.sum(axis=2)[:, ::-1],
    }
    for angle, expected in sums.items():
        view = phantom.line_integrals(angle, detector).reshape(n, fine, n, fine).mean(axis=(1, 3))
        error = view - expected * grid.voxel_size
        assert np.abs(error).max() < 0.05 * view.max(), angle
        assert np.sqrt(np.mean(error**2)) < 0.004 * view.max(), angle


def test_boxes_meet_without_a_seam() -> None:
    """Eight boxes that fill a box are the box: in the truth, and along every ray that runs along no face."""
    whole = Box((0.4, 0.4, 0.4), 1.5)
    eighths = [
        Box((0.2, 0.2, 0.2), 1.5, (x, y, z)) for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)
    ]  # fmt: skip
    detector = Detector((31, 37), 0.017, 17.6, 14.7, sod=3.0)
    one, many = Phantom.of([whole]), Phantom.of(eighths)
    np.testing.assert_allclose(many.line_integrals(0.4, detector), one.line_integrals(0.4, detector), atol=1e-12)
    grid = Grid((20, 20, 20), 0.0237)
    np.testing.assert_allclose(many.attenuation(grid), one.attenuation(grid), atol=1e-6)
