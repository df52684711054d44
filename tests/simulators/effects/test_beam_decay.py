"""Beam decay: the exponential, by its half-life."""

from __future__ import annotations

import math

import pytest

from simulators import sensor
from simulators.effects.beam_decay import BeamDecay
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]


def test_beam_decay_halves_in_its_half_life() -> None:
    scene = shots.scene({"kind": "beam_decay", "lifetime": 100.0})
    half = shots.frame(scene, shots.shot(elapsed=100 * math.log(2)), sample=False)
    assert (half == round(2000 / CONVERSION)).all()


def test_a_wrong_parameter_is_refused() -> None:
    with pytest.raises(ValueError, match=r"lifetime must be positive, got 0.0 s"):
        BeamDecay(lifetime=0.0)
