"""Hot pixels: they stay where they are on the sensor."""

from __future__ import annotations

import numpy as np
import pytest

from simulators.detector import Detector
from simulators.effects.hot_pixels import HotPixels
from tests.simulators import shots


def test_hot_pixels_stay_on_the_sensor_whatever_the_roi() -> None:
    scene = shots.scene({"kind": "hot_pixels", "fraction": 0.01, "rate": 1e5, "seed": 4})
    frame = shots.frame(scene, beam=False)
    assert 0.006 < (frame > 0).mean() < 0.012
    moved = shots.frame(scene, shots.shot(roi=(1124, 2016, 60, 80)), beam=False)
    np.testing.assert_array_equal(frame[4:, 8:] > 0, moved[:-4, :-8] > 0)
    binned_shot = shots.shot(detector=Detector.centred((30, 40), 0.02), binning=2)
    binned = shots.frame(scene, binned_shot, beam=False)
    np.testing.assert_array_equal(binned > 0, (frame > 0).reshape(30, 2, 40, 2).any(axis=(1, 3)))
    rows, cols, rates = HotPixels(1e-3, 2000.0, 1).pixels()
    assert rates.mean() == pytest.approx(2000, rel=0.05)
    assert rows.max() > 2290
    assert cols.max() > 4080


def test_a_wrong_parameter_is_refused() -> None:
    with pytest.raises(ValueError, match=r"fraction must lie in 0 ... 0.1"):
        HotPixels(fraction=2.0)
