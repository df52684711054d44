"""Runout: an axis that wanders, with the sample or not."""

from __future__ import annotations

import math

import numpy as np

from simulators.effects.stage.runout import Runout
from simulators.frame.pose import Pose
from tests.simulators import shots
from tests.simulators.poses import posed, seen

POINT = np.array([0.2, -0.1, 0.3])
ANGLES = np.linspace(-2.0, 5.0, 9)


def test_one_wave_a_turn_is_a_sample_that_stands_beside_the_axis() -> None:
    """At phase φ it stands at (cos φ, -sin φ) beside it: exactly, at every angle."""
    wandering = seen(posed(Runout(radial=((1, 12.0, 25.0),)), ANGLES, rows=9), POINT)
    beside = POINT + 0.012 * np.array([math.cos(math.radians(25.0)), -math.sin(math.radians(25.0)), 0.0])
    np.testing.assert_allclose(wandering, seen(Pose.turned(ANGLES, 9), beside), atol=1e-14)


def test_zero_waves_shift_the_axis_and_others_are_cosines() -> None:
    there, here = (
        seen(posed(Runout(((0, 3.0, 0.0), (3, 2.0, 10.0)), ((2, 5.0, -40.0),)), ANGLES, rows=9), POINT),
        seen(Pose.turned(ANGLES, 9), POINT),
    )
    at = 3 * ANGLES + math.radians(10.0)
    across, along = 3.0 + 2.0 * np.cos(at), -2.0 * np.sin(at)
    up = 5.0 * np.cos(2 * ANGLES - math.radians(40.0))
    np.testing.assert_allclose(1e3 * (there - here), np.stack([across, along, up], axis=1), atol=1e-10)


def test_the_rest_is_drawn_for_each_frame() -> None:
    effect = Runout(radial_random_um=2.0, axial_random_um=0.5)
    shift = 1e3 * np.array([posed(effect, 0.3, frame=k).shift for k in range(500)])
    assert (shift == shift[:, :1]).all()
    # Variance of 500 Gaussian draws; 5 standard errors fail once in 1.7 million.
    np.testing.assert_allclose(shift[:, 0].var(axis=0), [4.0, 4.0, 0.25], rtol=5 * math.sqrt(2 / 500))
    assert abs(np.corrcoef(shift[:, 0].T)[0, 1]) < 5 / math.sqrt(500)


def test_a_frame_is_seen_shifted_by_whole_pixels() -> None:
    plain = shots.frame(shots.scene())
    moved = shots.frame(shots.scene({"kind": "runout", "radial": [[0, 20.0, 0.0]], "axial": [[0, 30.0, 0.0]]}))
    np.testing.assert_array_equal(moved[3:, 2:], plain[:-3, :-2])  # 20 and 30 um, pixels of 10 um
    assert (moved != plain).any()
