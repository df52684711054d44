"""Progress events: the speed of this fit from any first step, and the time left by plan or by clock."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from beamline.core.events import Event
from beamline.reconstruct.job import progress_events
from drivers.base.clock import SystemClock
from recon.base.method import SWEEPS_OF_TRIALS, Progress


def _told(points: Sequence[tuple[int, float]], steps: int, seconds: float | None = None) -> list[dict[str, Any]]:
    """What is said of a fit at each (step, s)."""
    events: list[Event] = []
    listen = progress_events(events.append, SystemClock(), seconds)
    for step, at in points:
        listen(Progress(step, steps, at, 0.1, 0.1, 50, 12))
    return [dict(event.data) for event in events]


@pytest.mark.parametrize("first", [1, 1001])
def test_a_fit_taken_up_again_is_as_fast_as_it_is_now(first: int) -> None:
    begin, later = _told([(first, 2.0), (first + 100, 7.0)], first + 300)
    assert (begin["per_s"], begin["eta_s"]) == (None, None)
    assert later["per_s"] == pytest.approx(20)
    assert later["eta_s"] == pytest.approx(10)
    assert later["step"] == first + 100 and later["stage"] == "recon"


def test_each_part_of_the_work_has_its_own_time_left() -> None:
    """Trials take longest as a rule; they may end early, which their unit says."""
    events: list[Event] = []
    listen = progress_events(events.append, SystemClock())
    for step, unit in ((1, ""), (50, "steps of the trial of r2"), (60, f"{SWEEPS_OF_TRIALS} at most"), (90, "")):
        listen(Progress(step, 100, float(step), 0.1, 0.1, 50, 12, unit=unit))
    assert [event.data["eta_s"] for event in events] == [None, 50.0, 40.0, 10.0]


def test_a_time_tells_the_end_where_no_steps_are_planned() -> None:
    told = _told([(1, 1.0), (50, 4.0), (900, 50.0)], 0, seconds=30.0)
    assert [data["eta_s"] for data in told] == [30.0, 27.0, 0.0]
