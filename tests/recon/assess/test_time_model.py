"""The price of a decibel is that of curves whose price is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from recon.assess.metrics import psnr
from recon.assess.time_model import CURVES, duration_text, next_decibel, next_decibel_of_fit, parse_budget
from recon.base.empirical import DEFAULT_STEPS
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.reconstruction import reconstruct
from recon.splatting.r2 import R2
from tests.recon.hard_cases import spheres


@given(st.floats(0.6, 8), st.floats(0.5, 1e4), st.integers(0, 100))
def test_a_logarithmic_gain_is_followed_to_its_next_decibel(slope: float, end: float, seed: int) -> None:
    """q = 20 + slope ln t has its next dB at t exp(1 / slope), whatever the units of time."""
    rng = np.random.default_rng(seed)
    t = np.linspace(end / 200, end, 200)
    quality = 20 + slope * np.log(t / end)
    found = next_decibel(t, 10 ** (-quality / 20))
    expected = end * math.expm1(1 / slope)
    assert found.seconds == pytest.approx(expected, rel=0.01)
    assert found.low <= found.seconds <= found.high
    noisy = next_decibel(t, 10 ** (-(quality + rng.normal(0, 0.01, t.size)) / 20))
    assert noisy.low * 0.7 < expected < noisy.high * 1.4


@given(st.integers(0, 300), st.integers(20, 400))
def test_of_a_flat_record_nothing_is_claimed(seed: int, n: int) -> None:
    """Noise alone passes for a gain of a dB within ten times the time in few of many records, if in any."""
    rng = np.random.default_rng(seed)
    t = np.linspace(1, 60, n)
    assert not next_decibel(t, 10 ** (-(30 + rng.normal(0, 0.02, n)) / 20)).measurable
    falling = next_decibel(t, 10 ** (-(30 - 0.5 * np.log(t)) / 20))
    assert falling.seconds == math.inf


@given(st.integers(1, 3000), st.floats(0.1, 1e4))
def test_a_fit_is_told_what_fits_of_other_lengths_gained(steps: int, seconds: float) -> None:
    found = next_decibel_of_fit(seconds, steps)
    assert found.of == "volume" and 0 < found.low <= found.seconds <= found.high
    longer = next_decibel_of_fit(2 * seconds, steps)
    assert longer.seconds == pytest.approx(2 * found.seconds) or not found.measurable
    if found.measurable:
        most = max(found.seconds / seconds, 0) + 1
        assert most <= 10 + 1e-9
        # The middle curve gains a dB after that many times the steps.
        curves = [c for c in CURVES if c.binning == 1 and c.share > 0]
        inside = [c for c in curves if c.points[0][0] <= steps and steps * most <= c.points[-1][0]]
        gains = [c.gain(steps * most) - c.gain(steps) for c in inside]
        if len(inside) == len(curves):
            assert min(gains) <= 1.05 and max(gains) >= 0.95


@pytest.mark.slow
def test_a_fit_of_the_default_length_has_no_decibel_in_reach() -> None:
    """The forecast for a finished fit against one of twice the steps, of a smaller scan: 44.0 and 44.2 dB."""
    geometry = Geometry.parallel(np.linspace(0, np.pi, 40, endpoint=False), (12, 48))
    data, truth = spheres.projections(geometry), spheres.volume(Grid.matching(geometry))
    data += np.random.default_rng(0).normal(0, 0.01, data.shape).astype(np.float32)
    short, long = (
        psnr(truth, reconstruct(data, geometry, R2(steps=n)).volume.data) for n in (DEFAULT_STEPS, 2 * DEFAULT_STEPS)
    )
    assert long - short < 0.5
    assert not next_decibel_of_fit(1.0, DEFAULT_STEPS).measurable


@pytest.mark.parametrize(
    ("seconds", "residuals"),
    [([], []), ([1.0], [0.1]), ([1, 2, 3], [0.1, 0.09, 0.08]), ([1, 2, 3, 4], [np.nan] * 4), (range(9), [0.0] * 9)],
)
def test_records_too_short_to_tell(seconds: list[float], residuals: list[float]) -> None:
    assert next_decibel(seconds, residuals) is None


@given(st.floats(0.1, 900))
def test_times_are_read_in_any_unit(value: float) -> None:
    assume(value > 0.1)
    assert parse_budget(f"{value}s") == parse_budget(str(value)) == pytest.approx(value)
    assert parse_budget(f" {value}m ") == pytest.approx(60 * value)
    assert parse_budget(f"{value}H") == pytest.approx(3600 * value)


@pytest.mark.parametrize("text", ["", "s", "0s", "-1m", "nan", "inf", "30 parsecs", "1h30m", "1e400s"])
def test_what_is_no_time(text: str) -> None:
    with pytest.raises(ValueError, match="is not a time"):
        parse_budget(text)


def test_times_are_said_in_units_that_fit() -> None:
    assert [duration_text(t) for t in (0.25, 31.4, 150, 7200)] == ["0.25 s", "31.4 s", "2.5 min", "2 h"]
