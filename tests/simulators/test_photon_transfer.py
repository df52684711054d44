"""Photon transfer: variance over mean is the conversion factor, whatever the light."""

from __future__ import annotations

import math

import pytest

from simulators import sensor
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]


def test_photon_transfer_curve_has_the_conversion_factor() -> None:
    """Variance over mean above the offset is 1 / (electrons a count), whatever the light (Janesick 2007)."""
    for flux in (2e4, 1e5, 6e5):
        flat = shots.frame(shots.scene("photon_noise", "read_noise", "offset", flux=flux), sample=False) - 200.0
        signal_variance = flat.var() - (0.43 / CONVERSION) ** 2 - 1 / 12
        assert flat.mean() / signal_variance == pytest.approx(CONVERSION, rel=4 * math.sqrt(2 / flat.size))
