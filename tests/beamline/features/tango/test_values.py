"""Attributes of a run: what its log and its file say, with the time of each and how sure it is."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path

import pytest

from beamline.core.events import (
    BeamRead,
    Event,
    Failed,
    FrameFlagged,
    FrameStored,
    RunStarted,
    ScanDone,
    StateEntered,
)
from beamline.core.flag import Flag, Level
from beamline.core.run_result import RunResult
from beamline.features.tango.values import ScanAttributes, TimedAttributes

STARTED = RunStarted(Path("runs/a"), Path("runs/a/scan.h5"), "cathode", 20, 60.0, 1000, [])
FRAME = FrameStored(5, 20, "projection", 2.5, 40.0, 6.0, 812.0)
SEEN = {"frames": 15, "status": "running", "free": 3e9, "age_s": 0.5, "newest": 1234.5, "next": ""}
BEGAN = 100.0  # s


def _after(*events: Event) -> TimedAttributes:
    """The values after events that are 1 s apart."""
    timed = (replace(event, time=1000.0 + number) for number, event in enumerate(events))
    return TimedAttributes(ScanAttributes(), BEGAN).after(event.to_json() for event in timed)


def _flagged(check: str, level: str) -> Event:
    return FrameFlagged(Flag(check, Level(level), 12, 0.5, 0.1, "look at the shutter"))


def test_names_are_unique_and_each_has_a_meaning() -> None:
    named = [each.metadata["name"] for each in fields(ScanAttributes)]
    assert len(set(named)) == len(named) and all(each.metadata["about"] for each in fields(ScanAttributes))


def test_each_kind_of_event_sets_its_values_with_its_time() -> None:
    timed = _after(STARTED, StateEntered("acquiring", "first pass"), FRAME, BeamRead(299.5, "mA", 1.0))
    now = timed.values
    assert (now.sample, now.planned, now.state, now.message) == ("cathode", 20, "acquiring", "first pass")
    assert (now.exposed, now.rate, now.time_left, now.mean, now.beam) == (5, 2.5, 6, 812, 299.5)
    assert [timed.time(name) for name in ("planned", "state", "rate", "beam", "views")] == [1000, 1001, 1002, 1003, 100]


def test_flags_are_counted_by_check_and_by_level() -> None:
    events = _flagged("beam", "warn"), _flagged("motion", "alarm"), _flagged("beam", "info"), _flagged("beam", "warn")
    timed = _after(STARTED, *events)
    now = timed.values
    assert dict(zip(now.flag_names, now.flag_counts, strict=True)) == {"beam": 3, "motion": 1}
    assert (now.warnings, now.alarms, now.last_flag) == (2, 1, "beam warn, frame 12: look at the shutter")
    assert (timed.quality("warnings"), timed.quality("alarms")) == ("ATTR_WARNING", "ATTR_ALARM")
    assert timed.after([replace(STARTED, time=2000.0).to_json()]).values.flag_names == ()


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        ("idle", "ON"), ("preparing", "INIT"), ("darks", "RUNNING"), ("flats", "RUNNING"), ("taxi", "RUNNING"),
        ("acquiring", "RUNNING"), ("paused", "STANDBY"), ("finishing", "RUNNING"), ("done", "ON"), ("stopped", "ON"),
        ("aborted", "FAULT"), ("failed", "FAULT"), ("died", "FAULT"),
    ],
)  # fmt: skip
def test_states_of_the_device(state: str, expected: str) -> None:
    assert _after(StateEntered(state, "")).values.device_state == expected


def test_an_alarm_of_the_monitor_is_one_of_the_device_while_the_scan_runs() -> None:
    assert _after(StateEntered("acquiring", ""), _flagged("beam", "alarm")).values.device_state == "ALARM"
    assert _after(_flagged("beam", "alarm"), StateEntered("done", "")).values.device_state == "ON"


def test_a_state_or_failure_of_the_live_volume_is_not_the_scans() -> None:
    events = StateEntered("acquiring", "x"), StateEntered("finishing", "", source="recon")
    failed = replace(Failed("no memory", 5, None), time=1002.0).to_json().replace("{", '{"source": "recon", ', 1)
    now = _after(*events).after([failed]).values
    assert (now.state, now.message) == ("acquiring", "x")


def test_the_end_leaves_no_rate() -> None:
    now = _after(STARTED, FRAME, ScanDone(RunResult(Path("a"), 20, [], {}, 0, 0, 0, [], 60.0, 1000, None, "complete")))
    assert math.isnan(now.values.rate) and now.values.time_left == 0


def test_the_file_says_what_is_stored() -> None:
    timed = _after(STARTED, StateEntered("acquiring", "")).with_file(SEEN, 12.5, 1300.0)
    now = timed.values
    assert (now.stored, now.percent, now.angle, now.free, now.age) == (15, 75.0, 12.5, 3.0, 0.5)
    assert [timed.time(name) for name in ("stored", "angle", "free", "state")] == [1234.5, 1234.5, 1300.0, 1001.0]


def test_a_scan_that_died_says_what_can_be_done_and_since_when() -> None:
    died = {**SEEN, "status": "died", "next": "resume it"}
    once = _after(STARTED, StateEntered("acquiring", "")).with_file(died, 0.0, 1300.0)
    again = once.with_file(died, 0.0, 1400.0)
    assert (again.values.state, again.values.message, again.time("state")) == ("died", "resume it", 1300.0)


@pytest.mark.parametrize("name", ["planned", "rate", "beam", "angle"])
def test_a_value_that_is_not_known_is_invalid(name: str) -> None:
    assert TimedAttributes(ScanAttributes(), BEGAN).quality(name) == "ATTR_INVALID"


def test_what_cannot_be_read_any_more_is_invalid() -> None:
    timed = replace(_after(STARTED, FRAME).with_file(SEEN, 1.0, 1300.0), unread=True)
    assert [timed.quality(name) for name in ("stored", "angle", "rate")] == ["ATTR_INVALID"] * 2 + ["ATTR_VALID"]
    assert timed.with_file(SEEN, 1.0, 1400.0).quality("stored") == "ATTR_VALID"
