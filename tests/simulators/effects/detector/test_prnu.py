"""PRNU: a share of the light that belongs to the pixel, gone from a projection over its flat."""

from __future__ import annotations

import numpy as np

from simulators.effects.detector.prnu import Prnu
from tests.simulators import chance, shots


def test_gains_are_normal_around_one_and_stay_on_the_sensor() -> None:
    flat, later = (Prnu(0.02).apply(np.full((300, 400), 500.0), shots.sized(300, 400, frame=k)) for k in (1, 2))
    chance.normal_like((flat / 500 - 1) / 0.02)
    chance.mean_is(flat / 500, 1.0, 0.02**2)
    np.testing.assert_array_equal(flat, later)
    moved = Prnu(0.02).apply(np.full((300, 400), 500.0), shots.sized(300, 400, roi=(4, 8, 300, 400)))
    np.testing.assert_array_equal(flat[4:, 8:], moved[:-4, :-8])
    chance.uncorrelated(flat, Prnu(0.02, seed=1).apply(np.full((300, 400), 500.0), shots.sized(300, 400)))


def test_a_binned_pixel_has_the_mean_of_its_pixels() -> None:
    flat = Prnu(0.02).apply(np.full((300, 400), 1.0), shots.sized(300, 400))
    summed = Prnu(0.02).apply(
        np.full((150, 200), 1.0), shots.sized(300, 400, binning=2, detector=shots.sized(150, 200).detector)
    )
    np.testing.assert_allclose(summed, flat.reshape(150, 2, 200, 2).mean(axis=(1, 3)), rtol=1e-13)


def test_it_is_a_share_of_the_light() -> None:
    assert not Prnu(0.2).apply(np.zeros((60, 80)), shots.shot()).any()
    ramp = np.linspace(0, 9, 4800).reshape(60, 80)
    gain = Prnu(0.01).apply(np.ones((60, 80)), shots.shot())
    np.testing.assert_allclose(Prnu(0.01).apply(ramp.copy(), shots.shot()), ramp * gain)
    scene = shots.scene({"kind": "prnu", "spread": 0.05}, flux=4e5)
    ratio = shots.frame(scene).astype(float) / shots.frame(scene, sample=False)
    np.testing.assert_allclose(ratio, np.exp(-shots.depth(scene, 0.4)), atol=3e-5)
