"""Plans for a budget keep its time, promise no less of more time, and know every method that was measured."""

from __future__ import annotations

import math
from dataclasses import astuple
from itertools import pairwise

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from recon.assess.time_model import CURVES, PRESETS, Choice, QualityCurve, Speeds, best_steps, plans
from recon.methods import build, by_name

SPEEDS = st.builds(
    Speeds, fbp=st.floats(0.01, 100), start=st.floats(0.01, 100), step=st.floats(1e-4, 10), fill=st.floats(0.01, 50),
    sweep=st.one_of(st.floats(1e-3, 50), st.just(math.inf)),
)  # fmt: skip
BUDGETS = st.floats(0.1, 1e5)
METHODS = {curve.method for curve in CURVES}


def _cost(choice: Choice, speeds: Speeds) -> float:
    """Time that a choice takes at the given speeds, computed independently."""
    ratios = [(c, choice.binning // c.binning) for c in CURVES if c.binning == min(choice.binning, 2)]
    kinds = [(c, n) for c, n in ratios if c.method == choice.method and math.isclose(c.share, choice.share * n**3)]
    assert len(kinds) == 1
    ((curve, further),) = kinds
    voxels = choice.binning**3
    if choice.method == "fbp":
        return speeds.fbp / voxels
    if not choice.is_gaussian_fit:
        return (speeds.fbp + speeds.sweep * (curve.sweeps + curve.pace * choice.steps)) / voxels
    finish = 0 if speeds.sweep == math.inf else curve.sweeps * speeds.sweep / voxels
    placed = (speeds.start + speeds.fill) * choice.share
    return speeds.fbp / voxels + placed + choice.steps * speeds.step * curve.pace / further**2 + finish


@example(1.0, Speeds(fbp=100.0, start=1.0, step=1.0, fill=1.0, sweep=9.0), 3)
@given(BUDGETS, SPEEDS, st.integers(1, 4000))
def test_plans_fit_the_budget_or_there_is_one_that_takes_the_least(budget: float, speeds: Speeds, largest: int) -> None:
    found = plans(budget, speeds, largest)
    assert all(c.binning in (1, 2, 4, 8) and c.binning <= max(1, largest) for c in found)
    assert all(c.seconds == pytest.approx(_cost(c, speeds)) for c in found)
    assert len({c.method for c in found}) == len(found)
    assert all(a.gain >= b.gain for a, b in pairwise(found))
    if math.isfinite(found[0].gain):
        assert all(c.seconds <= budget * (1 + 1e-9) for c in found)
    else:
        (shortest,) = found
        assert shortest.seconds > budget and shortest.seconds <= speeds.fbp / min(8, 2 ** int(math.log2(largest))) ** 3


@given(BUDGETS, SPEEDS, st.floats(1, 10))
def test_more_time_or_a_faster_machine_never_promises_less(budget: float, speeds: Speeds, factor: float) -> None:
    base = {c.method: c.gain for c in plans(budget, speeds, 1000)}
    faster = Speeds(*(value / factor for value in astuple(speeds)))
    for better in (plans(budget * factor, speeds, 1000), plans(budget, faster, 1000)):
        gains = {c.method: c.gain for c in better}
        assert all(gains.get(name, -math.inf) >= gain - 1e-9 for name, gain in base.items())


def test_with_little_time_it_is_fbp_and_with_much_every_method_is_there() -> None:
    speeds = Speeds(fbp=0.5, start=1.0, step=5e-3, fill=0.2, sweep=0.3)
    assert plans(0.6, speeds, 1000)[0] == Choice("fbp", "", 1, 0.0, 1, 0.0, 0.5)
    coarse = plans(0.01, speeds, 1000)[0]
    assert (coarse.method, coarse.binning) == ("fbp", 4)
    long = plans(60.0, speeds, 1000)
    assert {c.method for c in long} == METHODS == {"fbp", "r2", "os-sirt-tv", "fista-tv"}
    assert all(c.binning == 1 for c in long) and long[0].gain > 1 and long[-1].method == "fbp"
    (only,) = plans(60.0, speeds, 1000, ["os-sirt-tv"])
    assert only in long
    leaning = Speeds(0.5, 1.0, 5e-3, 0.2, math.inf)  # voxels do not take these views: no finish either
    assert {c.method for c in plans(60.0, leaning, 1000)} == {"fbp", "r2"}
    with pytest.raises(ValueError, match="positive"):
        plans(0.0, speeds, 100)


def test_no_plan_has_more_steps_than_were_best() -> None:
    speeds = Speeds(fbp=0.5, start=1.0, step=5e-3, fill=0.2, sweep=0.3)
    found = {c.method: c.steps for c in plans(1e9, speeds, 1000)}
    assert best_steps("fbp") == 1 and best_steps("r2") in {n for c in CURVES for n, _ in c.points if c.method == "r2"}
    assert all(steps <= best_steps(method) for method, steps in found.items())


def test_a_choice_is_settings_of_its_method() -> None:
    speeds = Speeds(fbp=0.5, start=1.0, step=5e-3, fill=0.2, sweep=0.3)
    for choice in plans(60.0, speeds, 1000):
        method = build(by_name(choice.method), choice.settings(1000))
        assert not choice.counted or getattr(method, choice.counted) == choice.steps
        assert not choice.is_gaussian_fit or method.gaussians == round(1000 * choice.share)  # type: ignore[attr-defined]


def test_the_curves_are_curves() -> None:
    assert any((c.method, c.binning, c.share, c.pace) == ("r2", 1, 1.0, 1.0) for c in CURVES)
    for curve in CURVES:
        assert all(a[0] < b[0] for a, b in pairwise(curve.points))
        assert curve.gain(curve.points[0][0] / 2) == -math.inf
        assert curve.gain(1e9) == curve.points[-1][1]
    assert QualityCurve("r2", "steps", 1, 1.0, 1.0, 0.0, ((100, 1.0), (400, 3.0))).gain(200) == pytest.approx(2.0)
    assert PRESETS["preview"].steps < PRESETS["standard"].steps < PRESETS["best"].steps
