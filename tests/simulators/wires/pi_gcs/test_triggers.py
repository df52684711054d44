"""Simulated PI GCS 2.0, trigger output: window, direction, reversal, and the times of a trapezoid in closed form."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simulators.wires.pi_gcs.output import FirstPulse
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


def test_pulses_come_when_the_axis_passes_each_step_of_the_window(wire: Wire) -> None:
    wire.window("0.75", "1", "6.625")
    wire.run("MOV 1 20")
    expected = [1 + 0.75 * k for k in range(8)]
    assert wire.degrees() == expected
    assert [pulse.time for pulse in wire.pulses()] == pytest.approx([crossing(at) for at in expected])


@pytest.mark.parametrize(
    ("rule", "start", "expected"),
    [
        (FirstPulse.AT_THRESHOLD, "1.25", [1.25, 1.75, 2.25, 2.75, 3.25]),
        (FirstPulse.STEP_AFTER, "1.25", [1.75, 2.25, 2.75, 3.25]),
        (FirstPulse.GRID, "1.25", [1.5, 2.0, 2.5, 3.0]),
        (FirstPulse.GRID, "1.5", [1.5, 2.0, 2.5, 3.0]),
    ],
)
def test_the_first_pulse_depends_on_how_the_controller_is_built(
    rule: FirstPulse, start: str, expected: list[float]
) -> None:
    wire = Wire(first_pulse=rule)
    wire.window("0.5", start, "3.4")
    wire.run("MOV 1 20")
    assert wire.degrees() == expected
    wire = Wire(first_pulse=rule)
    wire.window("0.5", "-" + start, "-3.4")
    wire.run("MOV 1 -20")
    assert wire.degrees() == [-at for at in expected]


@pytest.mark.parametrize("sign", [1, -1])
def test_a_window_is_for_one_direction(wire: Wire, sign: int) -> None:
    wire.run("MOV 1 0")
    wire.window("1", f"{sign * 2}", f"{sign * 5.5}")
    wire.run(f"MOV 1 {sign * 10}")
    assert wire.degrees() == [sign * at for at in (2, 3, 4, 5)]
    wire.run("MOV 1 0")
    assert len(wire.pulses()) == 4
    wire.run(f"MOV 1 {sign * 10}")
    assert wire.degrees() == 2 * [sign * at for at in (2, 3, 4, 5)]


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


def test_switched_off_on_the_way_the_rest_does_not_come(wire: Wire) -> None:
    wire.window("1", "2", "20.5")
    wire.tell("MOV 1 30")
    wire.clock.sleep(crossing(7.5))
    wire.tell("TRO 1 0")
    wire.clock.sleep(60.0)
    assert wire.degrees() == [2, 3, 4, 5, 6, 7]


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


def test_a_servo_sees_a_crossing_in_its_next_cycle() -> None:
    wire = Wire(servo_period=1e-3)
    wire.window("0.7", "1", "9")
    wire.run("MOV 1 20")
    late = [pulse.time - crossing(1 + 0.7 * k) for k, pulse in enumerate(wire.pulses())]
    assert len(late) == 12
    assert all(-1e-9 <= seconds <= 1e-3 + 1e-9 for seconds in late)
    assert max(late) > 1e-4
    cycles = [pulse.time / 1e-3 for pulse in wire.pulses()]
    assert cycles == pytest.approx([round(cycle) for cycle in cycles], abs=1e-6)


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
@given(
    start=st.integers(1, 3000), step=st.integers(1, 700), n=st.integers(1, 40), sign=st.sampled_from([-1, 1]),
    stops=st.lists(st.floats(0.01, 3.0), max_size=3), hard=st.booleans()
)  # fmt: skip
def test_a_way_with_stops_gives_every_pulse_of_its_window_once(
    start: int, step: int, n: int, sign: int, stops: list[float], hard: bool
) -> None:
    """The stop threshold lies half a step behind the last pulse, in counts a thousandth of a degree each."""
    wire = Wire()
    last = start + step * (n - 1)
    wire.window(f"{step / 1000}", f"{sign * start / 1000}", f"{sign * (last + step / 2) / 1000}")
    for seconds in stops:
        wire.tell(f"MOV 1 {sign * 40}")
        wire.clock.sleep(seconds)
        wire.tell("STP" if hard else "HLT 1")
        wire.clock.sleep(1.0)
    wire.run(f"MOV 1 {sign * 40}")
    assert wire.degrees() == [sign * (start + k * step) / 1000 for k in range(n)]
    times = [pulse.time for pulse in wire.pulses()]
    assert all(earlier < later for earlier, later in itertools.pairwise(times))


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
