"""The plan of a trade-off: every method once as it is, then one change at a time."""

from __future__ import annotations

import json
import math
from dataclasses import fields, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.features.trials.plans import Timed, plan, plan_in_equal_time, quick_first, trials_left
from beamline.features.trials.trial import QUALITIES, Outcome, Trial
from recon.base.method import BoundedMethod
from recon.methods import by_name, names_of_one_volume

METHODS = names_of_one_volume()
CHOICES = st.lists(st.sampled_from(METHODS), min_size=1, unique=True)
VARIED = {
    "views": set(), "gaussians": {"gaussians"}, "steps": {"steps"}, "binning": {"gaussians", "steps"},
    "loss": {"fit.loss", "fit.ssim_weight"}, "start": {"start"}, "kernel": {"fit.kernel"},
    "rectification": {"fit.rays.rectified"},
    "iterations": {"iterations"},
}  # fmt: skip


@given(CHOICES, st.integers(2, 2000), st.integers(1, 400_000), st.sampled_from(["quick", "full"]))
def test_one_change_at_a_time_about_each_methods_baseline(
    methods: list[str], n_views: int, gaussians: int, depth: str
) -> None:
    trials = plan(methods, n_views, gaussians, depth)  # type: ignore[arg-type]
    assert len(set(trials)) == len(trials)
    bases = {t.method: t for t in trials if t.group == "method"}
    assert list(bases) == methods == [t.method for t in trials[: len(methods)]]
    assert all(base.halves and base.views == n_views for base in bases.values())
    for trial in trials[len(methods) :]:
        base = bases[trial.method]
        changed = {name for name, _ in trial.settings.items() ^ base.settings.items()}
        assert changed <= VARIED[trial.group]
        assert (trial.views != n_views) is (trial.group == "views")
        assert (trial.binning != 1) is (trial.group == "binning")
        assert isinstance(trial.build(), by_name(trial.method))
        assert 2 <= trial.views <= n_views
        assert not trial.halves


@given(st.floats(0.5, 1e5), st.integers(0, 5))
def test_in_equal_time_each_method_comes_once_and_nothing_but_the_time_ends_it(seconds: float, done: int) -> None:
    trials = plan_in_equal_time(METHODS, 60, 1000, seconds)
    assert [trial.method for trial in trials] == list(METHODS) and not any(trial.halves for trial in trials)
    for trial in trials:
        method = trial.build()
        assert trial.seconds_asked == (None if method.traits.direct else seconds)
        assert isinstance(method, BoundedMethod) == hasattr(method, "seconds")
        for length in {"steps", "iterations"} & {f.name for f in fields(method)}:  # type: ignore[arg-type]
            if method.traits.own_length:
                assert (getattr(method, length) or 0) < 1e3  # None: the data choose it
                continue
            assert getattr(method, length) > 1e5 and f"{seconds:g} s" in trial.label and length not in trial.label
        assert not isinstance(method, BoundedMethod) or method.seconds == seconds
    started = [Timed(trials[0], 2.0 + seconds, seconds)] * done
    left = trials_left(started, [trials[0]] * 3, lambda trial: None)
    assert (left is None) == (not done)
    assert left is None or left == pytest.approx(3 * (2.0 + seconds))


def test_full_tries_more_than_quick() -> None:
    quick, full = (plan(METHODS, 90, 50_000, depth) for depth in ("quick", "full"))
    assert len(quick) < 0.7 * len(full)
    assert len({t.label for t in full}) == len(full)


def test_a_method_or_setting_that_there_is_not_is_refused() -> None:
    with pytest.raises(ValueError, match=r"method 'art' is unknown; legal: r2, "):
        plan(("fbp", "art"), 60, 1000, "quick")
    with pytest.raises(ValueError, match=r"'steps' \(r2.* has\)"):
        Trial("method", "sirt", 60, settings={"steps": 5}).build()


def test_labels_say_what_is_not_the_default() -> None:
    trial = Trial("method", "r2", 60, settings={"steps": 500, "gaussians": 50_000})
    assert trial.label == "r2, 60 views, 500 steps, 50k Gaussians"
    changed = {**trial.settings, "fit.ssim_weight": 0.0, "fit.kernel": "gaussian"}
    assert replace(trial, settings=changed, binning=2).label == (
        "r2, 60 views, bin 2, 500 steps, 50k Gaussians, no SSIM, gaussian kernel"
    )
    assert (
        replace(trial, settings={**trial.settings, "start": "tv"}).label
        == "r2, 60 views, 500 steps, 50k Gaussians, start tv"
    )
    assert Trial("iterations", "sart", 9, settings={"iterations": 1}).label == "sart, 9 views, 1 iteration"
    assert Trial("iterations", "sart", 9, settings={"iterations": 30}).label == "sart, 9 views, 30 iterations"


@given(st.floats(0.1, 1e4), st.integers(1, 20), st.floats(0, 10))
def test_the_time_left_is_a_start_each_and_the_work(speed: float, n: int, start: float) -> None:
    base = Trial("method", "r2", 60, settings={"steps": 100, "gaussians": 1000})
    left = [replace(base, settings={**base.settings, "steps": 100 * k}) for k in range(1, n + 1)]

    def steps(trial: Trial) -> float | None:
        return float(trial.settings["steps"] or 0) if "steps" in trial.settings else None

    one = Timed(base, start + speed * 100, speed * 100)
    assert trials_left([one], left, steps) == pytest.approx(n * start + speed * 100 * n * (n + 1) / 2)
    assert trials_left([one], [], steps) == 0
    assert trials_left([], left, steps) is None
    assert quick_first(left[::-1], steps)[0] == left[-1]  # baselines keep their order
    varied = [replace(each, group="steps") for each in left]
    assert quick_first([*varied[::-1], base], steps) == (base, *varied)
    # Of a method never tried nothing better is known than the mean of what was.
    done = [Timed(base, 7.0, 4.0), Timed(base, 11.0, 8.0)]
    other = Trial("method", "fbp", 60)
    assert trials_left(done, [other], steps) == pytest.approx(3 + 6)
    assert trials_left(done, [other], lambda trial: 1.0 if trial is other else 4.0) == pytest.approx(3 + 6 / 4)


def test_where_the_time_of_a_trial_went() -> None:
    trial = Trial("steps", "r2", 60, settings={"steps": 100, "gaussians": 1000})
    assert Timed.of(Outcome(trial, "done", 4.0), 7.0) == Timed(trial, 7.0, 4.0)
    base = replace(trial, group="method", halves=True)
    assert Timed.of(Outcome(base, "done", 4.0), 15.0).working == 12.0
    assert Timed.of(Outcome(base, "done", 4.0), 10.0).working == 10.0
    assert Timed.of(Outcome(trial, "failed"), 3.0) == Timed(trial, 3.0, 0.0)


def test_quality_is_decibels_either_way_and_a_record_is_plain() -> None:
    outcome = Outcome(Trial("method", "fbp", 4), "done", 1.0, metrics={"psnr": 30.0, "residual_held_out": 0.1})
    assert outcome.quality("psnr") == 30
    assert outcome.quality("residual_held_out") == pytest.approx(20)
    assert math.isnan(Outcome(outcome.trial, "failed").quality("psnr"))
    assert math.isnan(QUALITIES["residual_held_out"].decibels(0.0))
    assert json.loads(json.dumps(outcome.as_record()))["trial"]["label"] == "fbp, 4 views"
