"""Beam profile: a Gaussian with stripes that drift, and gone from a projection over its flat."""

from __future__ import annotations

import numpy as np
import pytest

from simulators import sensor
from simulators.effects.beam_profile import BeamProfile
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


def test_a_wrong_parameter_is_refused() -> None:
    with pytest.raises(ValueError, match="sigma and stripe_period must be positive"):
        BeamProfile(sigma=(1.0, 0.0))
