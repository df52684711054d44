"""Phases: their durations always add up to the time since the start."""

import pytest

from beamline.core.durations import Phases
from beamline.core.events import Event
from tests.clock import SteppedClock


def test_the_seconds_of_phases_add_up_to_the_time() -> None:
    clock, said = SteppedClock(100.0), list[Event]()
    phases = Phases(said.append, clock)
    for name, seconds in (("reading", 3.0), ("axis", 0.25), ("reading", 2.0)):
        phases.enter(name)
        clock.time += seconds
    phases.end()
    clock.time += 7
    phases.end()
    assert phases.seconds == {"reading": 5.0, "axis": 0.25}
    assert [event.data["phase"] for event in said] == ["reading", "axis", "reading"]


def test_a_phase_says_how_far_it_is_at_most_a_few_times_a_second() -> None:
    clock, said = SteppedClock(100.0), list[Event]()
    phases = Phases(said.append, clock)
    phases.enter("reading")
    for n in range(1, 101):
        clock.time += 0.05
        phases.progress(n, 100)
    assert 20 <= len(said) <= 35
    last = said[-1].data
    assert (last["n"], last["of"], last["eta_s"]) == (100, 100, 0.0)
    assert last["per_s"] == pytest.approx(20)
    assert last["counted"] == "views"
