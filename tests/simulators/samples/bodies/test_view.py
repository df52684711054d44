"""View: a pose is how the sample stands, nothing is missed or touched in vain, and no body is behind the source."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simulators.frame.detector import Detector
from simulators.frame.pose import Pose
from simulators.samples.bodies.packing import pack, view_of
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Box, Cylinder, Ellipsoid, Polyhedron, Solid, octahedron
from tests.simulators.bodies import SOLIDS, TURNABLE, chords, rays, turned


@pytest.mark.parametrize("name", TURNABLE[:2] + TURNABLE[3:])
@settings(max_examples=8, deadline=None)
@given(angle=st.floats(-7, 7), tilt=st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5)))
def test_a_tilt_is_a_turn_of_the_sample(name: str, angle: float, tilt: tuple[float, float]) -> None:
    """The body turned by the whole pose and seen straight on, in the same beam."""
    for sod in (math.inf, 2.0):
        detector = Detector((20, 26), 0.04, 12.3, 9.1, sod)
        pose = Pose.turned(angle, 20).tilted_by(tilt)
        axes, _ = pose.frames()
        straight = Phantom.of([turned(SOLIDS[name], axes[0].T)]).line_integrals(0.0, detector)
        np.testing.assert_allclose(Phantom.of([SOLIDS[name]]).line_integrals(pose, detector), straight, atol=1e-9)


def test_a_cylinder_on_its_side_is_seen_as_its_definition_says() -> None:
    """Tilted by a right angle about u, its axis lies along the beam; about b, along u."""
    detector = Detector.centred((41, 41), 0.02)
    cylinder = Phantom.of([Cylinder(0.2, 0.5, 1.0)])
    u, v = detector.u()[None, :], detector.v()[:, None]
    end_on = cylinder.line_integrals(Pose.turned(0.3, 41).tilted_by((math.pi / 2, 0)), detector)
    off_rim = np.abs(np.hypot(u, v) - 0.2) > 1e-9
    np.testing.assert_allclose(end_on[off_rim], (0.5 * (np.hypot(u, v) < 0.2))[off_rim], atol=1e-12)
    side_on = cylinder.line_integrals(Pose.turned(0.3, 41).tilted_by((0, math.pi / 2)), detector)
    wall = 2 * np.sqrt(np.clip(0.04 - v**2, 0, None)) * (np.abs(u) < 0.25)
    np.testing.assert_allclose(side_on**2, wall**2, atol=1e-14)  # a root at the rim


@pytest.mark.parametrize("name", SOLIDS)
def test_a_shift_is_a_moved_detector(name: str) -> None:
    phantom = Phantom.of([SOLIDS[name]])
    pose = Pose.turned(0.8, 30).shifted_by((3 * 0.03, 0.0, -2 * 0.03))
    moved = Detector((30, 40), 0.03, 18.2 + 3, 14.6 - 2)
    got = phantom.line_integrals(pose, Detector((30, 40), 0.03, 18.2, 14.6))
    np.testing.assert_allclose(got, phantom.line_integrals(0.8, moved), atol=1e-8)
    along_beam = phantom.line_integrals(Pose.turned(0.8, 30).shifted_by((0.0, 0.4, 0.0)), moved)
    np.testing.assert_allclose(along_beam, phantom.line_integrals(0.8, moved), atol=1e-8)


def test_a_shift_along_the_beam_changes_the_magnification() -> None:
    """A ball at the distance d from the source covers tan(asin(r / d)) x sod."""
    ball, detector = Phantom.of([Ellipsoid((0.2, 0.2, 0.2), 1.0)]), Detector((1, 2001), 0.001, 1000.0, 0.0, 2.0)
    for shift in (-0.5, 0.0, 0.8):
        seen = ball.line_integrals(Pose.turned(0.0, 1).shifted_by((0, shift, 0)), detector)[0] > 0
        assert np.abs(detector.u()[seen]).max() == pytest.approx(2 * math.tan(math.asin(0.2 / (2 + shift))), abs=1e-3)


def test_rows_that_a_body_does_not_touch_cost_nothing() -> None:
    """Entries (body, row) are those rows that each box covers, and one more at most."""
    rng = np.random.default_rng(1)
    solids = [Ellipsoid((0.02, 0.02, 0.02), 1.0, (0, 0, z)) for z in rng.uniform(-0.4, 0.4, 200).tolist()]
    for sod, factor in ((math.inf, 1.0), (5.0, 1.1)):
        detector = Detector.centred((500, 4), 0.002, sod)
        view = view_of(pack(solids), ["ball"] * 200, Pose.turned(0.3, 500), detector)
        assert 200 * 19 <= view.bodies.size <= 200 * 21 * factor


def test_many_solids_in_the_same_shadow_cost_as_much_as_few() -> None:
    """10 to 10 000 balls with 10 % of a frame of 512² in their shadows: pixels that are touched stay the same, and
    entries of a body in a row grow with their number's root only."""
    rng = np.random.default_rng(2)
    detector = Detector.centred((512, 512), 1 / 512)
    for n in (10, 100, 1000, 10_000):
        radius = math.sqrt(0.1 / (n * math.pi))
        centres = rng.uniform(radius - 0.5, 0.5 - radius, (n, 3)).tolist()
        solids = [Ellipsoid((radius, radius, radius), 1.0, tuple(centre)) for centre in centres]
        view = view_of(pack(solids), ["ball"] * n, Pose.turned(0.0, 512), detector)
        assert view.bodies.size == pytest.approx(2 * radius * 512 * n, rel=0.1)
        assert view.bodies.size * math.pi / 4 * 2 * radius * 512 == pytest.approx(0.1 * 512**2, rel=0.1)


