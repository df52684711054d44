"""Trapezoid move: closed forms of constant-acceleration kinematics, bounds, and time_at as the inverse of position."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.devices.motion import TrapezoidMove

POSITIONS = st.floats(-1e6, 1e6)
SPEEDS = st.floats(1.0, 1e5)
ACCELERATIONS = st.floats(10.0, 1e6)
FRACTIONS = st.floats(0.0, 1.0)
MOVES = st.builds(TrapezoidMove.between, POSITIONS, POSITIONS, SPEEDS, ACCELERATIONS, st.just(0.0))


def positions(move: TrapezoidMove, n: int = 200) -> np.ndarray:
    times = np.linspace(move.begin - 0.1, move.end + 0.1, n)
    return np.array([move.position(time) for time in times])


def test_a_long_move_takes_distance_over_speed_plus_speed_over_acceleration() -> None:
    move = TrapezoidMove.between(0.0, 1000.0, 100.0, 50.0, begin=7.0)
    assert move.duration == pytest.approx(1000 / 100 + 100 / 50)
    assert move.end == pytest.approx(19.0)
    assert move.position(7.0 + 2.0) == pytest.approx(0.5 * 50 * 2.0**2)
    assert move.position(7.0 + 6.0) == pytest.approx(500.0)
    assert move.velocity(7.0 + 6.0) == pytest.approx(100.0)


def test_a_short_move_is_a_triangle_of_twice_the_root_of_distance_over_acceleration() -> None:
    move = TrapezoidMove.between(10.0, 2.0, 100.0, 50.0, begin=0.0)
    assert move.duration == pytest.approx(2 * math.sqrt(8 / 50))
    assert move.position(move.duration / 2) == pytest.approx(6.0)
    assert move.velocity(move.duration / 2) == pytest.approx(-math.sqrt(8 * 50))


def test_a_move_to_where_it_stands_is_over_at_once() -> None:
    move = TrapezoidMove.between(5.0, 5.0, 100.0, 50.0, begin=3.0)
    assert (move.duration, move.end, move.position(99.0), move.direction) == (0.0, 3.0, 5.0, 0)


@given(MOVES)
def test_it_starts_at_the_start_ends_at_the_target_and_never_turns_back(move: TrapezoidMove) -> None:
    path = positions(move)
    assert path[0] == move.start
    assert path[-1] == move.target
    assert np.all(np.diff(path) * (move.direction or 1) >= -1e-6)


@given(POSITIONS, POSITIONS, SPEEDS, ACCELERATIONS, st.floats(1.7e9, 1.9e9))
def test_it_stands_at_the_target_from_the_very_end_on_though_epoch_seconds_are_coarse(
    a: float, b: float, speed: float, accel: float, begin: float
) -> None:
    move = TrapezoidMove.between(a, b, speed, accel, begin)
    assert (move.position(move.end), move.velocity(move.end)) == (b, 0.0)
    stopped = move.braked(begin + 0.3 * move.duration, accel)
    assert stopped.position(stopped.end) == stopped.target


@given(POSITIONS, POSITIONS, SPEEDS, ACCELERATIONS, FRACTIONS)
def test_neither_speed_nor_acceleration_is_exceeded(a: float, b: float, speed: float, accel: float, at: float) -> None:
    move = TrapezoidMove.between(a, b, speed, accel, begin=0.0)
    assert abs(move.velocity(at * move.duration)) <= speed * (1 + 1e-9)
    assert all(abs(phase.acceleration) <= accel for phase in move.phases)


@given(MOVES)
def test_velocity_is_the_derivative_of_position(move: TrapezoidMove) -> None:
    """The central difference is exact where the acceleration is constant; what remains is the rounding of positions."""
    for phase in move.phases:
        middle, h = phase.begin + phase.duration / 2, phase.duration / 4
        difference = (move.position(middle + h) - move.position(middle - h)) / (2 * h)
        rounding = 1e-14 * (abs(move.start) + abs(move.target) + abs(difference) * middle) / h
        assert move.velocity(middle) == pytest.approx(difference, rel=1e-6, abs=rounding)


@given(MOVES, FRACTIONS)
def test_time_at_inverts_position(move: TrapezoidMove, fraction: float) -> None:
    position = move.start + fraction * (move.target - move.start)
    position = min(max(position, min(move.start, move.target)), max(move.start, move.target))
    assert move.position(move.time_at(position)) == pytest.approx(position, rel=1e-7, abs=1e-4)


@given(MOVES, FRACTIONS, ACCELERATIONS)
def test_a_braked_move_shares_the_past_and_stops_after_v_squared_over_2a(
    move: TrapezoidMove, at: float, acceleration: float
) -> None:
    time = at * move.duration
    braked = move.braked(time, acceleration)
    for earlier in (0.0, 0.3 * time, 0.9 * time):
        assert braked.position(earlier) == pytest.approx(move.position(earlier), rel=1e-9, abs=1e-6)
    speed = abs(move.velocity(time))
    assert abs(braked.target - move.position(time)) == pytest.approx(speed**2 / (2 * acceleration), rel=1e-6, abs=1e-6)
    assert braked.end - time == pytest.approx(speed / acceleration, abs=1e-6)
    assert braked.velocity(braked.end) == pytest.approx(0.0, abs=1e-6 * (1 + speed))
    path = positions(braked)
    assert path[-1] == braked.target
    assert np.all(np.diff(path) * (move.direction or 1) >= -1e-6)


@given(MOVES, FRACTIONS)
def test_a_halted_move_stands_exactly_where_it_was_told(move: TrapezoidMove, fraction: float) -> None:
    low, high = sorted((move.start, move.target))
    position = min(max(low + fraction * (high - low), low), high)
    halted = move.halted(position)
    assert halted.target == position
    assert halted.end == pytest.approx(move.time_at(position), abs=1e-9)
    assert halted.position(halted.end + 1.0) == position
    assert halted.velocity(halted.end + 1.0) == 0.0


def test_a_position_off_the_way_has_no_time() -> None:
    move = TrapezoidMove.between(0.0, 10.0, 1.0, 1.0, begin=0.0)
    for position in (-1e-9, 10.000001):
        with pytest.raises(ValueError, match="does not pass"):
            move.time_at(position)


@pytest.mark.parametrize(("speed", "acceleration"), [(0.0, 1.0), (1.0, 0.0), (-1.0, 1.0), (math.nan, 1.0)])
def test_a_move_without_speed_or_acceleration_is_refused(speed: float, acceleration: float) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        TrapezoidMove.between(0.0, 1.0, speed, acceleration, begin=0.0)


def test_at_todays_epoch_a_position_keeps_a_hundredth_of_a_pulse() -> None:
    """A float64 of seconds since 1970 resolves 0.24 µs: 0.007 pulses at 30 000 pulses/s."""
    move = TrapezoidMove.between(0.0, 180_000.0, 30_000.0, 60_000.0, begin=1.8e9)
    for position in range(0, 180_001, 7919):
        assert move.position(move.time_at(position)) == pytest.approx(position, abs=0.01)
