"""PM16C-04XD driver: specific behaviour of this controller; common behaviour is tested in conformance."""

from __future__ import annotations

import math

import pytest

from drivers.base.errors import DeviceError, DeviceRefused
from drivers.base.protocols import RotationStage, TriggerTrain
from drivers.stages.pm16c.settings import RATES, steepest_code
from drivers.testing.stages.bench import LONG, SPEED
from simulators.wires.pm16c.box import Pm16cError
from tests.drivers.pm16c_rig import Rig
from tests.messages import refused


@pytest.fixture
def rig() -> Rig:
    return Rig()


# opening and closing


def test_it_is_a_rotation_stage_and_says_what_it_found(rig: Rig) -> None:
    stage: RotationStage = rig.open()
    described = stage.describe()
    assert (described["firmware"], described["channel"]) == ("1.50 17-04-01 PM16C-04XDL-SIMULATED", 11)


def test_opening_takes_remote_and_position_controller_a_and_closing_gives_the_panel_back(rig: Rig) -> None:
    stage = rig.open()
    assert rig.say("SETCH?") == "B123"
    stage.close()
    assert rig.say("STQ?") == "L4"


def test_a_controller_found_in_remote_is_left_there(rig: Rig) -> None:
    rig.say("REM")
    rig.open().close()
    assert rig.say("STQ?") == "R4"


def test_remote_that_is_not_granted_is_named(rig: Rig) -> None:
    """Another axis moves, and the panel was switched to LOCAL after it started: the controller ignores REM."""
    rig.say("REM", "ABS3+50000")
    rig.controller.box.remote = False
    with refused(DeviceRefused):
        rig.open()


@pytest.mark.parametrize("channel", [-1, 16])
def test_a_channel_that_does_not_exist_is_refused(rig: Rig, channel: int) -> None:
    with refused(ValueError):
        rig.open(channel=channel)


def test_limits_of_the_controller_stay_as_they_were(rig: Rig) -> None:
    rig.say("REM", "FLB+50000", "BLB-2000", "SETLSB10000000")
    rig.open().close()
    assert (rig.say("FL?B"), rig.say("SETLS?B")) == ("+0050000", "10000000")


# acceleration


def test_acceleration_codes_are_the_published_ones() -> None:
    published = {0: 1000, 1: 910, 23: 110, 24: 100, 36: 33, 48: 10, 72: 1.0, 95: 0.11, 96: 0.10, 114: 0.018, 115: 0.016}
    assert len(RATES) == 116
    assert {code: RATES[code] for code in published} == pytest.approx(published)


@pytest.mark.parametrize("code", [1, 17, 60, 115])
def test_the_steepest_code_not_above_an_acceleration(code: int) -> None:
    acceleration = 1e6 / RATES[code]
    assert [steepest_code(acceleration * factor) for factor in (0.999, 1.0, 1.001)] == [code - 1, code, code]


def test_an_acceleration_gentler_than_any_is_refused(rig: Rig) -> None:
    with refused(ValueError):
        rig.open(acceleration=1e-6)


# triggers of this controller


def test_pulses_are_the_widest_that_the_interval_allows(rig: Rig) -> None:
    """At 30 deg/s = 7500 pulses/s an interval of 15 lasts 2 ms, room for 1 ms pulses; 14 does not."""
    stage = rig.open()
    for interval, mode in ((15, "5"), (14, "4"), (1, "3")):
        stage.arm(TriggerTrain(100, interval, 3))
        assert rig.say("TMGM?B") == mode


def test_a_chosen_width_is_the_one_set_and_a_single_pulse_may_be_wide(rig: Rig) -> None:
    stage = rig.open(pulse_width=1e-3)
    assert stage.describe()["pulse_width_s"] == 1e-3
    with refused(DeviceRefused):
        stage.arm(TriggerTrain(100, 14, 3))
    for train in (TriggerTrain(100, 15, 3), TriggerTrain(100, 1, 1)):
        stage.arm(train)
        assert rig.say("TMGM?B") == "5"


def test_what_cannot_be_set_is_refused_before_anything_is_sent(rig: Rig) -> None:
    for settings in ({"pulse_width": 5e-3}, {"pulse_width": math.nan}, {"active_high": False}):
        with refused(ValueError):
            rig.open(**settings)
    assert rig.controller.queries == 0


def test_a_setting_that_another_program_took_back_is_noticed(rig: Rig) -> None:
    stage = rig.open()
    rig.say("LOC")
    with refused(DeviceRefused):
        stage.arm(TriggerTrain(100, 10, 3))
    with refused(DeviceRefused):
        stage.start_move(0.1, SPEED)
    assert not stage.moving()


# what stops a move


def test_a_limit_set_later_in_the_controller_is_named(rig: Rig) -> None:
    stage = rig.open()
    rig.say("FLB+5000", "SETLSB10000000")
    stage.start_move(math.radians(30), SPEED)
    with refused(DeviceError):
        stage.wait(LONG)
    with refused(DeviceError):
        stage.start_move(math.radians(30), SPEED)


def test_a_fifth_motor_cannot_start_and_the_controllers_words_are_given(rig: Rig) -> None:
    stage = rig.open()
    rig.say("ABS0+90000", "ABS1+90000", "ABS2+90000", "ABS3+90000")
    with refused(DeviceError):
        stage.start_move(math.radians(30), SPEED)
    assert stage.position() == 0.0


@pytest.mark.parametrize(
    ("flag", "words"),
    [(2, "the pulse chip was busy"), (4, "an impossible position was rejected"), (6, "busy and a move to an")],
)
def test_error_flags_of_the_past_are_in_the_description(flag: int, words: str) -> None:
    rig = Rig()
    rig.controller.box.errors = Pm16cError(flag)
    assert words in str(rig.open().describe()["found_at_opening"])
    assert rig.controller.box.errors == 0


def test_our_own_empty_line_is_no_error_of_the_past() -> None:
    assert "found_at_opening" not in Rig().open().describe()
