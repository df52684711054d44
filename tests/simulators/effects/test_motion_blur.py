"""Motion blur: the mean transmission over the exposure."""

from __future__ import annotations

import numpy as np
import pytest

from simulators import sensor
from simulators.effects.motion_blur import MotionBlur
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]


def test_motion_blur_is_the_mean_transmission_over_the_exposure() -> None:
    def stage(time: float) -> float:
        return 0.4 + 20.0 * (time - 1000.0)  # 0.2 rad during the exposure

    scene = shots.scene({"kind": "motion_blur", "samples": 5})
    angles = stage(1000.0 + 0.01 * (np.arange(5) + 0.5) / 5)
    mean = np.mean([np.exp(-shots.depth(scene, a)) for a in angles], axis=0)
    blurred = shots.frame(scene, angle_at=stage)
    np.testing.assert_allclose(blurred * CONVERSION / 4000, mean, atol=2e-5)
    # A finer midpoint rule agrees to second order: the samples are spread evenly over the exposure.
    fine = np.mean(
        [np.exp(-shots.depth(scene, stage(1000.0 + 0.01 * t))) for t in (np.arange(200) + 0.5) / 200], axis=0
    )
    assert np.abs(mean - fine).max() < 0.1 * np.abs(np.exp(-shots.depth(scene, 0.4)) - fine).max()


def test_a_wrong_parameter_is_refused() -> None:
    with pytest.raises(ValueError, match="samples must be >= 2"):
        MotionBlur(samples=1)
