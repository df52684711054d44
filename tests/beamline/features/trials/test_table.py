"""The front of a trade-off's table: what no other trial beats, chance in the costs aside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from beamline.core.machine import machine
from beamline.features.trials.front import conclusions
from beamline.features.trials.table import LEAST_GAIN, MEMORY, TIME, TrialTable
from beamline.features.trials.trial import Outcome, Trial


def test_noise_in_a_cost_puts_no_trial_on_the_front() -> None:
    trial = Trial("method", "fbp", 10)
    outcomes = [
        Outcome(replace(trial, views=views), "done", seconds, memory, {"psnr": psnr})
        for views, seconds, memory, psnr in ((10, 1.0, 400_000_000, 20.0), (20, 2.0, 400_100_000, 25.0))
    ]
    table = TrialTable(tuple(outcomes), "psnr", "mm", machine(), {}, "")
    assert table.front(TIME) == [0, 1]
    assert table.front(MEMORY) == [1]


def _judged(*trials: tuple[float, list[float]]) -> TrialTable:
    """Trials of so many seconds that leave so much of each view held out; the views have a norm of 10."""
    outcomes = [
        Outcome(Trial("method", "fbp", 10 + n), "done", seconds, metrics={"residual_held_out": sum(left) ** 0.5 / 10},
                squared_residuals=left)
        for n, (seconds, left) in enumerate(trials)
    ]  # fmt: skip
    return TrialTable(tuple(outcomes), "residual_held_out", "mm", machine(), {}, "")


def test_a_gain_within_the_scatter_of_the_views_is_none() -> None:
    """The third trial leaves 1 % less on average, but more of half of the views; the second leaves less of each."""
    slow, fast = [0.9, 1.1, 0.9, 1.1], [1.0, 1.0, 1.0, 1.02]
    table = _judged((1.0, [4.0, 4.1, 3.9, 4.0]), (2.0, fast), (9.0, [left * 0.99 for left in slow]))
    assert table.front(TIME) == [0, 1]
    assert conclusions(table)[-1].startswith(
        "There it ends: the best figure, +0.07 dB for 7 s more (fbp, 12 views), is"
    )


def test_a_gain_in_every_view_is_one_however_much_views_differ() -> None:
    """The noise of a view is in both residuals: it does not hide a small difference in all views."""
    views = np.random.default_rng(0).uniform(1, 9, 16)
    table = _judged((1.0, (views + 0.05).tolist()), (2.0, views.tolist()))
    assert table.front(TIME) == [0, 1]
    assert table.chance(0, 1) == LEAST_GAIN


def test_chance_is_that_of_repeated_noise() -> None:
    """Of two equal trials, 5 % seem to differ by more than chance."""
    rng, beyond = np.random.default_rng(1), 0
    for _ in range(300):
        first, second = rng.normal(5, 0.3, (2, 16))
        table = _judged((1.0, first.tolist()), (2.0, second.tolist()))
        beyond += abs(np.diff(table.qualities)[0]) > table.chance(0, 1)
    assert beyond / 300 == pytest.approx(0.06, abs=0.03)
