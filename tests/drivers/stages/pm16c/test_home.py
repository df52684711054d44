"""PM16C-04XD driver: the search for the home switch, its end position, and disturbances."""

from __future__ import annotations

import math
from typing import Any

import pytest

from drivers.base.errors import DeviceError
from drivers.base.protocols import TriggerTrain
from drivers.testing.stages.bench import LONG, SPEED
from tests.drivers.pm16c_rig import Rig
from tests.messages import refused

SWITCH = 2500
"""Pulses since power-on: 10 degrees of the sample's true angle."""


@pytest.fixture
def rig() -> Rig:
    return Rig(home_at=SWITCH)


def test_the_reference_gets_its_count_wherever_the_counter_was(rig: Rig) -> None:
    """The switch is at 10 degrees true; the configuration calls it 30. The counter moves, the sample does not."""
    stage = rig.open(home=math.radians(30))
    stage.start_move(math.radians(4), SPEED)
    stage.wait(LONG)
    stage.start_home()
    assert math.degrees(stage.wait(LONG)) == pytest.approx(30.0)
    assert stage.to_counts(stage.position()) == 7500
    assert math.degrees(rig.line.angle_at(rig.clock.now())) == pytest.approx(10.0)
    stage.start_move(math.radians(31), SPEED)
    stage.wait(LONG)
    assert math.degrees(rig.line.angle_at(rig.clock.now())) == pytest.approx(11.0)


def test_triggers_after_a_search_come_at_the_new_counts(rig: Rig) -> None:
    bench = rig.bench(home=math.radians(30))
    bench.stage.start_home()
    bench.stage.wait(LONG)
    bench.stage.arm(bench.train(31.0, 1.0, 4))
    bench.go(40.0)
    assert [math.degrees(pulse.angle) for pulse in bench.pulses()] == pytest.approx([11.0, 12.0, 13.0, 14.0])


def test_a_second_search_finds_the_switch_at_the_count_that_the_first_gave_it(rig: Rig) -> None:
    stage = rig.open(home=math.radians(30))
    for _ in range(2):
        stage.start_home()
        stage.wait(LONG)
    assert rig.say("SHP?B") == "+0007500"


def test_a_search_from_the_switch_itself_is_over_at_once(rig: Rig) -> None:
    stage = rig.open()
    stage.start_move(math.radians(10), SPEED)
    stage.wait(LONG)
    before = rig.clock.now()
    stage.start_home()
    assert stage.wait(LONG) == 0.0
    assert rig.clock.now() - before < 0.1


def test_a_search_ends_an_armed_train(rig: Rig) -> None:
    bench = rig.bench()
    bench.stage.arm(TriggerTrain(1000, 100, 5))
    bench.stage.start_home()
    bench.stage.wait(LONG)
    bench.go(20.0)
    assert bench.pulses() == []


def test_the_speed_of_a_search_is_the_configured_one_or_a_tenth_of_the_fastest(rig: Rig) -> None:
    for settings, pps in (({"home_speed": math.radians(6)}, 1500), ({"home_speed": None}, 750)):
        stage = rig.open(**settings)
        stage.start_home()
        assert int(rig.say("SPDH?B")) == pps
        stage.abort()
        stage.close()


@pytest.mark.parametrize(
    "settings", [{"home_speed": 100.0}, {"home_speed": 0.0}, {"home": math.nan}, {"home": -math.inf}]
)
def test_settings_of_a_search_that_cannot_be_are_refused(rig: Rig, settings: dict[str, Any]) -> None:
    with refused(ValueError):
        rig.open(**settings)
    rig.open().close()


# what ends a search


def test_a_stage_whose_switch_is_not_found_says_so() -> None:
    """An interlock stops it at 1000 counts, before the switch."""
    rig = Rig(home_at=SWITCH, stall_at=1000)
    stage = rig.open()
    stage.start_home()
    for _ in range(2):
        with refused(DeviceError):
            stage.wait(LONG)


def test_a_switch_that_is_not_plugged_in_is_named_at_once() -> None:
    stage = Rig(home_at=None).open()
    with refused(DeviceError):
        stage.start_home()
    assert not stage.moving()


def test_a_stop_button_after_the_switch_was_found_is_no_less_a_stop(rig: Rig) -> None:
    """Between the switch and where the search stands: the way back must not begin."""
    stage = rig.open()
    stage.start_home()
    while rig.say("SHP?B") == "NO H.P":
        rig.clock.sleep(0.01)
    rig.say("ASSTP")
    with refused(DeviceError):
        stage.wait(LONG)
    where = stage.to_counts(stage.position())
    rig.clock.sleep(10.0)
    assert stage.to_counts(stage.position()) == where > SWITCH


def test_a_stop_that_crosses_the_way_back_to_the_switch_stops_it(rig: Rig) -> None:
    """The search has passed the switch; `wait` sends GTHP, and the stop was sent just before."""
    stage = rig.open()
    stage.start_home()
    rig.clock.sleep(10.0)
    listen = rig.controller.receive

    def stop_before_going_home(data: bytes) -> None:
        if data.startswith(b"GTHP"):
            stage._search.cancel()  # type: ignore[union-attr]  # what another thread's stop does first
            listen(b"SSTPB\r\n")
        listen(data)

    rig.controller.receive = stop_before_going_home
    with refused(DeviceError):
        stage.wait(LONG)
    assert not stage.moving()
    assert stage.to_counts(stage.position()) > SWITCH


# what gets lost
