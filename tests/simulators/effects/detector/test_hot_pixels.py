"""Hot pixels: they stay where they are on the sensor, and their dark currents are exponential."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.orca_quest import SENSOR_SHAPE
from simulators.effects.detector.hot_pixels import HotPixels
from tests.simulators import chance, shots


def test_hot_pixels_stay_on_the_sensor_whatever_the_roi() -> None:
    effect = HotPixels(fraction=0.01, rate=1e5, seed=4)
    frame = effect.apply(np.zeros((60, 80)), shots.shot())
    assert 0.006 < (frame > 0).mean() < 0.012
    moved = effect.apply(np.zeros((60, 80)), shots.shot(roi=(1124, 2016, 60, 80)))
    np.testing.assert_array_equal(frame[4:, 8:] > 0, moved[:-4, :-8] > 0)
    binned = effect.apply(np.zeros((30, 40)), shots.shot(detector=shots.sized(30, 40).detector, binning=2))
    np.testing.assert_array_equal(binned > 0, (frame > 0).reshape(30, 2, 40, 2).any(axis=(1, 3)))
    assert (HotPixels(0.01, 1e5, seed=5).apply(np.zeros((60, 80)), shots.shot()) > 0)[frame > 0].mean() < 0.5


def test_their_electrons_are_poisson_of_exponential_currents() -> None:
    """Then a number is geometric: mean m = rate x exposure, variance m² + m."""
    whole = shots.sized(*SENSOR_SHAPE)
    frame = HotPixels(2e-3, 2000.0).apply(np.zeros(SENSOR_SHAPE), whole)
    lit = frame[frame > 0] - 1  # a geometric number is the same again above 1: no memory
    n = 2e-3 * frame.size
    assert lit.size == pytest.approx(n * 20 / 21, rel=0.02)
    chance.mean_is(lit, 20.0, 420.0)
    rows, cols = np.nonzero(frame)
    assert rows.max() > 2290
    assert cols.max() > 4080


def test_each_frame_has_other_electrons_of_the_same_pixels() -> None:
    one, other = (HotPixels(0.01, 1e5).apply(np.zeros((60, 80)), shots.shot(frame=k)) for k in (1, 2))
    np.testing.assert_array_equal(one > 0, other > 0)
    assert (one != other).any()
    hot = one > 0
    assert np.abs(one - other)[hot].max() < 10 * np.sqrt(one.max())
