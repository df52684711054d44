"""Read noise: the figure of each readout, and of each binning."""

from __future__ import annotations

import math

import pytest

from simulators import sensor
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]


def test_read_noise_and_offset_make_the_dark() -> None:
    dark = shots.frame(shots.scene("read_noise", "offset"), beam=False).astype(float)
    assert dark.mean() == pytest.approx(200, abs=0.3)
    assert dark.std() == pytest.approx(math.hypot(0.43 / CONVERSION, 12**-0.5), rel=0.05)
    quiet = shots.frame(shots.scene("read_noise", "offset"), shots.shot(readout="ultra_quiet"), beam=False).astype(
        float
    )
    assert quiet.std() == pytest.approx(math.hypot(0.27 / CONVERSION, 12**-0.5), rel=0.05)
    binned = shots.frame(shots.scene("read_noise", "offset"), shots.shot(binning=4), beam=False).astype(float)
    assert binned.std() == pytest.approx(4 * 0.43 / CONVERSION, rel=0.05)  # √16 pixels
