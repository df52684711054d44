"""Simulated PI GCS 2.0, trigger output: window, direction, reversal, and the times of a trapezoid in closed form."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.simulators.pi_gcs_host import ACCELERATION, VELOCITY, Wire

RAMP = VELOCITY**2 / (2 * ACCELERATION)
"""degrees: 2.5."""


def crossing(degrees: float) -> float:
    """When a long move from 0 passes there: √(2s/a) in the ramp, then v/a + (s - ramp)/v."""
    if degrees <= RAMP:
        return math.sqrt(2 * degrees / ACCELERATION)
    return VELOCITY / ACCELERATION + (degrees - RAMP) / VELOCITY


@pytest.fixture
def wire() -> Wire:
    return Wire()


def test_turning_round_inside_the_window_goes_on_giving_pulses_until_it_is_left(wire: Wire) -> None:
    """Out to 4.5 (pulses at 2, 3, 4), back to 2.5 (3), forwards again (4, 5), then out past the stop: none more."""
    wire.window("1", "2", "5.5")
    wire.run("MOV 1 4.5")
    wire.run("MOV 1 2.5")
    wire.run("MOV 1 9")
    wire.run("MOV 1 3")
    assert wire.degrees() == [2, 3, 4, 3, 4, 5]


def test_leaving_backwards_ends_it_and_coming_again_begins_anew(wire: Wire) -> None:
    wire.window("1", "2", "5.5")
    wire.run("MOV 1 3.5")
    wire.run("MOV 1 0")
    wire.run("MOV 1 4.5")
    assert wire.degrees() == [2, 3, 2, 2, 3, 4]


def test_switched_on_inside_the_window_it_counts_from_where_it_stands(wire: Wire) -> None:
    wire.run("MOV 1 2.2")
    wire.window("1", "2", "5.5")
    wire.run("MOV 1 9")
    assert wire.degrees() == [3.2, 4.2, 5.2]


def test_switched_off_or_in_another_mode_or_on_another_output_there_is_nothing(wire: Wire) -> None:
    wire.window("1", "2", "5.5")
    wire.tell("TRO 1 0")
    wire.run("MOV 1 9")
    wire.run("MOV 1 0")
    wire.window("1", "2", "5.5")
    wire.tell("CTO 1 3 2")
    wire.run("MOV 1 9")
    wire.run("MOV 1 0", "TRO 1 0", "CTO 2 1 1", "CTO 2 8 2", "CTO 2 9 5.5", "TRO 2 1")
    wire.run("MOV 1 9")
    assert wire.degrees() == []
    assert wire.ask("TRO?") == "1=0 \n2=1 \n3=0 \n4=0"


def test_pulses_that_run_into_each_other_merge() -> None:
    """At 10 degrees/s a step of 0.01 degrees takes 1 ms, as long as a pulse is held."""
    wire = Wire(pulse_width=1.001e-3)
    wire.window("0.01", "5", "6.005")
    wire.run("MOV 1 20")
    assert len(wire.pulses()) == 1
    wire = Wire(pulse_width=0.999e-3)
    wire.window("0.01", "5", "6.005")
    wire.run("MOV 1 20")
    assert len(wire.pulses()) == 101


def test_where_low_is_active_the_line_rises_when_a_pulse_ends() -> None:
    wire = Wire(pulse_width=1e-3)
    wire.tell("CTO 1 7 0")
    wire.window("1", "5", "7.5")
    wire.run("MOV 1 20")
    assert [pulse.time for pulse in wire.pulses()] == pytest.approx([crossing(at) + 1e-3 for at in (5, 6, 7)])
    assert wire.degrees() == [5.01, 6.01, 7.01]


def test_lost_pulses_are_missing_and_no_others() -> None:
    wire = Wire(lost={0, 3})
    wire.window("1", "2", "7.5")
    wire.run("MOV 1 20")
    assert wire.degrees() == [3, 4, 6, 7]


def test_a_motion_error_ends_the_pulses() -> None:
    wire = Wire(stall_at=4500)
    wire.window("1", "2", "7.5")
    wire.tell("MOV 1 20")
    wire.clock.sleep(60.0)
    assert wire.degrees() == [2, 3, 4]


@settings(max_examples=60)
@given(way=st.lists(st.integers(-9000, 9000), min_size=1, max_size=6), step=st.integers(50, 3000))
def test_without_a_window_pulses_are_a_step_apart_and_as_many_as_the_way_has(way: list[int], step: int) -> None:
    """Independent: walk the way count by count and fire whenever the last pulse is a step away."""
    wire = Wire()
    wire.window(f"{step / 1000}", "0", "0")
    here = last = 0
    expected = []
    for target in way:
        wire.run(f"MOV 1 {target / 1000}")
        for at in range(here, target, 1 if target > here else -1):
            at += 1 if target > here else -1
            if abs(at - last) == step:
                last = at
                expected.append(at / 1000)
        here = target
    assert wire.degrees() == expected
