"""Series: points in order, progress events, and an early end that keeps the points so far."""

from __future__ import annotations

import numpy as np

from beamline.core.events import Event
from beamline.features.xafs.contrast import ContrastRegions
from beamline.features.xafs.series import Series, run_series
from drivers.base.clock import SystemClock

REGIONS = ContrastRegions(np.ones((4, 5), dtype=np.bool_))
FRAMES = [(8.0 + 0.1 * k, np.full((4, 5), float(k))) for k in range(6)]


def test_a_series_becomes_a_curve_and_says_how_far_it_is() -> None:
    events: list[Event] = []
    run = run_series(Series("it", 6, reversed(FRAMES), REGIONS), events.append, SystemClock(), lambda: False)
    assert not run.stopped
    np.testing.assert_allclose(run.curve.energies, 8.0 + 0.1 * np.arange(6))
    np.testing.assert_array_equal(run.curve.absorption, np.arange(6.0))
    assert (events[-1].event, events[-1].data["stage"], events[-1].data["n"], events[-1].data["of"]) == (
        "progress", "xafs", 6, 6,
    )  # fmt: skip


def test_an_early_end_keeps_the_energies_so_far() -> None:
    asked = iter([False, False, True])
    run = run_series(Series("it", 6, iter(FRAMES), REGIONS), lambda event: None, SystemClock(), lambda: next(asked))
    assert run.stopped and run.curve.energies.size == 3


def test_a_stop_at_the_last_energy_cuts_nothing() -> None:
    run = run_series(Series("it", 1, iter(FRAMES[:1]), REGIONS), lambda event: None, SystemClock(), lambda: True)
    assert not run.stopped and run.curve.energies.size == 1
