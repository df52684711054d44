"""Simulated PM16C, trigger output: every point once, at the time at which the commanded position crosses it."""

from __future__ import annotations

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.simulators.pm16c_host import Wire


@pytest.fixture
def wire() -> Wire:
    return Wire()


def test_a_stop_at_the_instant_of_a_pulse_neither_loses_nor_repeats_one() -> None:
    for k in range(8):
        wire = Wire()
        wire.train(10_000, 20_000, 1000)
        wire.tell("ABS0+40000")
        for _ in range(k):
            wire.clock.sleep(wire.line.next_after(wire.clock.now()).time - wire.clock.now())  # type: ignore[union-attr]
        wire.run("ESTP0" if k % 2 else "SSTP0")
        wire.run("ABS0+40000")
        assert wire.counts() == list(range(10_000, 20_001, 1000))


@settings(max_examples=50)
@given(
    start=st.integers(1, 3000), interval=st.integers(1, 700), n=st.integers(1, 40), room=st.integers(0, 699),
    sign=st.sampled_from([-1, 1]), stop_after=st.floats(0.0, 8.0)
)  # fmt: skip
def test_a_train_is_whole_whatever_way_and_wherever_it_is_interrupted(
    start: int, interval: int, n: int, room: int, sign: int, stop_after: float
) -> None:
    """Stop, go back, go on: every point once, in order, floor((end - start)/interval) + 1 of them."""
    wire = Wire()
    end = start + interval * (n - 1) + min(room, interval - 1)
    assume(sign > 0 or end > start)  # with one point only, there is no sign to turn the other way
    wire.train(sign * start, sign * end, interval)
    assert wire.ask("TMGR?0") == "YES"
    wire.tell(f"ABS0{sign * 40_000:+d}")
    wire.clock.sleep(stop_after)
    wire.run("SSTP0")
    wire.run("ABS0+0")
    wire.run(f"ABS0{sign * 40_000:+d}")
    assert wire.counts() == [sign * (start + k * interval) for k in range((end - start) // interval + 1)]
    assert wire.ask("TMGR?0") == "NO"


def test_ready_drops_when_the_start_point_is_passed_though_pulses_go_on(wire: Wire) -> None:
    wire.train(5000, 50_000, 5000)
    wire.tell("ABS0+60000")
    wire.clock.sleep(0.99)
    assert wire.ask("TMGR?0") == "YES"
    wire.clock.sleep(0.02)
    assert wire.ask("TMGR?0") == "NO"
    wire.clock.sleep(60.0)
    assert len(wire.pulses()) == 10


@pytest.mark.parametrize(("start", "end"), [(0, 100), (-5, 100), (5, -100)])
def test_it_cannot_be_armed_from_inside_or_beyond(wire: Wire, start: int, end: int) -> None:
    wire.train(start, end, 10)
    assert (wire.ask("TMGR?0"), wire.ask("ERRF?")) == ("NO", "01")


def test_it_cannot_be_armed_switched_off_or_without_a_position_controller(wire: Wire) -> None:
    wire.tell("TMGM00")
    wire.train(10, 100, 10)
    assert wire.ask("TMGR?0") == "NO"
    wire.tell("TMGM05", "SETCH4567", "TMGR0")
    assert wire.ask("TMGR?0") == "NO"


def test_settings_of_an_armed_trigger_are_not_taken(wire: Wire) -> None:
    wire.train(1000, 9000, 1000)
    wire.tell("TMGI0500", "TMGM03", "TMGS0+2000")
    assert (wire.ask("TMGI?0"), wire.ask("TMGM?0"), wire.ask("TMGS?0"), wire.ask("ERRF?")) == (
        "0001000", "2", "+0001000", "01"
    )  # fmt: skip


def test_a_width_not_shorter_than_the_interval_time_leaves_the_output_high(wire: Wire) -> None:
    """At 10 000 pps, 10 pulses last 1 ms: with 1 ms pulses only the first rise is an edge, with 100 µs all are."""
    wire.run("ABS0-30000")
    for digit, edges in (("5", 1), ("4", 101)):
        seen = len(wire.pulses())
        wire.tell(f"TMGM0{digit}")
        wire.train(0, 1000, 10)
        wire.run("ABS0+30000")
        assert len(wire.pulses()) - seen == edges
        wire.run("ABS0-30000")


def test_only_the_channel_on_position_controller_a_reaches_the_cable(wire: Wire) -> None:
    wire.tell("SETCH10--")
    wire.train(100, 1000, 100)
    wire.run("ABS0+2000")
    assert wire.counts() == []


def test_a_fast_stop_takes_away_the_pulses_to_come_and_lost_ones_never_come() -> None:
    wire = Wire(lost={1})
    wire.train(10_000, 90_000, 10_000)
    wire.tell("ABS0+100000")
    wire.clock.sleep(5.0)
    wire.run("ESTP0")
    assert wire.counts() == [10_000, 30_000, 40_000]


def test_more_pulses_than_it_can_work_out_are_refused_at_once(wire: Wire) -> None:
    wire.train(1, 200_001, 1)
    assert (wire.ask("TMGR?0"), wire.ask("ERRF?")) == ("NO", "01")
    wire.train(1, 200_000, 1)
    assert wire.ask("TMGR?0") == "YES"
