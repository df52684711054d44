"""Zaber pulse trains: the triggers they use, and the pulses from any position with any firmware."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.base.errors import DeviceError, DeviceRefused
from drivers.base.protocols import TriggerTrain
from drivers.stages.zaber.settings import ZaberSettings, set_up
from drivers.testing.stages.bench import LONG, SPEED, StageBench
from tests.drivers.zaber_rig import Rig
from tests.messages import refused


def counts_of(bench: StageBench) -> list[int]:
    return [bench.stage.to_counts(pulse.angle) for pulse in bench.pulses()]


def points(train: TriggerTrain) -> list[int]:
    return list(range(train.start, train.end + (1 if train.interval > 0 else -1), train.interval))


# what is sent


USUAL = ZaberSettings(counts_per_turn=360_000, max_speed=1.0, acceleration=1.0)


def test_the_starter_stands_one_step_before_and_enables_the_repeater() -> None:
    assert set_up(replace(USUAL, output=3), TriggerTrain(5000, 200, 37), counts=0) == (
        (
            "trigger 1 disable",
            "trigger 2 disable",
            "io set do 3 0",
            "trigger 2 when 1 dist 200",
            "trigger 2 action a io set do 3 1 schedule 1 0",
            "trigger 2 action b none",
            "trigger 1 when 1 pos >= 4800",
            "trigger 1 action a none",
            "trigger 1 action b trigger 2 enable 37",
            "trigger 1 enable 1",
        ),
        0,
    )


def test_within_the_last_step_the_starter_gives_the_first_pulse() -> None:
    settings = replace(USUAL, toggle=True, measured=True, starter=4, repeater=6, axis=2)
    commands, _ = set_up(settings, TriggerTrain(-500, -200, 3), counts=-450)
    assert commands[3:] == (
        "trigger 6 when 2 encoder dist 100",
        "trigger 6 action a io set do 1 t",
        "trigger 6 action b none",
        "trigger 4 when 2 encoder.pos <= -500",
        "trigger 4 action a io set do 1 t",
        "trigger 4 action b trigger 6 enable 5",
        "trigger 4 enable 1",
    )


def test_an_unchained_train_is_armed_one_step_before_its_first_pulse() -> None:
    commands, stand = set_up(replace(USUAL, chained=False), TriggerTrain(5000, 200, 37), counts=4900)
    assert (commands[-2:], stand) == (("trigger 2 action b none", "trigger 2 enable 37"), 4800)


@pytest.mark.parametrize(
    "wrong",
    [
        {"pulse_width": 0.0},
        {"pulse_width": 0.0015},
        {"pulse_width": math.nan},
        {"starter": 2},
        {"chained": False, "fires_when_enabled": True},
        {"toggle": True, "pulse_width": 4e-3},
    ],
)
def test_settings_that_cannot_be_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        replace(USUAL, **wrong)


def test_how_far_pulses_are_apart_at_full_speed() -> None:
    slow = replace(USUAL, shortest=2.5e-3)
    spaced = {
        "usual": USUAL,
        "slow": slow,
        "wide": replace(slow, pulse_width=4e-3),
        "toggled": replace(slow, toggle=True),
    }
    assert {name: settings.limits().pulse_spacing for name, settings in spaced.items()} == {
        "usual": 2e-3,
        "slow": 2.5e-3,
        "wide": 8e-3,
        "toggled": 5e-3,
    }
    assert [settings.limits().interval_unit for settings in spaced.values()] == [1, 1, 1, 2]


# what comes of it


@given(
    start=st.integers(-1000, 33_000),  # the longest train from there just ends within the stage's 100 deg
    interval=st.integers(100, 3000).map(lambda half: 2 * half),
    n=st.integers(1, 12),
    before=st.integers(1, 5000),
    settings=st.sampled_from([{}, {"toggle": True}, {"active_high": False}]),
)
def test_pulses_come_at_their_counts_from_wherever_it_stands(
    start: int, interval: int, n: int, before: int, settings: dict[str, Any]
) -> None:
    train = TriggerTrain(start, interval, n)
    bench = Rig(active_high=settings.get("active_high", True)).bench(**settings)
    stage = bench.stage
    stage.start_move(stage.to_angle(max(start - before, -5000)), SPEED)
    stage.wait(LONG)
    stage.arm(train)
    stage.start_move(stage.to_angle(train.end + 500), SPEED)
    stage.wait(LONG)
    assert counts_of(bench) == points(train)
    stage.close()


def test_latency_of_the_firmware_shifts_all_pulses_by_the_same_angle() -> None:
    """Two actions one after the other, each 1 ms late, at 10 000 counts/s: 20 counts."""
    bench = Rig(latency=1e-3).bench()
    train = TriggerTrain(5000, 200, 100)
    bench.stage.arm(train)
    bench.go(40.0)
    assert counts_of(bench) == [count + 20 for count in points(train)]


def test_a_toggled_output_rests_after_a_train_and_after_disarming_in_the_middle() -> None:
    rig = Rig()
    bench = rig.bench(toggle=True)
    for first, stand in ((1.0, 5.0), (6.0, 6.2)):
        bench.stage.arm(bench.train(first, 1.0, 3))
        bench.go(stand)
        bench.stage.disarm()
        assert rig.say("/1 0 io get do 1") == "0"
    assert len(bench.pulses()) == 4


# firmware that is less able


def test_firmware_without_schedule_says_so_and_is_served_by_toggling() -> None:
    rig = Rig(can_schedule=False)
    bench = rig.bench()
    with refused(DeviceRefused):
        bench.stage.arm(bench.train(1.0, 1.0, 3))
    bench.go(10.0)
    assert bench.pulses() == []
    bench.stage.close()
    rig.bench(toggle=True).stage.close()


def test_firmware_whose_actions_enable_no_triggers_says_so_and_is_served_unchained() -> None:
    rig = Rig(can_chain=False)
    bench = rig.bench()
    train = bench.train(10.0, 1.0, 5)
    with refused(DeviceRefused):
        bench.stage.arm(train)
    bench.stage.close()
    bench = rig.bench(chained=False)
    bench.stage.arm(train)
    assert math.degrees(bench.stage.position()) == pytest.approx(9.0)
    bench.go(20.0)
    assert counts_of(bench) == points(train)


@pytest.mark.parametrize(("back", "pulses"), [(8.5, 0), (9.0, 5)])
def test_an_unchained_train_ends_when_it_is_turned_away_from(back: float, pulses: int) -> None:
    bench = Rig(can_chain=False).bench(chained=False)
    bench.stage.arm(bench.train(10.0, 1.0, 5))
    bench.go(back)
    bench.go(20.0)
    assert len(bench.pulses()) == pulses


def test_an_unchained_train_without_room_before_it_is_refused() -> None:
    bench = Rig(can_chain=False).bench(chained=False)
    bench.go(-5.0)
    with refused(DeviceRefused):
        bench.stage.arm(bench.train(-4.5, 1.0, 5))


def test_firmware_without_triggers_turns_but_does_not_arm() -> None:
    bench = Rig(firmware="7.05").bench()
    assert not bench.stage.limits.trigger_output
    with refused(DeviceRefused):
        bench.stage.arm(bench.train(1.0, 1.0, 3))
    assert bench.go(3.0) == pytest.approx(3.0)


def test_closing_takes_an_armed_train_away() -> None:
    rig = Rig()
    bench = rig.bench()
    bench.stage.arm(bench.train(1.0, 1.0, 30))
    bench.stage.close()
    assert rig.say("/1 0 trigger show") == "d d d d d d"


def test_a_setting_lost_on_the_way_is_noticed_and_nothing_is_emitted() -> None:
    for lost in ("when 1 dist", "when 1 pos", "action a io", "action b trigger", "trigger 1 enable"):
        rig = Rig()
        bench = rig.bench()
        rig.lose(lost)
        with pytest.raises(DeviceError, match=f"no whole reply.*{lost}"):
            bench.stage.arm(bench.train(1.0, 1.0, 3))
        rig.lose("nothing")
        bench.go(20.0)
        assert bench.pulses() == []
