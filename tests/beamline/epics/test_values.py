"""Values of a run: what its log says, event by event."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path

import pytest

from beamline.core.events import BeamRead, Event, FrameFlagged, FrameStored, RunStarted, ScanDone, StateEntered, Warned
from beamline.epics.ioc import RunValues

STARTED = RunStarted(Path("runs/a"), Path("runs/a/scan.h5"), "cathode", 20, 60.0, 1000, [])
FRAME = FrameStored(5, 20, "projection", 2.5, 40.0, 6.0, 812.0)


def _after(*events: Event) -> RunValues:
    return RunValues().after(replace(event, time=1.0).to_json() for event in events)


def test_names_are_unique_and_said() -> None:
    named = [each.metadata["pv"] for each in fields(RunValues)]
    assert len(set(named)) == len(named) and all(each.metadata["about"] for each in fields(RunValues))


def test_every_kind_of_event_sets_its_values() -> None:
    now = _after(STARTED, StateEntered("acquiring", "first pass"), FRAME, BeamRead(299.5, "mA", 1.0))
    assert (now.sample, now.planned, now.state, now.message) == ("cathode", 20, "acquiring", "first pass")
    assert (now.exposed, now.rate, now.data_rate, now.time_left, now.mean, now.beam) == (5, 2.5, 40, 6, 812, 299.5)


def test_a_state_of_the_live_volume_is_not_that_of_the_scan() -> None:
    assert _after(StateEntered("acquiring", ""), StateEntered("finishing", "", source="recon")).state == "acquiring"


@pytest.mark.parametrize(("level", "warnings", "alarms"), [("warn", 1, 0), ("alarm", 0, 1)])
def test_flags_are_counted_by_level(level: str, warnings: int, alarms: int) -> None:
    now = _after(FrameFlagged("beam", level, 12, 0.5, 0.1, "look at the shutter", None, None))
    assert (now.warnings, now.alarms) == (warnings, alarms)
    assert now.last_flag == f"beam {level}, frame 12: look at the shutter"


def test_the_end_leaves_no_rate() -> None:
    done = ScanDone(Path("a"), 20, [], {}, 0, 0, 0, [], 60.0, 1000, None, "complete")
    now = _after(STARTED, FRAME, done)
    assert math.isnan(now.rate) and now.time_left == 0


def test_the_file_says_what_is_stored() -> None:
    seen = {"frames": 15, "status": "running", "free": 3e9, "age_s": 0.5}
    now = _after(STARTED, Warned("the beam is low")).with_file(seen)
    assert (now.stored, now.percent, now.free, now.age, now.message) == (15, 75.0, 3.0, 0.5, "the beam is low")
