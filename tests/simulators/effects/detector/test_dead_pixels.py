"""Dead pixels: the same charge whatever falls on them, at places that belong to the sensor."""

from __future__ import annotations

import numpy as np

from simulators.effects.detector.dead_pixels import DeadPixels
from simulators.effects.detector.hot_pixels import HotPixels
from tests.simulators import shots


def test_dead_pixels_hold_their_charge_and_the_others_theirs() -> None:
    light = np.linspace(100, 900, 4800).reshape(60, 80)
    dead = DeadPixels(0.01).apply(light.copy(), shots.shot())
    assert 0.006 < (dead == 0).mean() < 0.013
    np.testing.assert_array_equal(dead[dead > 0], light[dead > 0])
    stuck = DeadPixels(0.01, charge=7000.0).apply(light.copy(), shots.shot(frame=9, seed=9))
    np.testing.assert_array_equal(stuck == 7000, dead == 0)


def test_they_move_with_the_region_and_are_not_the_hot_ones() -> None:
    dead = DeadPixels(0.01).apply(np.ones((60, 80)), shots.shot())
    moved = DeadPixels(0.01).apply(np.ones((60, 80)), shots.shot(roi=(1124, 2016, 60, 80)))
    np.testing.assert_array_equal(dead[4:, 8:], moved[:-4, :-8])
    hot = HotPixels(0.01, 1e6).apply(np.zeros((60, 80)), shots.shot())
    assert ((dead == 0) & (hot > 0)).sum() <= 3  # 0.5 expected


def test_a_binned_pixel_loses_the_share_of_its_dead_pixels() -> None:
    dead = DeadPixels(0.1).apply(np.ones((60, 80)), shots.shot())
    shot = shots.shot(detector=shots.sized(30, 40).detector, binning=2)
    for charge in (0.0, 3.0):
        share = dead + charge * (dead == 0)
        binned = DeadPixels(0.1, charge).apply(np.full((30, 40), 4.0), shot)
        np.testing.assert_allclose(binned, share.reshape(30, 2, 40, 2).sum(axis=(1, 3)))
