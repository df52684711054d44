"""Splines through even places, beside scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from recon.base.splines import spline_through, value_at


@pytest.mark.parametrize("derivative", [0, 1, 2])
def test_values_and_derivatives_are_those_of_scipy_away_from_the_ends(derivative: int) -> None:
    rng = np.random.default_rng(0)
    curves, places = rng.random((3, 60)), rng.uniform(20, 40, (3, 40))
    expected = [CubicSpline(np.arange(60), curve)(x, derivative) for curve, x in zip(curves, places, strict=True)]
    np.testing.assert_allclose(value_at(spline_through(curves), places, derivative), expected, rtol=1e-6, atol=1e-9)


def test_it_goes_through_its_values_and_beyond_the_ends_keeps_the_last() -> None:
    curve = np.random.default_rng(1).random(9)
    found = value_at(spline_through(curve), np.arange(-2.0, 11.0))
    np.testing.assert_allclose(found, [curve[0], curve[0], *curve, curve[-1], curve[-1]], atol=1e-12)
