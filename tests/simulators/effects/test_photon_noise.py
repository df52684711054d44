"""Photon noise: Poisson around the expectation, another in each frame, and the same again for the same."""

from __future__ import annotations

import numpy as np
import pytest

from simulators.effects.photon_noise import PhotonNoise
from tests.simulators import chance, shots


@pytest.mark.parametrize("mean", [0.2, 4000.0])
def test_photon_noise_is_poisson(mean: float) -> None:
    shot = shots.sized(300, 400)
    photons = PhotonNoise().apply(np.full((300, 400), mean), shot)
    chance.poisson_like(photons, mean)
    chance.mean_is(photons, mean, mean)
    chance.variance_is(photons, mean, 1 / mean)
    again, later, seed = (
        PhotonNoise().apply(np.full((300, 400), mean), shots.sized(300, 400, **changes))
        for changes in ({}, {"frame": 3}, {"seed": 2})
    )
    np.testing.assert_array_equal(photons, again)
    chance.uncorrelated(photons, later)
    chance.uncorrelated(photons, seed)


def test_it_ends_the_photons() -> None:
    assert PhotonNoise.final
    counts = shots.frame(shots.scene("photon_noise"), sample=False) * shots.shot().conversion
    chance.mean_is(counts, 4000.0, 4000.0)


def test_what_is_no_expectation_is_refused() -> None:
    with pytest.raises(ValueError, match="expectations must lie in 0"):
        PhotonNoise().apply(np.full((60, 80), -1.0), shots.shot())
