"""Offset: 200 counts whatever is binned, none of photon numbers, and pixels that differ."""

from __future__ import annotations

import numpy as np

from simulators.effects.offset import Offset
from tests.simulators import chance, shots


def test_the_offset_is_added_in_counts() -> None:
    assert (Offset().apply(np.full((60, 80), 5.0), shots.shot()) == 205).all()
    binned = shots.shot(binning=4, detector=shots.sized(15, 20).detector)
    assert (Offset().apply(np.full((15, 20), 5.0), binned) == 205).all()
    assert (shots.frame(shots.scene("offset"), beam=False) == 200).all()


def test_photon_numbers_have_none() -> None:
    photons = np.full((60, 80), 5.0)
    assert (Offset(spread=1.0).apply(photons, shots.shot(readout="photon_number")) == 5).all()


def test_pixels_differ_and_stay() -> None:
    one, other = (Offset(1.5).apply(np.zeros((300, 400)), shots.sized(300, 400, frame=k)) - 200 for k in (1, 2))
    chance.normal_like(one / 1.5)
    chance.variance_is(one, 1.5**2)
    np.testing.assert_array_equal(one, other)
    chance.uncorrelated(one, Offset(1.5, seed=1).apply(np.zeros((300, 400)), shots.sized(300, 400)))
    summed = shots.sized(300, 400, binning=2, detector=shots.sized(150, 200).detector)
    np.testing.assert_allclose(
        Offset(1.5).apply(np.zeros((150, 200)), summed) - 200, one.reshape(150, 2, 200, 2).sum(axis=(1, 3))
    )
