"""Rolling shutter: each row at its own time."""

from __future__ import annotations

import numpy as np

from simulators import sensor
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]


def test_rolling_shutter_shows_each_row_at_its_own_time() -> None:
    def stage(time: float) -> float:
        return 0.4 + 2000.0 * (time - 1000.0)

    scene = shots.scene("rolling_shutter")
    skewed = shots.frame(scene, angle_at=stage)
    for row in (21, 30, 38):  # rows that the ellipsoid casts its shadow on
        depth = shots.depth(scene, stage(1000.0 + row * 3.6e-6))[row]
        assert np.abs(depth - shots.depth(scene, 0.4)[row]).max() > 0.01
        np.testing.assert_allclose(skewed[row] * CONVERSION / 4000, np.exp(-depth), atol=2e-5)
    both = shots.frame(shots.scene("motion_blur", "rolling_shutter"), angle_at=stage)
    assert (both != skewed).any()


def test_a_standing_sample_has_neither_blur_nor_skew() -> None:
    moving = shots.scene({"kind": "motion_blur", "samples": 3}, "rolling_shutter")
    np.testing.assert_array_equal(shots.frame(moving, angle_at=lambda time: 0.4), shots.frame(shots.scene()))
