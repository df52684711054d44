"""The front of a trade-off's table: what no other trial beats, chance in the costs aside."""

from __future__ import annotations

from dataclasses import replace

from beamline.core.machine import machine
from beamline.tradeoff.table import MEMORY, TIME, TrialTable
from beamline.tradeoff.trials import Outcome, Trial


def test_noise_in_a_cost_puts_no_trial_on_the_front() -> None:
    trial = Trial("method", "fbp", 10)
    outcomes = [
        Outcome(replace(trial, views=views), "done", seconds, memory, {"psnr": psnr})
        for views, seconds, memory, psnr in ((10, 1.0, 400_000_000, 20.0), (20, 2.0, 400_100_000, 25.0))
    ]
    table = TrialTable(tuple(outcomes), "psnr", "mm", machine(), {}, "")
    assert table.front(TIME) == [0, 1]
    assert table.front(MEMORY) == [1]
