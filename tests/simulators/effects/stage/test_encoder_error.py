"""Encoder error: the sample at another angle than the trigger's."""

from __future__ import annotations

import math

import numpy as np
import pytest

from simulators.effects.stage.encoder_error import EncoderError
from tests.simulators import shots
from tests.simulators.poses import posed


def test_the_sample_stands_at_the_angle_of_its_waves() -> None:
    angles = np.linspace(-1.0, 6.0, 11)
    turned = posed(EncoderError(((1, 8.0, 30.0), (180, 2.0, 0.0))), angles, rows=11).angle
    error = 8.0 * np.cos(angles + math.radians(30.0)) + 2.0 * np.cos(180 * angles)
    np.testing.assert_allclose(1e3 * np.degrees(turned - angles), error, atol=1e-9)


def test_a_frame_equals_the_frame_at_the_true_angle() -> None:
    scene = shots.scene({"kind": "encoder_error", "harmonics": [[2, 500.0, 0.0]]})
    angle = 0.4 + math.radians(0.5 * math.cos(0.8))
    np.testing.assert_array_equal(shots.frame(scene), shots.frame(shots.scene(), shots.shot(angle=angle)))
    assert (shots.frame(scene) != shots.frame(shots.scene())).any()


def test_the_rest_is_drawn_for_each_frame() -> None:
    error = np.array([1e3 * np.degrees(posed(EncoderError((), 3.0), 0.3, frame=k).angle - 0.3) for k in range(400)])
    assert (error == error[:, :1]).all()
    # Mean and variance of 400 Gaussian draws; 5 standard errors fail once in 1.7 million.
    assert abs(error[:, 0].mean()) < 5 * 3.0 / math.sqrt(400)
    assert error[:, 0].var() == pytest.approx(9.0, rel=5 * math.sqrt(2 / 400))
