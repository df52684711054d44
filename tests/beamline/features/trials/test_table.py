"""Tables of trials: their values, which trials are on the Pareto front, and their files."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.core.files import write_table
from beamline.core.machine import machine
from beamline.features.trials import table as module
from beamline.features.trials.table import sentences, to_html
from beamline.features.trials.tradeoff import plan, plan_in_equal_time
from beamline.features.trials.trial import LEAST_GAIN, MethodTrial, Outcome, TrialTable
from recon.methods import by_name, names_of_one_volume


def test_noise_in_a_cost_puts_no_trial_on_the_front() -> None:
    trial = MethodTrial("method", "fbp", 10)
    outcomes = [
        Outcome(replace(trial, views=views), "done", seconds, memory, {"psnr": psnr})
        for views, seconds, memory, psnr in ((10, 1.0, 400_000_000, 20.0), (20, 2.0, 400_100_000, 25.0))
    ]
    table = TrialTable("tradeoff", "", tuple(outcomes), "psnr", machine(), {}, "")
    assert table.front == outcomes


def _judged(*trials: tuple[float, list[float]]) -> TrialTable:
    """Trials of so many seconds that leave so much of each view held out; the views have a norm of 10."""
    outcomes = [
        Outcome(MethodTrial("method", "fbp", 10 + n), "done", seconds,
                metrics={"residual_held_out": sum(left) ** 0.5 / 10}, squared_residuals=left)
        for n, (seconds, left) in enumerate(trials)
    ]  # fmt: skip
    return TrialTable("tradeoff", "", tuple(outcomes), "residual_held_out", machine(), {}, "", asks_costs=True)


def test_a_gain_within_the_scatter_of_the_views_is_none() -> None:
    """The third trial leaves 1 % less on average, but more of half of the views; the second leaves less of each."""
    slow, fast = [0.9, 1.1, 0.9, 1.1], [1.0, 1.0, 1.0, 1.02]
    table = _judged((1.0, [4.0, 4.1, 3.9, 4.0]), (2.0, fast), (9.0, [left * 0.99 for left in slow]))
    assert table.front == list(table.outcomes[:2])
    assert "fbp, 12 views has +0.07 dB, but the difference may be chance" in sentences(table)[-1]


def test_a_gain_in_every_view_is_one_however_much_views_differ() -> None:
    """The noise of a view is in both residuals: it does not hide a small difference in all views."""
    views = np.random.default_rng(0).uniform(1, 9, 16)
    table = _judged((1.0, (views + 0.05).tolist()), (2.0, views.tolist()))
    assert table.front == list(table.outcomes)
    assert table.chance(*table.outcomes) == LEAST_GAIN


def test_chance_is_that_of_repeated_noise() -> None:
    """Of two equal trials, 5 % seem to differ by more than chance."""
    rng, beyond = np.random.default_rng(1), 0
    for _ in range(300):
        first, second = rng.normal(5, 0.3, (2, 16))
        table = _judged((1.0, first.tolist()), (2.0, second.tolist()))
        one, other = table.outcomes
        beyond += abs(one.quality(table.by) - other.quality(table.by)) > table.chance(one, other)
    assert beyond / 300 == pytest.approx(0.06, abs=0.03)


# Few distinct values, so that ties happen; they differ by more than chance.
VALUES = st.one_of(st.integers(1, 9).map(float), st.just(math.nan), st.just(math.inf))
POINTS = st.lists(st.tuples(VALUES, VALUES), max_size=30)


def _front(points: list[tuple[float, float]]) -> list[int]:
    """Numbers of the points, of so many seconds and dB, that are on the front."""
    outcomes = [
        Outcome(MethodTrial("method", "fbp", n), "done", cost, metrics={"psnr": db})
        for n, (cost, db) in enumerate(points)
    ]
    table = TrialTable("tradeoff", "", tuple(outcomes), "psnr", {}, {}, "")
    return [outcome.trial.views for outcome in table.front]


def _finite(point: tuple[float, float]) -> bool:
    return math.isfinite(point[0]) and math.isfinite(point[1])


def _beats(a: tuple[float, float], b: tuple[float, float]) -> bool:
    return a[0] <= b[0] and a[1] >= b[1] and a != b


@given(POINTS)
def test_exactly_the_points_that_nothing_beats_are_kept(points: list[tuple[float, float]]) -> None:
    kept = _front(points)
    finite = [p for p in points if _finite(p)]
    unbeaten = {p for p in finite if not any(_beats(other, p) for other in finite)}
    assert len(kept) == len(set(kept)) == len(unbeaten)
    assert {points[i] for i in kept} == unbeaten
    for i in kept:  # of equal points the first
        assert points.index(points[i]) == i


METHODS = names_of_one_volume()
CHOICES = st.lists(st.sampled_from(METHODS), min_size=1, unique=True)
VARIED = {"views": set(), "steps": {"steps"}, "iterations": {"iterations"}}


@given(CHOICES, st.integers(2, 2000), st.sampled_from(["quick", "full"]))
def test_one_change_at_a_time_about_each_methods_baseline(methods: list[str], n_views: int, depth: str) -> None:
    trials = plan(methods, n_views, depth)  # type: ignore[arg-type]
    assert len(set(trials)) == len(trials)
    bases = {t.method: t for t in trials if t.group == "method"}
    assert list(bases) == methods == [t.method for t in trials[: len(methods)]]
    assert all(base.views == n_views for base in bases.values())
    for trial in trials[len(methods) :]:
        base = bases[trial.method]
        changed = {name for name, _ in trial.settings.items() ^ base.settings.items()}
        assert changed <= VARIED[trial.group]
        assert (trial.views != n_views) is (trial.group == "views")
        assert isinstance(trial.build(), by_name(trial.method))
        assert 2 <= trial.views <= n_views


@given(st.floats(0.5, 1e5))
def test_in_equal_time_each_method_comes_once_and_nothing_but_the_time_ends_it(seconds: float) -> None:
    trials = plan_in_equal_time(METHODS, 60, seconds)
    assert [trial.method for trial in trials] == list(METHODS)
    for trial in trials:
        method = trial.build()
        assert trial.seconds_asked == (seconds if method.fitted else None)
        for length in {"steps", "iterations"} & {f.name for f in fields(method)}:  # type: ignore[arg-type]
            if not method.ended_by(seconds):
                assert (getattr(method, length) or 0) < 1e3  # None: the data choose it
                continue
            assert getattr(method, length) > 1e5 and f"{seconds:g} s" in trial.label and length not in trial.label
        assert getattr(method, "seconds", seconds) == seconds


def test_quality_is_decibels_either_way() -> None:
    outcome = Outcome(MethodTrial("method", "fbp", 4), "done", 1.0, metrics={"psnr": 30.0, "residual_held_out": 0.1})
    assert outcome.quality("psnr") == 30
    assert outcome.quality("residual_held_out") == pytest.approx(20)
    assert math.isnan(Outcome(outcome.trial, "failed").quality("psnr"))
    assert math.isnan(replace(outcome, metrics={"residual_held_out": 0.0}).quality("residual_held_out"))


BASE = MethodTrial("method", "fbp", 10)
FIT = MethodTrial("method", "r2", 10, settings={"steps": 100})


def _table(*outcomes: Outcome, by: str = "psnr") -> TrialTable:
    command = "beamline tradeoff 'a <b>.h5'"
    return TrialTable(
        "tradeoff", "What accuracy costs", outcomes, by, machine(), {"file": "a <b>.h5"}, command, asks_costs=True
    )


def _done(trial: MethodTrial, seconds: float, psnr: float, memory: int | None = 10**8) -> Outcome:
    return Outcome(trial, "done", seconds, memory, {"psnr": psnr, "ssim3d": 0.5})


def test_each_further_decibel_has_its_price() -> None:
    worse = replace(FIT, group="steps", settings={**FIT.settings, "steps": 50})
    table = _table(_done(BASE, 2.0, 20.0), _done(FIT, 12.0, 24.0), _done(worse, 13.0, 23.0))
    assert sentences(table) == [
        "Best for its time: r2, 10 views, 100 steps: 24.00 dB in 12 s.",
        "Quality: PSNR (dB). Fastest: fbp, 10 views, 20.00 dB.",
        "+4.00 dB for 10 s more (2.5 s a dB): r2, 10 views, 100 steps.",
    ]
    near = _done(worse, 4.0, 23.6)
    pick = sentences(_table(_done(BASE, 2.0, 20.0), _done(FIT, 12.0, 24.0), near))[0]
    assert pick == "Best for its time: r2, 10 views, 50 steps: 23.60 dB in 4 s."
    assert sentences(_table())[-1] == "No trial has both a time and a quality."


def test_the_csv_holds_what_was_measured_and_nothing_where_nothing_was(tmp_path: Path) -> None:
    table = _table(_done(BASE, 2.0, math.inf), Outcome(FIT, "failed", message='no "room", said\nthe system'))
    write_table(tmp_path / "tradeoff.csv", table.records)
    first, second = csv.DictReader(io.StringIO((tmp_path / "tradeoff.csv").read_text(encoding="utf-8")))
    assert (first["seconds"], first["psnr"], first["ssim3d"], first["steps"]) == ("2.0", "", "0.5", "")
    assert (second["status"], second["seconds"], second["steps"]) == ("failed", "", "100")
    assert second["message"] == 'no "room", said\nthe system'


def test_the_page_shows_words_of_others_as_words_and_marks_the_front() -> None:
    page = to_html(_table(_done(BASE, 2.0, 20.0), Outcome(FIT, "failed", message="<script>")), [])
    assert "<script>" not in page and "&lt;script&gt;" in page
    assert "a <b>" not in page and "a &lt;b&gt;.h5" in page
    assert f"<strong>{BASE.label}</strong>" in page and f"<strong>{FIT.label}" not in page
    assert "1 of 2 trials" in page


def test_a_trial_far_below_the_best_is_drawn_at_the_lower_edge(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(module, "png", lambda figure: drawn.append(figure) or b"")
    outcomes = [
        Outcome(MethodTrial("method", method, 10), "done", 1.0 + at, 10**8, {"psnr": db})
        for at, (method, db) in enumerate((("fbp", 30.0), ("sirt", 25.0), ("cgls", 1.0)))
    ]
    module.quality_plot(TrialTable("tradeoff", "", tuple(outcomes), "psnr", {}, {}, "", asks_costs=True))
    points = {line.get_marker(): line.get_ydata().tolist() for line in drawn[0].axes[0].lines if line.get_ydata().size}
    assert points["v"] == [18.0] and {30.0, 25.0} <= {db for values in points.values() for db in values}
