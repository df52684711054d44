"""Jump: the sample slips once and stays there."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from simulators.effects.anomaly import Label
from simulators.effects.stage.jump import Jump
from simulators.frame.detector import Detector
from simulators.frame.shot import Shot
from tests.simulators import shots
from tests.simulators.poses import posed, seen

JUMP = {"kind": "jump", "view": 3, "shift_um": [30.0, -20.0, 40.0], "turn_deg": 5.0}


def _pair(shot: Shot) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    return shots.frame(shots.scene(JUMP), shot), shots.frame(shots.scene(), shot)


def test_a_point_is_turned_then_shifted_on_the_stage() -> None:
    point = np.array([0.2, -0.1, 0.3])
    turn, angle = math.radians(5.0), 0.7
    # Angles grow: where the stage is at θ + δ a point is seen as it is seen at θ when it is turned by -δ about z.
    c, s = math.cos(turn), math.sin(turn)
    x, y, z = point[0] * c + point[1] * s + 0.03, point[1] * c - point[0] * s - 0.02, point[2] + 0.04
    expected = [x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle), z]
    jump = Jump(3, (30.0, -20.0, 40.0), 5.0)
    np.testing.assert_allclose(seen(posed(jump, angle, view=3), point), [expected] * 3, atol=1e-14)
    np.testing.assert_allclose(seen(posed(jump, angle, view=2), point)[0, 2], 0.3)


def test_views_before_it_are_untouched_and_all_after_it_are_labelled() -> None:
    chain = shots.scene(JUMP).chain
    for view in range(6):
        shot = shots.shot(view=view)
        jumped, plain = _pair(shot)
        assert (jumped != plain).any() == (view >= 3) == bool(chain.labels(shot))
    for state in ({"sample": False}, {"beam": False}):
        assert not chain.labels(shots.shot(view=4, **state))


@pytest.mark.parametrize("axis_col", [39.5, 60.0, -20.0, 105.0])
def test_the_region_holds_all_that_changes_and_is_no_wider_than_the_sample_and_its_way(axis_col: float) -> None:
    shot = shots.shot(view=3, detector=Detector((60, 80), 0.01, axis_col, 29.5))
    jumped, plain = _pair(shot)
    changed = np.flatnonzero((jumped != plain).any(axis=0))
    (label,) = shots.scene(JUMP).chain.labels(shot)
    top, below, left, right = label.region
    assert (label.kind, top, below) == ("jump", 0, 60)
    assert left <= changed.min() <= changed.max() < right
    # The sample fills its radius of 30 px; the shift of 3.6 px may go to either side.
    assert changed.min() - left <= 8
    assert right - 1 - changed.max() <= 8


def test_a_slip_along_the_beam_shows_in_a_cone_only() -> None:
    jump = Jump(0, (0.0, 50.0, 0.0))
    assert not jump.labels(shots.shot(angle=0.0))
    assert jump.labels(shots.shot(angle=0.1))
    cone = Detector.centred((60, 80), 0.01, sod=2.0)
    # A point at 0.35 mm from the axis is seen up to 0.35 / (1 - 0.35 / 2) = 0.4242 mm from it.
    assert Jump(0, (0.0, 50.0, 0.0)).labels(shots.shot(angle=0.0, detector=cone)) == [Label("jump", (0, 60, 0, 80))]
    narrow = Detector.centred((60, 120), 0.01, sod=2.0)
    assert jump.labels(shots.shot(angle=0.0, detector=narrow)) == [Label("jump", (0, 60, 18, 102))]
