"""Saturation: a clip at the full well, or a bend by its equation."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from simulators.effects.saturation import Saturation
from tests.simulators import shots


def _response(effect: Saturation, charge: NDArray[np.float64], binning: int = 1) -> NDArray[np.float64]:
    return effect.apply(np.atleast_2d(charge).copy(), shots.shot(binning=binning))[0]


def test_charge_beyond_the_full_well_is_lost() -> None:
    np.testing.assert_array_equal(_response(Saturation(), np.array([0, 6999.5, 7000, 9e9])), [0, 6999.5, 7000, 7000])
    np.testing.assert_array_equal(_response(Saturation(100.0), np.array([399.0, 500.0]), 2), [399, 400])  # four pixels


@given(st.floats(0.01, 1), st.floats(10, 1e5))
def test_the_knee_bends_smoothly_towards_the_full_well(knee: float, well: float) -> None:
    charge = np.linspace(0, 4 * well, 4001)
    out, begin = _response(Saturation(well, knee), charge), (1 - knee) * well
    np.testing.assert_array_equal(out[charge <= begin], charge[charge <= begin])
    bent = (charge > begin) & (well - out > 1e-6 * knee * well)
    # From the equation the other way round: x = x0 - (W - x0) ln(1 - (y - x0) / (W - x0)).
    back = begin - knee * well * np.log((well - out[bent]) / (knee * well))
    np.testing.assert_allclose(back, charge[bent], rtol=1e-6)
    slope = np.diff(out) / np.diff(charge)
    assert (slope >= 0).all()
    assert (slope <= 1 + 1e-9).all()
    assert out.max() <= well


def test_it_does_not_touch_the_light_that_fits() -> None:
    charge = np.linspace(0, 6999, 500)
    np.testing.assert_array_equal(_response(Saturation(), charge), charge)
