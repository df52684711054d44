"""Values of a run are derived from its log, event by event."""

from dataclasses import replace
from pathlib import Path

import pytest

from beamline.core.errors import ConfigError
from beamline.core.events import (
    BeamRead,
    Event,
    Failed,
    FrameFlagged,
    FrameStored,
    NextChosen,
    PassEnded,
    RunStarted,
    StateEntered,
    Warned,
)
from beamline.core.flag import Flag, Level
from beamline.page.followed_run import RunValues, Severity, Stamp, StampedValues, choice_of
from beamline.plan.passes import Choice
from tests.beamline.pass_options import UNKNOWN, option
from tests.messages import refused

STARTED = RunStarted(Path("runs/a"), Path("runs/a/scan.h5"), "cathode", 20, 60.0, 1000, [])
FRAME = FrameStored(5, 20, "projection", 2.5, 40.0, 6.0, 812.0)


BEGAN = 100.0  # s


def _stamped(*events: Event) -> StampedValues:
    """The values after events that are 1 s apart."""
    timed = (replace(event, time=1000.0 + number) for number, event in enumerate(events))
    return StampedValues(RunValues(), BEGAN).after(event.to_json() for event in timed)


def _after(*events: Event) -> RunValues:
    return _stamped(*events).values


def test_every_kind_of_event_sets_its_values() -> None:
    now = _after(STARTED, StateEntered("acquiring", "first pass"), FRAME, BeamRead(299.5, "mA", 1.0))
    assert (now.sample, now.planned, now.state, now.message) == ("cathode", 20, "acquiring", "first pass")
    assert (now.exposed, now.rate, now.data_rate, now.time_left, now.mean, now.beam) == (5, 2.5, 40, 6, 812, 299.5)


def test_a_state_or_failure_of_the_live_volume_is_not_the_scans() -> None:
    events = StateEntered("acquiring", "x"), StateEntered("finishing", "", source="recon")
    failed = replace(Failed("no memory", 5, None), time=1002.0).to_json().replace("{", '{"source": "recon", ', 1)
    now = _stamped(*events).after([failed]).values
    assert (now.state, now.message) == ("acquiring", "x")


@pytest.mark.parametrize(("level", "warnings", "alarms"), [("info", 0, 0), ("warn", 1, 0), ("alarm", 0, 1)])
def test_flags_are_counted_by_level(level: str, warnings: int, alarms: int) -> None:
    now = _after(FrameFlagged(Flag("beam", Level(level), 12, 0.5, 0.1, "look at the shutter")))
    assert (now.warnings, now.alarms) == (warnings, alarms)
    assert now.last_flag == f"beam {level}, frame 12: look at the shutter"


def test_flags_are_counted_by_check_until_another_run_begins() -> None:
    flags = [FrameFlagged(Flag(name, Level("warn"), 1, 0.5, 0.1, "")) for name in ("beam", "motion", "beam")]
    now = _after(STARTED, *flags)
    assert dict(zip(now.flag_names, now.flag_counts, strict=True)) == {"beam": 2, "motion": 1}
    assert _after(STARTED, *flags, STARTED).flag_names == ()


NEXT, ENOUGH = option("next", 0.8, (0.6, 1.0), 90, 95.5, 0.125, 2e9), option("enough", None, UNKNOWN)
ASKED = PassEnded(3, 270, [NEXT, ENOUGH], "next", 30.0)
CHOSEN = NextChosen(3, 270, "enough", "operator", "as asked", [NEXT, ENOUGH], 0.8, 0.7)


def test_what_can_be_measured_next_stands_in_lists_until_it_is_chosen() -> None:
    now = _after(STARTED, ASKED)
    assert (now.pass_number, now.options, now.recommended, now.wait) == (3, ("next", "enough"), "next", 30.0)
    lists = (now.option_gains, now.option_lows, now.option_highs, now.option_times, now.option_doses, now.option_sizes)
    assert [each[0] for each in lists] == [0.8, 0.6, 1.0, 95.5, 12.5, 2.0]
    assert [each[1] == each[1] for each in lists] == [False] * 3 + [True] * 3  # not known
    assert (now.decision, now.measured_gain == now.measured_gain) == ("", False)
    chosen = _after(STARTED, ASKED, CHOSEN)
    assert (chosen.wait, chosen.options, chosen.predicted_gain, chosen.measured_gain) == (
        0.0,
        now.options,
        0.8,
        0.7,
    )
    assert chosen.decision == "enough, by the operator: as asked"


