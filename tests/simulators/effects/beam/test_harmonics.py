"""Harmonics: the sum of two exponentials, at any depth."""

from __future__ import annotations

import math
from decimal import Decimal, getcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.effects.beam.harmonics import Harmonics
from simulators.frame import sensor
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]


@given(depth=st.floats(-1e-12, 1e4), share=st.floats(0, 1), ratio=st.floats(0, 1))
def test_transmissions_of_both_energies_add_up(depth: float, share: float, ratio: float) -> None:
    """Against 60 digits, since exp(-1e4) is no float."""
    getcontext().prec = 60
    d, f, r = Decimal(depth), Decimal(share), Decimal(ratio)
    expected = -float(((1 - f) * (-d).exp() + f * (-d * r).exp()).ln())
    seen = Harmonics(share, ratio).apply(np.array([[depth]]), shots.shot())
    assert seen[0, 0] == pytest.approx(expected, rel=1e-11, abs=1e-14)


def test_a_frame_has_a_twenty_seventh_of_the_attenuation_at_the_third_harmonic() -> None:
    depth = shots.depth(shots.scene(), 0.4)
    frame = shots.frame(shots.scene({"kind": "harmonics", "share": 0.02})) * CONVERSION / 4000
    np.testing.assert_allclose(frame, 0.98 * np.exp(-depth) + 0.02 * np.exp(-depth / 27), atol=2e-5)
    flat = shots.frame(shots.scene({"kind": "harmonics", "share": 0.02}), sample=False)
    assert (flat == round(4000 / CONVERSION)).all()


def test_an_opaque_sample_lets_the_harmonic_through() -> None:
    seen = Harmonics(0.01).apply(np.array([[80.0]]), shots.shot())
    assert seen[0, 0] == pytest.approx(80 / 27 - math.log(0.01), rel=1e-12)
