"""The choice for a budget keeps its promises, and the price of a decibel is that of curves whose price is known."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from recon.assess.metrics import psnr
from recon.assess.time_model import (
    CURVES,
    PRESETS,
    Choice,
    Curve,
    Speeds,
    choose,
    next_decibel,
    next_decibel_of_fit,
    parse_budget,
    parts_of,
)  # fmt: skip
from recon.bench import spheres
from recon.reconstruction import reconstruct
from recon.splatting.r2 import R2

SPEEDS = st.builds(
    Speeds, fbp=st.floats(0.01, 100), start=st.floats(0.01, 100), step=st.floats(1e-4, 10), fill=st.floats(0.01, 50)
)
BUDGETS = st.floats(0.1, 1e5)


def _cost(choice: Choice, speeds: Speeds) -> float:
    """Time that a choice takes at the given speeds, computed independently."""
    time = speeds.fbp / choice.binning**3
    if choice.fits:
        ratios = [(c, choice.binning // c.binning) for c in CURVES if c.binning == min(choice.binning, 2)]
        kinds = [(c, n) for c, n in ratios if math.isclose(c.share, choice.share * n**3)]
        assert len(kinds) == 1
        ((curve, further),) = kinds
        time += (speeds.start + speeds.fill) * choice.share + choice.steps * speeds.step * curve.pace / further**2
    return time


@example(1.0, Speeds(fbp=100.0, start=1.0, step=1.0, fill=1.0), 3)
@given(BUDGETS, SPEEDS, st.integers(1, 4000))
def test_what_is_chosen_fits_the_budget_or_is_the_smallest_there_is(
    budget: float, speeds: Speeds, largest: int
) -> None:
    choice = choose(budget, speeds, largest)
    assert choice.binning in (1, 2, 4, 8) and choice.binning <= max(1, largest)
    if math.isfinite(choice.gain):
        assert _cost(choice, speeds) <= budget * (1 + 1e-9)
    else:
        assert not choice.fits and speeds.fbp / choice.binning**3 > budget
    assert (choice.steps > 0) is (choice.fits)


@given(BUDGETS, SPEEDS, st.floats(1, 10))
def test_more_time_or_a_faster_machine_never_promises_less(budget: float, speeds: Speeds, factor: float) -> None:
    base = choose(budget, speeds, 1000).gain
    faster = Speeds(*(value / factor for value in (speeds.fbp, speeds.start, speeds.step, speeds.fill)))
    assert choose(budget * factor, speeds, 1000).gain >= base - 1e-9
    assert choose(budget, faster, 1000).gain >= base - 1e-9


def test_with_little_time_it_is_fbp_and_with_much_a_fit_of_all_pixels() -> None:
    speeds = Speeds(fbp=0.5, start=1.0, step=5e-3, fill=0.2)
    assert choose(0.6, speeds, 1000) == Choice(1, 0.0, 0, 0.0)
    joined = choose(0.1, speeds, 1000)
    assert not joined.fits and joined.binning == 2
    long = choose(60.0, speeds, 1000)
    assert long.fits and long.binning == 1
    assert long.gain > 1 and long.steps > 500
    with pytest.raises(ValueError, match="positive"):
        choose(0.0, speeds, 100)


def test_the_curves_are_curves() -> None:
    assert any((c.binning, c.share, c.pace) == (1, 1.0, 1.0) for c in CURVES)
    for curve in CURVES:
        assert all(a[0] < b[0] and a[1] <= b[1] + 0.3 for a, b in pairwise(curve.points))  # noise may cost a little
        assert curve.gain(curve.points[0][0] / 2) == -math.inf
        assert curve.gain(1e9) == curve.points[-1][1]
    assert Curve(1, 1.0, 1.0, ((100, 1.0), (400, 3.0))).gain(200) == pytest.approx(2.0)
    assert PRESETS["preview"].steps < PRESETS["standard"].steps < PRESETS["best"].steps


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
        curves = [c for c in CURVES if c.binning == 1]
        inside = [c for c in curves if c.points[0][0] <= steps and steps * most <= c.points[-1][0]]
        gains = [c.gain(steps * most) - c.gain(steps) for c in inside]
        if len(inside) == len(curves):
            assert min(gains) <= 1.05 and max(gains) >= 0.95


@pytest.mark.slow
def test_the_next_decibel_of_a_fit_is_about_what_it_takes() -> None:
    """The forecast of the shorter fit's volume against longer fits of a third sample."""
    data, geometry, truth = spheres(side=64, rows=32, views=40)
    found = {
        steps: psnr(truth, reconstruct(data, geometry, R2(steps=steps)).volume.data)
        for steps in (125, 150, 180, 250, 350)
    }
    at, gains = np.log(list(found)), np.array(list(found.values()))
    forecast = next_decibel_of_fit(1.0, 125)
    needed = float(np.exp(np.interp(gains[0] + 1, gains, at)) / 125 - 1)
    assert forecast.seconds / 2.5 < needed < 2.5 * forecast.seconds


@pytest.mark.parametrize(
    ("seconds", "residuals"),
    [([], []), ([1.0], [0.1]), ([1, 2, 3], [0.1, 0.09, 0.08]), ([1, 2, 3, 4], [np.nan] * 4), (range(9), [0.0] * 9)],
)
def test_records_too_short_to_tell(seconds: list[float], residuals: list[float]) -> None:
    assert not next_decibel(seconds, residuals).measurable


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
    assert [parts_of(t) for t in (0.25, 31.4, 150, 7200)] == ["0.25 s", "31.4 s", "2.5 min", "2 h"]