@pytest.mark.parametrize(
    ("solid", "words"),
    [
        (Box((0.2, 0.2, 0.2), 1.0, (0.0, -1.2, 0.0)), r"solid 0 \(box\) reaches 0.3 mm behind the source"),
        (Box((0.2, 0.2, 0.2), 1.0, (0.0, -3.0, 0.0)), "reaches 2.1 mm behind the source, which is 1 mm before"),
        (Ellipsoid((0.1, 0.5, 0.1), 1.0, (0.3, -0.5, 0.0)), "solid 0 .ellipsoid. reaches"),
        (Cylinder(1.0, 0.2, 1.0), "raise sod. No frame was computed"),
        (Cylinder(1.2, 0.2, 1.0), r"solid 0 \(cylinder\) reaches 0.2 mm behind"),
        (Polyhedron(octahedron((0.1, 0.4, 0.1)), 1.0, (0.0, -0.7, 0.0)), r"solid 0 \(polyhedron\) reaches 0.1 mm"),
    ],
)
def test_bodies_at_or_behind_the_source_are_refused(solid: Solid, words: str) -> None:
    detector = Detector.centred((8, 8), 0.1, sod=1.0)
    with pytest.raises(ValueError, match=words):
        Phantom.of([solid]).line_integrals(0.0, detector)


@pytest.mark.parametrize(
    "solid",
    [
        Polyhedron(octahedron((0.3, 0.3, 0.3)), 1.0, (0.55, -0.55, 0.0)),  # its box is behind the source
        Ellipsoid((0.5, 0.1, 0.1), 1.0, (0.5, -0.5, 0.0), (0.924, 0.0, 0.0, -0.383)),
        Box((0.2, 0.2, 0.2), 1.0, (0.0, -0.85, 0.0)),
        Cylinder(0.7, 1.4, 1.0, (0.0, -0.2, 0.0)),
    ],
)
def test_bodies_close_before_the_source_are_seen(solid: Solid) -> None:
    for pose in (Pose.turned(0.0, 8), Pose.turned(np.linspace(-0.05, 0.05, 8), 8).tilted_by((0.03, 0.02))):
        detector = Detector.centred((8, 20), 0.1, sod=1.0)
        got = Phantom.of([solid]).line_integrals(pose, detector)
        np.testing.assert_allclose(got, chords(solid, *rays(pose, detector), far=3.0), atol=1e-9)


def test_a_pose_of_other_rows_is_refused() -> None:
    with pytest.raises(ValueError, match="has 7 angles"):
        Phantom.of([]).line_integrals(Pose.turned(0.0, 7), Detector.centred((8, 8), 0.1))
