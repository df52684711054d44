"""Chords of bodies, and the view of a frame that they are computed for."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.base.geometry import Geometry
from simulators.frame.shot import Detector, Pose
from simulators.samples.bodies.chords import columns
from simulators.samples.bodies.packing import pack, view_of
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Box, Cylinder, Ellipsoid, Polyhedron, Solid, octahedron
from tests.simulators.bodies import SOLIDS, chords, rays

SODS = [math.inf, 1.2, 300.0]
small, near = st.floats(-0.4, 0.4), st.floats(-0.05, 0.05)


def _agrees(name: str, pose: Pose, detector: Detector) -> None:
    """To 1e-9 mm where the source is within a metre: rounding alone."""
    solid = SOLIDS[name]
    expected = chords(solid, *rays(pose, detector), far=1.0)
    got = Phantom.of([solid]).line_integrals(pose, detector)
    assert (expected > 0).sum() > 10
    np.testing.assert_allclose(got, solid.attenuation * expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("sod", SODS)
@pytest.mark.parametrize("name", SOLIDS)
@settings(max_examples=4, deadline=None)
@given(angle=st.floats(-7.0, 7.0), tilt=st.tuples(small, small) | st.none(), shift=st.tuples(near, near, near))
def test_chords_agree_with_a_numerical_search_in_any_pose(
    name: str, sod: float, angle: float, tilt: tuple[float, float] | None, shift: tuple[float, float, float]
) -> None:
    pose = Pose.turned(angle, 6).shifted_by(shift)
    _agrees(name, pose if tilt is None else pose.tilted_by(tilt), Detector((6, 24), 0.05, 11.3, 2.7, sod))


@pytest.mark.parametrize("sod", SODS)
@pytest.mark.parametrize("name", SOLIDS)
def test_each_row_may_have_a_pose_of_its_own(name: str, sod: float) -> None:
    """Both against the search and, to the bit, against frames in which all rows have the pose of one."""
    rng = np.random.default_rng(5)
    detector = Detector((9, 30), 0.04, axis_col=14.3, axis_row=3.7, sod=sod)
    poses = [Pose.turned(rng.uniform(0, 6, 9), 9)]
    poses.append(poses[0].shifted_by(rng.uniform(-0.05, 0.05, (9, 3))))
    poses.append(poses[1].tilted_by(rng.uniform(-0.3, 0.3, (9, 2))))
    phantom = Phantom.of([SOLIDS[name]])
    for pose in poses:
        _agrees(name, pose, detector)
        frame = phantom.line_integrals(pose, detector)
        for j in range(9):
            one = [
                None if a is None else np.repeat(a[j : j + 1], 9, axis=0) for a in (pose.angle, pose.shift, pose.tilt)
            ]
            alone = phantom.line_integrals(Pose(*one), detector)[j]  # type: ignore[arg-type]
            np.testing.assert_array_equal(alone, frame[j])


@pytest.mark.parametrize("name", SOLIDS)
@pytest.mark.parametrize("lean", [(math.pi / 2, 0.0), (0.0, math.pi / 2), (-math.pi / 2, 0.0), (0.0, 1e-13)])
@pytest.mark.parametrize("angle", [0.0, math.pi / 2])
def test_rays_along_an_axis_or_a_face(name: str, lean: tuple[float, float], angle: float) -> None:
    for sod in SODS:
        _agrees(name, Pose.turned(angle, 9).tilted_by(lean), Detector((9, 31), 0.037, 14.3, 3.7, sod))


@pytest.mark.parametrize("thin", [1e-3, 1e-6, 1e-9])
def test_a_needle_across_the_frame(thin: float) -> None:
    """A ray that meets it halfway to its tip has √(1 - 1/4) of the thickness in the middle; it lies along u = v."""
    needle = Ellipsoid((1.0, thin, thin), 1.0, quaternion=(math.cos(math.pi / 8), 0, -math.sin(math.pi / 8), 0))
    detector = Detector((1, 2), math.sqrt(0.125), -1.0, -1.0)
    seen = Phantom.of([needle]).line_integrals(0.0, detector)[0]
    # A ray is as far off as a length is rounded, and that is 1e-7 of the thinnest.
    np.testing.assert_allclose(seen, [thin * math.sqrt(3), 0.0], rtol=1e-12 + (2e-16 / thin) ** 2)


def test_a_body_with_a_nan_shadow_covers_no_column() -> None:
    """Before, first and last column were whole numbers far outside of the frame."""
    assert columns(np.arange(5.0), 1.0, 1.0, 2.0) == (1, 3)
    for low, high in ((math.nan, 2.0), (1.0, math.nan), (2.0, 1.0)):
        assert columns(np.arange(5.0), 1.0, low, high) == (0, 0)
    assert columns(np.arange(5.0), 1.0, -math.inf, math.inf) == (0, 5)


def test_convention_is_the_geometry_s() -> None:
    """Columns grow with u = x cos θ + y sin θ, rows with z; pixel centres as recon.base.geometry counts them."""
    geometry = Geometry.parallel([0.0], (40, 50), pixel_pitch=0.02, axis_col=21.5)
    detector = Detector(geometry.detector_shape, geometry.pixel_pitch, geometry.axis_col, axis_row=19.5)
    ball = Phantom.of([Ellipsoid((0.1, 0.1, 0.1), 1.0, (0.2, 0.1, 0.16))])
    rows, cols = np.mgrid[:40, :50]
    for angle in (0.0, 0.5, math.pi / 2, math.pi, 4.0):
        view = ball.line_integrals(angle, detector)
        u = 0.2 * math.cos(angle) + 0.1 * math.sin(angle)
        assert (view * cols).sum() / view.sum() == pytest.approx(21.5 + u / 0.02, abs=0.05)
        assert (view * rows).sum() / view.sum() == pytest.approx(19.5 + 0.16 / 0.02, abs=0.05)


def test_attenuations_add_up_and_may_be_negative() -> None:
    outer, hole = Cylinder(0.3, 0.4, 2.0), Cylinder(0.2, 0.4, -2.0)
    for sod in SODS:
        detector = Detector.centred((20, 40), 0.02, sod)
        both = Phantom.of([outer, hole]).line_integrals(0.3, detector)
        each = [Phantom.of([solid]).line_integrals(0.3, detector) for solid in (outer, hole)]
        np.testing.assert_allclose(both, each[0] + each[1], atol=1e-15)
        each = [Phantom.of([solid]).line_integrals(0.3, detector) for solid in SOLIDS.values()]
        all_at_once = Phantom.of(list(SOLIDS.values())).line_integrals(0.3, detector)
        np.testing.assert_allclose(all_at_once, np.sum(each, axis=0), atol=1e-13)


def test_solids_partly_or_wholly_outside_the_frame() -> None:
    far: list[Solid] = [Ellipsoid((0.1, 0.1, 0.1), 1.0, (5.0, 0.0, 0.0)), Box((0.1, 0.1, 0.1), 1.0, (0.0, 0.0, -5.0))]
    assert not Phantom.of(far).line_integrals(0.0, Detector.centred((8, 8), 0.02)).any()
    assert not Phantom.of(far).line_integrals(0.0, Detector.centred((8, 8), 0.02, sod=7.0)).any()
    wide = Phantom.of([Cylinder(3.0, 9.0, 1.0)])
    assert wide.line_integrals(1.0, Detector.centred((2, 3), 0.02))[0, 1] == pytest.approx(6.0)
    assert not Phantom.of([]).line_integrals(0.0, Detector.centred((2, 3), 0.02)).any()


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
        (Box((0.2, 0.2, 0.2), 1.0, (0.0, -1.2, 0.0)), r"solid 0 \(box\) extends 0.3 mm behind the source"),
        (Box((0.2, 0.2, 0.2), 1.0, (0.0, -3.0, 0.0)), "extends 2.1 mm behind the source, which is 1 mm in front of"),
        (Ellipsoid((0.1, 0.5, 0.1), 1.0, (0.3, -0.5, 0.0)), "solid 0 .ellipsoid. extends"),
        (Cylinder(1.0, 0.2, 1.0), "increase sod. No frame was computed"),
        (Cylinder(1.2, 0.2, 1.0), r"solid 0 \(cylinder\) extends 0.2 mm behind"),
        (Polyhedron(octahedron((0.1, 0.4, 0.1)), 1.0, (0.0, -0.7, 0.0)), r"solid 0 \(polyhedron\) extends 0.1 mm"),
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