def test_a_choice_is_one_of_the_options() -> None:
    assert choice_of(_after(STARTED, ASKED), "enough") is Choice.ENOUGH
    with refused(ConfigError):
        choice_of(_after(STARTED, ASKED), "offset")
    with refused(ConfigError):
        choice_of(_after(STARTED), "next")
    with refused(ConfigError):  # of a log of another version
        choice_of(_after(STARTED, replace(ASKED, options=[{**NEXT, "choice": "later"}])), "later")


def test_nobody_is_asked_by_a_scan_that_ends() -> None:
    assert _after(STARTED, ASKED, StateEntered("paused", "")).wait == 30.0
    assert _after(STARTED, ASKED, StateEntered("finishing", "")).wait == 0.0
    died = _stamped(STARTED, ASKED).with_file({**SEEN, "status": "died", "next": "resume it"}, 0.0, 1300.0)
    assert died.values.wait == 0.0


SEEN = {"frames": 15, "status": "running", "free": 3e9, "age_s": 0.5, "newest": 1234.5, "next": ""}


def test_each_value_has_the_time_of_what_set_it() -> None:
    """Not that of the request: of the event, of the newest frame, or of the look at the disk."""
    now = _stamped(STARTED, StateEntered("acquiring", ""), FRAME).with_file(SEEN, 12.5, 1300.0)
    expected = {
        "planned": 1000.0, "state": 1001.0, "rate": 1002.0, "mean": 1002.0, "stored": 1234.5, "percent": 1234.5,
        "angle": 1234.5, "free": 1300.0, "beam": BEGAN,
    }  # fmt: skip
    assert {name: now.stamp(name).time for name in expected} == expected


@pytest.mark.parametrize(
    ("event", "name", "severity"),
    [
        (StateEntered("acquiring", ""), "state", Severity.NO_ALARM),
        (StateEntered("paused", "no beam"), "state", Severity.MINOR),
        (StateEntered("asking", ""), "state", Severity.MINOR),
        (StateEntered("stopped", ""), "state", Severity.MINOR),
        (StateEntered("aborted", ""), "state", Severity.MAJOR),
        (StateEntered("failed", ""), "state", Severity.MAJOR),
        (Warned("the beam is low"), "message", Severity.MINOR),
        (Failed("the stage does not answer", 3, Path("runs/a")), "message", Severity.MAJOR),
        (FrameFlagged(Flag("beam", Level("info"), 1, 0.5, 0.1, "")), "last_flag", Severity.NO_ALARM),
        (FrameFlagged(Flag("beam", Level("warn"), 1, 0.5, 0.1, "")), "warnings", Severity.MINOR),
        (FrameFlagged(Flag("beam", Level("alarm"), 1, 0.5, 0.1, "")), "alarms", Severity.MAJOR),
        (FRAME, "rate", Severity.NO_ALARM),
    ],
)
def test_severities(event: Event, name: str, severity: Severity) -> None:
    assert _stamped(STARTED, event).stamp(name).severity is severity


def test_a_scan_that_died_is_an_alarm_and_says_what_can_be_done() -> None:
    now = _stamped(STARTED, StateEntered("acquiring", ""))
    died = now.with_file({**SEEN, "status": "died", "next": "resume it"}, 0.0, 1300.0)
    assert (died.values.state, died.values.message) == ("died", "resume it")
    assert died.stamp("state") == Stamp(1300.0, Severity.MAJOR, "resume it")
    again = died.with_file({**SEEN, "status": "died", "next": "resume it"}, 0.0, 1400.0)
    assert again.stamp("state").time == 1300.0


def test_what_cannot_be_read_any_more_keeps_its_time_and_is_invalid() -> None:
    now = replace(_stamped(STARTED, FRAME).with_file(SEEN, 12.5, 1300.0), unread="the disk is gone")
    assert now.values.stored == 15
    assert now.stamp("stored") == Stamp(1234.5, Severity.INVALID, "the disk is gone")
    assert now.with_file(SEEN, 12.5, 1400.0).stamp("stored").severity is Severity.NO_ALARM
