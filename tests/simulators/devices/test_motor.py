"""Pulse motor: the trigger output forgets and repeats nothing when its future is worked out again."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.devices.clock import VirtualClock
from simulators.devices.motion import TrapezoidMove
from simulators.devices.motor import Ended, MotorOutput, PulseMotor, TriggerSettings
from simulators.devices.trigger_line import TriggerLine


@given(
    width=st.sampled_from([200e-9, 1e-4, 1e-3]),
    interval=st.sampled_from([1, 2, 5, 50, 400]),
    looks=st.lists(st.floats(0.0, 0.5), max_size=6),
)
def test_working_out_the_edges_again_gives_the_rest_of_the_same_edges(
    width: float, interval: int, looks: list[float]
) -> None:
    """Also with pulses so wide that they run together: what was high stays high."""
    move = TrapezoidMove.between(0, 20_000, 10_000, 10_000, begin=0.0)
    settings = TriggerSettings(width=width, start=7, end=900, interval=interval)
    once, again = MotorOutput(frozenset({3})), MotorOutput(frozenset({3}))
    for output in (once, again):
        output.settings = settings
        output.arm()
    edges = once.follow(move, 0.0)
    assert again.follow(move, 0.0) == edges
    for now in sorted(looks):
        assert again.follow(move, now) == [edge for edge in edges if edge[0] > now]


def test_an_edge_that_rounding_puts_into_the_past_still_comes() -> None:
    """The point is ahead of the axis and has not fired: it fires now, after the present instant, not before it."""
    now = 1.8e9
    output = MotorOutput(frozenset())
    output.settings = TriggerSettings(start=100, end=100, interval=1)
    output.arm()
    move = TrapezoidMove.between(0, 100, 1e6, 1e12, begin=now - 100 / 1e6)
    edges = output.follow(move, max(now, move.end))
    assert [count for _, count in edges] == [100]
    assert all(time > max(now, move.end) for time, _ in edges)


def test_an_axis_without_a_cable_turns_all_the_same() -> None:
    clock = VirtualClock(start=0.0)
    motor = PulseMotor(clock, lambda: None, counts_per_turn=360)
    motor.start(90, 100.0, 100.0)
    clock.sleep(60.0)
    assert (motor.position(), motor.moving(), motor.ended) == (90, False, Ended(0))
    assert motor.angle_at(60.0) == pytest.approx(math.pi / 2)


@given(st.floats(0.0, 1e-3))
def test_a_stop_right_after_the_start_is_over_soon(after: float) -> None:
    """Not even one pulse of way: it must not creep towards one."""
    clock = VirtualClock(start=0.0)
    motor = PulseMotor(clock, lambda: None, counts_per_turn=360)
    motor.start(90, 100.0, 100.0)
    clock.sleep(after)
    motor.stop(100.0)
    assert (motor.position(), motor.moving()) == (0, False)


def test_far_from_zero_a_stop_still_ends_at_the_target_or_before() -> None:
    """At 2e9 counts a float64 has 2.4e-7 of a count left; rounding must not add a pulse."""
    clock = VirtualClock(start=0.0)
    motor = PulseMotor(clock, lambda: TriggerLine(clock), counts_per_turn=360)
    motor.start(2_000_000_000, 5e6, 6e7)
    clock.sleep(motor.move.end - 1e-5)
    motor.stop(6e7)
    assert motor.move.target <= 2_000_000_000


@pytest.mark.parametrize(("fault", "why"), [("stall_at", Ended.EMERGENCY), ("switch_at", Ended.LIMIT)])
def test_what_blocks_a_move_says_so_until_somebody_clears_the_way(fault: str, why: Ended) -> None:
    clock = VirtualClock(start=0.0)
    motor = PulseMotor(clock, lambda: None, counts_per_turn=360)
    setattr(motor, fault, 40)
    motor.start(90, 100.0, 100.0)
    clock.sleep(60.0)
    assert (motor.position(), motor.moving(), motor.ended) == (40, False, why)
    setattr(motor, fault, None)
    motor.start(90, 100.0, 100.0)
    clock.sleep(60.0)
    assert (motor.position(), motor.ended) == (90, Ended(0))
