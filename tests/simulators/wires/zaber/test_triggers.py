"""Simulated Zaber triggers: edges at the counts and times of closed forms, and the rules of enabling and firing."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.wires.zaber.triggers import Triggers
from tests.simulators.zaber_host import SPEED, TURN, Wire

PULSE = "io set do 1 1 schedule 1 0"


@pytest.fixture
def wire() -> Wire:
    return Wire()


def set_up(wire: Wire, condition: str, action: str = PULSE, number: int = 1, enable: str = "enable") -> None:
    wire.do(f"trigger {number} when {condition}", f"trigger {number} action a {action}", f"trigger {number} {enable}")


# distances


@given(st.integers(1, 4000), st.integers(-500, 500))
def test_pulse_times_are_those_of_the_closed_form(distance: int, start: int) -> None:
    wire = Wire()
    wire.run(f"move abs {start}")
    set_up(wire, f"1 dist {distance}", enable="enable 40", action="io set do 1 1 schedule 0.001 0")
    begun = wire.clock.now()
    wire.run("move rel 100000")
    ramp = SPEED / wire.acceleration
    way = 0.5 * SPEED * ramp
    for k, pulse in enumerate(wire.pulses(), 1):
        gone = k * distance
        left = 100_000 - gone
        if gone < way:
            expected = math.sqrt(2 * gone / wire.acceleration)
        elif left >= way:
            expected = ramp + (gone - way) / SPEED
        else:
            expected = 100_000 / SPEED + ramp - math.sqrt(2 * left / wire.acceleration)
        assert pulse.time - begun == pytest.approx(expected, abs=1e-9)
        assert pulse.angle == pytest.approx((start + gone) * 2 * math.pi / TURN)
    assert len(wire.pulses()) == min(40, 100_000 // distance)


def test_a_distance_is_counted_both_ways_from_the_last_fire(wire: Wire) -> None:
    set_up(wire, "1 dist 500")
    wire.run("move abs 700")
    wire.run("move abs -100")
    wire.run("move abs 20")
    assert wire.counts() == [500, 0]


def test_a_count_disables_it_and_is_told(wire: Wire) -> None:
    set_up(wire, "1 dist 500", enable="enable 3")
    assert wire.data("trigger show") == "3 d d d d d"
    wire.do("move abs 9000")
    wire.clock.sleep(0.22)
    assert wire.data("trigger show") == "1 d d d d d"
    wire.clock.sleep(60.0)
    assert wire.data("trigger show") == "d d d d d d"
    assert wire.counts() == [500, 1000, 1500]


def test_without_a_count_it_goes_on_until_disabled(wire: Wire) -> None:
    set_up(wire, "1 dist 500")
    wire.run("move abs 1200")
    assert wire.data("trigger show") == "e d d d d d"
    wire.run("trigger 1 disable", "move abs 5000")
    assert wire.counts() == [500, 1000]


# comparisons


@pytest.mark.parametrize(
    ("condition", "edges"),
    [
        ("1 pos >= 300", [300]),
        ("1 pos <= 300", [0, 300]),
        ("1 encoder.pos <= -200", [-200]),
    ],
)
def test_a_comparison_fires_when_it_turns_true(wire: Wire, condition: str, edges: list[int]) -> None:
    """From 0 to 1000, to -1000 and back to 0."""
    set_up(wire, condition, "io set do 1 1 schedule 0.001 0")
    wire.run("move abs 1000")
    wire.run("move abs -1000")
    wire.run("move abs 0")
    assert wire.counts() == edges


def test_triggers_that_set_each_other_off_come_to_an_end(wire: Wire) -> None:
    wire.do("trigger 1 when 1 pos >= 10", "trigger 2 when 1 pos >= 10")
    wire.do("trigger 1 action a trigger 2 enable 1", "trigger 2 action a trigger 1 enable 1", "trigger 1 enable 1")
    wire.run("move abs 1000")
    assert wire.data("get pos", axis=1) == "1000"


# outputs, time, inputs, settings


def test_a_scheduled_value_comes_after_its_time_and_a_new_one_cancels_it(wire: Wire) -> None:
    wire.do("io set do 1 1 schedule 20 0")
    wire.clock.sleep(0.019)
    assert wire.data("io get do 1") == "1"
    wire.clock.sleep(0.002)
    assert wire.data("io get do") == "0 0 0 0"
    wire.do("io set do 1 1 schedule 20 0", "io set do 1 1")
    wire.clock.sleep(1.0)
    assert wire.data("io get do 1") == "1"
    assert [round(pulse.time, 6) for pulse in wire.pulses()] == [0.0, 0.021]


def test_pulses_wider_than_their_distance_in_time_merge(wire: Wire) -> None:
    set_up(wire, "1 dist 500", "io set do 1 1 schedule 60 0")
    wire.run("move abs 90000")
    assert len(wire.pulses()) < 90


def test_lost_pulses_are_missing_and_no_others() -> None:
    wire = Wire(lost={1, 4})
    set_up(wire, "1 dist 500")
    wire.run("move abs 2000")
    wire.run("move abs 4000")
    assert wire.counts() == [500, 1500, 2000, 3000, 3500, 4000]


def test_predicted_edges_happen() -> None:
    """The copy that looks ahead leaves the triggers as they are."""
    wire = Wire()
    set_up(wire, "1 dist 300", "io set do 1 t", enable="enable 7")
    wire.do("move abs 5000")
    triggers: Triggers = wire.box.device.triggers
    predicted = triggers.predicted(60.0)
    assert triggers.edges == []
    for _ in range(100):
        wire.clock.sleep(0.013)
        wire.tell("/1")
    assert triggers.edges == predicted
    assert len(predicted) == 7
