"""Simulated Zaber on its wire: the rules of triggers and outputs, and what it refuses. The tests of the driver and the
library of the vendor ask the rest of it."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from tests.drivers.stages.flat_settings import flat
from tests.simulators.wires.zaber.host import SPEED, TURN, Wire
from tests.simulators.wires.zaber.triggers import Triggers
from tests.simulators.wires.zaber.wire import ZaberBuild


@pytest.fixture
def wire() -> Wire:
    return Wire()


PULSE = "io set do 1 1 schedule 1 0"


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


def test_pulses_wider_than_their_distance_in_time_merge(wire: Wire) -> None:
    set_up(wire, "1 dist 500", "io set do 1 1 schedule 60 0")
    wire.run("move abs 90000")
    assert len(wire.pulses()) < 90


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


@pytest.mark.parametrize(
    "packet", [b"/1:00", b"/1:C", b"/1:", b"x/1", b"/1 \xff", b"1 home", b"@01 1 OK", b"/1 " + b"w " * 40]
)
def test_a_packet_that_is_damaged_gets_no_answer_and_the_next_one_does(wire: Wire, packet: bytes) -> None:
    wire.box.receive(packet + b"\n")
    assert wire.box.transmit() == b""
    assert wire.ask("/1 1") == "@01 1 OK IDLE -- 0"


@pytest.mark.parametrize(
    ("packet", "reason"),
    [
        ("/1 1 set maxspeed 0", "BADDATA"),
        ("/1 1 set maxspeed fast", "BADDATA"),
        ("/1 1 set pos 5", "BADCOMMAND"),
        ("/1 1 get version", "DEVICEONLY"),
        ("/1 1 move abs 2000000001", "BADDATA"),
        ("/1 1 move abs", "BADCOMMAND"),
        ("/1 0 trigger 7 enable", "BADDATA"),
        ("/1 0 trigger 1 enable", "BADDATA"),
        ("/1 0 trigger 1 when 1 dist 0", "BADDATA"),
        ("/1 0 trigger 1 action a fly", "BADDATA"),
        ("/1 0 io set do 5 1", "BADCOMMAND"),
    ],
)
def test_what_it_cannot_do_is_rejected_with_the_reason(wire: Wire, packet: str, reason: str) -> None:
    assert wire.ask(packet).endswith(f"RJ IDLE -- {reason}")


class Passing(VirtualClock):
    """A clock on which a millisecond passes at every look."""

    def now(self) -> float:
        self.sleep(1e-3)
        return super().now()


def test_a_reply_that_says_idle_never_shows_a_place_on_the_way() -> None:
    """However the end of the move falls between the looks at the clock that a reply takes."""
    for late in range(40):
        clock = Passing(start=0.0)
        box = flat(ZaberBuild, counts_per_turn=TURN).controller(clock, TriggerLine(clock))
        box.receive(b"/1 1 move abs 1000\n")
        clock.sleep(late * 0.25e-3)
        reply = "BUSY"
        while "BUSY" in reply:
            box.transmit()
            box.receive(b"/1 1 get pos\n")
            reply = box.transmit().decode()
        assert reply.split()[4:] == ["--", "1000"], late
