"""Local: parabolas are themselves, at any spacing, and even spacing has Savitzky and Golay's coefficients."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import savgol_filter

from beamline.xafs.local import local_parabolas


@given(
    steps=st.lists(st.floats(0.1, 2), min_size=7, max_size=20), a=st.floats(-5, 5), b=st.floats(-5, 5),
    c=st.floats(-5, 5), window=st.sampled_from([3, 5, 7]),
)  # fmt: skip
def test_a_parabola_comes_out_as_it_is(steps: list[float], a: float, b: float, c: float, window: int) -> None:
    x = np.cumsum(steps)
    values, slopes = local_parabolas(x, a + b * x + c * x**2, window)
    np.testing.assert_allclose(values, a + b * x + c * x**2, atol=1e-8)
    np.testing.assert_allclose(slopes, b + 2 * c * x, atol=1e-7)


def test_even_spacing_is_savitzky_and_golay() -> None:
    y = np.random.default_rng(0).normal(size=30)
    values, slopes = local_parabolas(np.arange(30) * 0.5, y, 5)
    np.testing.assert_allclose(values, savgol_filter(y, 5, 2), atol=1e-12)
    np.testing.assert_allclose(slopes, savgol_filter(y, 5, 2, deriv=1, delta=0.5), atol=1e-12)
