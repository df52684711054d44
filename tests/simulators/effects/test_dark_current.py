"""Dark current: it grows with the exposure and the pixels summed."""

from __future__ import annotations

import pytest

from simulators import sensor
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]


def test_dark_current_grows_with_the_exposure() -> None:
    dark = shots.frame(shots.scene("dark_current"), shots.shot(exposure=100.0), beam=False) * CONVERSION
    assert dark.mean() == pytest.approx(0.36, abs=0.04)
    binned = shots.frame(shots.scene("dark_current"), shots.shot(exposure=100.0, binning=2), beam=False) * CONVERSION
    assert binned.mean() == pytest.approx(4 * 0.36, abs=0.1)
