"""Stage wobble: an axis that leans, with the sample or not."""

from __future__ import annotations

import math

import numpy as np
import pytest

from simulators.effects.stage.stage_wobble import StageWobble
from tests.simulators import shots
from tests.simulators.poses import posed, seen

POINT = (0.2, -0.1, 0.3)


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.5, -1.9])
def test_one_wave_a_turn_is_a_sample_that_stands_askew(angle: float) -> None:
    """An askew sample, turned by ε about its own axis at angle -φ in the xy-plane, is rigid: p + ε axis x p (ε² is
    left out)."""
    tilt, phase = 1e-4, 30.0
    own_axis = np.array([math.cos(math.radians(phase)), -math.sin(math.radians(phase)), 0.0])
    askew = np.array(POINT) + tilt * np.cross(own_axis, POINT)
    wobbling = posed(StageWobble(((1, 1e6 * tilt, phase),)), angle)
    turned = [
        askew[0] * math.cos(angle) + askew[1] * math.sin(angle),
        askew[1] * math.cos(angle) - askew[0] * math.sin(angle),
        askew[2],
    ]
    np.testing.assert_allclose(seen(wobbling, POINT)[0], turned, atol=2 * tilt**2)


def test_no_wave_is_an_axis_that_leans_always_to_the_same_side() -> None:
    high = (0.0, 0.0, 0.4)  # on the axis: it stays where it is, whatever the angle
    about_u = seen(posed(StageWobble(((0, 1000.0, 0.0),)), np.array([0.0, 1.0, 2.0])), high)
    np.testing.assert_allclose(about_u, [[0.0, -0.4e-3, 0.4]] * 3, atol=1e-6)
    about_b = seen(posed(StageWobble(((0, 1000.0, -90.0),)), np.array([0.0, 1.0, 2.0])), high)
    np.testing.assert_allclose(about_b, [[0.4e-3, 0.0, 0.4]] * 3, atol=1e-6)


def test_a_ball_high_on_a_leaning_axis_is_seen_beside_it() -> None:
    """0.2 mm up, on an axis that leans by 0.05 rad to the side."""
    ball = {"kind": "ellipsoid", "semi_axes": [0.06, 0.06, 0.06], "attenuation": 5.0, "centre": [0.0, 0.0, 0.2]}
    wobble = {"kind": "stage_wobble", "harmonics": [[0, 50_000.0, -90.0]]}
    scene = shots.scene(wobble, phantom={"kind": "solids", "solids": [ball]})
    lost = -np.log(shots.frame(scene) / shots.frame(scene).max())
    detector = shots.shot().detector
    u, v = (lost.sum(axis=0) @ detector.u()) / lost.sum(), (lost.sum(axis=1) @ detector.v()) / lost.sum()
    assert (u, v) == pytest.approx((0.2 * math.sin(0.05), 0.2 * math.cos(0.05)), abs=1e-4)


def test_two_waves_lean_at_the_turned_angle() -> None:
    angle = 0.6
    tilt = posed(StageWobble(((2, 20.0, 40.0),)), angle).tilt
    assert tilt is not None
    at = 2 * angle + math.radians(40.0)
    np.testing.assert_allclose(tilt, [[20e-6 * math.cos(at), -20e-6 * math.sin(at)]] * 3, rtol=1e-12)


def test_the_rest_is_drawn_for_each_frame_and_the_same_at_every_moment_of_it() -> None:
    effect = StageWobble(random_urad=7.0)
    tilts = np.array([posed(effect, 0.3, frame=k).tilt for k in range(400)])
    assert (tilts == tilts[:, :1]).all()
    np.testing.assert_array_equal(posed(effect, 0.9, frame=5).tilt, tilts[5])
    assert abs(np.corrcoef(tilts[:, 0].T)[0, 1]) < 5 / math.sqrt(400)
    # Mean and variance of 800 Gaussian draws; 5 standard errors fail once in 1.7 million.
    assert abs(tilts[:, 0].mean()) < 5 * 7e-6 / math.sqrt(800)
    assert tilts[:, 0].var() == pytest.approx(49e-12, rel=5 * math.sqrt(2 / 800))
