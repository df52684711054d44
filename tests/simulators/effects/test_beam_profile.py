"""Beam profile: a Gaussian with stripes that drift, a beam that wanders, and gone from a projection over its flat."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from simulators.effects.beam_profile import BeamProfile
from simulators.frame import sensor
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]


def test_beam_profile_is_a_gaussian_with_stripes_that_drift() -> None:
    profile = {"kind": "beam_profile", "sigma": [0.4, 0.3], "stripes": 0.1, "stripe_period": 0.2, "drift": 1e-3}
    shot = shots.shot()
    u, v = shot.detector.u()[None, :], shot.detector.v()[:, None]
    gauss = np.exp(-(u**2) / (2 * 0.4**2) - v**2 / (2 * 0.3**2))
    for elapsed in (0.0, 50.0):
        flat = shots.frame(shots.scene(profile), shots.shot(elapsed=elapsed), sample=False) * CONVERSION / 4000
        stripes = 1 + 0.1 * np.sin(2 * np.pi * (v - 1e-3 * elapsed) / 0.2)
        np.testing.assert_allclose(flat, gauss * stripes, atol=2e-5)
    # The sample's transmission is untouched: projection / flat is Beer-Lambert.
    scene = shots.scene(profile)
    ratio = shots.frame(scene) / shots.frame(scene, sample=False)
    np.testing.assert_allclose(ratio, np.exp(-shots.depth(scene, 0.4)), rtol=2e-3)


def test_a_beam_that_wanders_takes_its_stripes_along_by_whole_pixels() -> None:
    """Three columns and two rows of 10 um further, at a quarter of the swing's period."""
    shot, later = shots.shot(elapsed=0.0), shots.shot(elapsed=5.0)
    still = BeamProfile((0.4, 0.3), stripes=0.1, stripe_period=0.07)
    moves = BeamProfile((0.4, 0.3), 0.1, 0.07, wander_speed=(2e-3, -2e-3), wander=(0.02, -0.01), wander_period=20.0)
    before = still.apply(np.ones((60, 80)), shot)
    np.testing.assert_array_equal(moves.apply(np.ones((60, 80)), shot), before)
    after = moves.apply(np.ones((60, 80)), later)
    np.testing.assert_allclose(after[:-2, 3:], before[2:, :-3], rtol=1e-12)
    aside = BeamProfile((0.4, 0.3), 0.1, 0.07, centre=(0.03, -0.02))
    np.testing.assert_allclose(aside.apply(np.ones((60, 80)), shot), after, rtol=1e-12)


def test_the_sample_stays_where_it_is_while_the_beam_wanders() -> None:
    scene = shots.scene({"kind": "beam_profile", "sigma": [0.4, 0.3], "wander_speed": [1e-3, 0.0]})
    for elapsed in (0.0, 100.0):
        shot = shots.shot(elapsed=elapsed)
        ratio = shots.frame(scene, shot) / shots.frame(scene, shot, sample=False)
        np.testing.assert_allclose(ratio, np.exp(-shots.depth(scene, 0.4)), rtol=2e-3)


@given(elapsed=st.floats(0, 1e4), turns=st.integers(1, 50))
def test_a_swing_comes_back_after_its_period(elapsed: float, turns: int) -> None:
    profile = BeamProfile((1.0, 1.0), wander=(0.1, 0.2), wander_period=7.0)
    np.testing.assert_allclose(profile.middle(elapsed + 7.0 * turns), profile.middle(elapsed), atol=1e-10)
