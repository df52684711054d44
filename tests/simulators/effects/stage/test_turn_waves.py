"""Turn waves: a sum of waves over a turn."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from simulators.effects.stage.turn_waves import series

ANGLES = np.linspace(-4.0, 9.0, 27)


@given(st.lists(st.tuples(st.integers(-9, 9), st.floats(0, 50), st.floats(-180, 180)), unique_by=lambda h: h[0]))
def test_a_series_is_its_waves_one_by_one_and_comes_back_every_turn(harmonics: list[tuple[int, float, float]]) -> None:
    total = series(ANGLES, harmonics)
    cosines = sum((a * np.cos(k * ANGLES + np.deg2rad(p)) for k, a, p in harmonics), np.zeros(27))
    sines = sum((a * np.sin(k * ANGLES + np.deg2rad(p)) for k, a, p in harmonics), np.zeros(27))
    np.testing.assert_allclose(total.real, cosines, atol=1e-9)
    np.testing.assert_allclose(total.imag, sines, atol=1e-9)
    np.testing.assert_allclose(series(ANGLES + 2 * np.pi, harmonics), total, atol=1e-9)
