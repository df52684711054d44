"""Rolling shutter: each pair of rows at its own time, with or without blur."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import orca_quest
from drivers.base.protocols import CameraSettings, TriggerSource
from simulators.effects.detector.rolling_shutter import RollingShutter
from simulators.frame import sensor
from simulators.frame.shot import Moments
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]
LINE = 7.2e-6


def _fast(time: float) -> float:
    return 0.4 + 2000.0 * (time - 1000.0)


def test_rolling_shutter_shows_each_row_at_its_own_time() -> None:
    scene = shots.scene("rolling_shutter")
    skewed = shots.frame(scene, angle_at=_fast)
    for row in (21, 30, 37):  # rows that the ellipsoid casts its shadow on
        depth = shots.depth(scene, _fast(1000.0 + 0.01 / 2 + row // 2 * LINE))[row]  # of the middle of its exposure
        assert np.abs(depth - shots.depth(scene, 0.4)[row]).max() > 0.01
        np.testing.assert_allclose(skewed[row] * CONVERSION / 4000, np.exp(-depth), atol=2e-5)


@pytest.mark.parametrize("binning", [1, 2, 4])
@pytest.mark.parametrize("readout", ["standard", "ultra_quiet"])
def test_two_rows_are_read_in_a_line_time_from_the_first_row_down(binning: int, readout: str) -> None:
    timing = orca_quest.timing(CameraSettings(0.01, TriggerSource.EXTERNAL, binning=binning, readout=readout))
    rows = timing.shape[0]
    shot = shots.shot(row_period=timing.row_period, binning=binning)
    times = RollingShutter().moments(Moments.once(rows), shot).times[0]
    for row in range(0, rows, 7):
        pair = row * binning // 2  # the first of the sensor's pairs that the row is made of
        assert times[row] == pytest.approx(pair * orca_quest.LINE_TIME[readout], abs=1e-12)
    last = times[-1] + orca_quest.LINE_TIME[readout] * max(binning // 2, 1)
    assert last == pytest.approx(timing.readout)  # 1152 line times: 8.2944 ms in the standard readout


def test_blur_and_shutter_are_the_same_in_either_order() -> None:
    blur = {"kind": "motion_blur", "max_samples": 3}
    one, other = (
        shots.frame(shots.scene(*effects), angle_at=_fast)
        for effects in ((blur, "rolling_shutter"), ("rolling_shutter", blur))
    )
    np.testing.assert_array_equal(one, other)
    times = [1000.0 + (k + 0.5) / 3 * 0.01 + 15 * LINE for k in range(3)]
    mean = np.mean([np.exp(-shots.depth(shots.scene(), _fast(time))[30]) for time in times], axis=0)
    np.testing.assert_allclose(one[30] * CONVERSION / 4000, mean, atol=2e-5)


def test_a_standing_sample_has_neither_blur_nor_skew() -> None:
    moving = shots.scene("motion_blur", "rolling_shutter")
    np.testing.assert_array_equal(shots.frame(moving, angle_at=lambda time: 0.4), shots.frame(shots.scene()))
