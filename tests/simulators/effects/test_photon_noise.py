"""Photon noise: Poisson in its moments and where hardly any light is."""

from __future__ import annotations

import math

import pytest

from simulators import sensor
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]


def test_photon_noise_is_poisson() -> None:
    electrons = shots.frame(shots.scene("photon_noise"), sample=False) * CONVERSION
    assert electrons.mean() == pytest.approx(4000, abs=4 * math.sqrt(4000 / electrons.size))
    assert electrons.var() == pytest.approx(4000, rel=4 * math.sqrt(2 / electrons.size))
    thin = shots.frame(shots.scene("photon_noise", flux=0.5 / 0.01), sample=False)
    assert (thin == 0).mean() == pytest.approx(math.exp(-0.5), abs=0.03)  # P(0) = exp(-λ)
