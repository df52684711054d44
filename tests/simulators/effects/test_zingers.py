"""Zingers: as many as their rate says, in one frame only."""

from __future__ import annotations

import math

import numpy as np
import pytest

from simulators import sensor
from simulators.effects.zingers import Zingers
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]


def test_zingers_are_as_many_as_their_rate_says_and_in_one_frame_only() -> None:
    scene = shots.scene({"kind": "zingers", "rate": 1000.0, "charge": 500.0})
    frames = np.stack([shots.frame(scene, shots.shot(frame=k), beam=False) for k in range(30)])
    assert (frames > 0).sum() == pytest.approx(300, abs=4 * math.sqrt(300))  # 30 frames x 10 ms x 1000/s
    assert frames[frames > 0].mean() * CONVERSION == pytest.approx(500, rel=0.3)
    assert ((frames > 0).sum(axis=0) <= 2).all()


def test_a_wrong_parameter_is_refused() -> None:
    with pytest.raises(ValueError, match="rate must be >= 0"):
        Zingers(rate=-2.0)
