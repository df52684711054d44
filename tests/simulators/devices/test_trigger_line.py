"""Trigger line: pulses come out in the order of time, once each, and a stop takes the rest away."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import Pulse, TriggerLine

TIMES = st.lists(st.floats(0.0, 1e6), unique=True, max_size=30)


def drain(line: TriggerLine, after: float = -math.inf) -> list[Pulse]:
    """All pulses later than `after`, taken as a camera takes them."""
    pulses: list[Pulse] = []
    while (pulse := line.next_after(after)) is not None:
        pulses.append(pulse)
        after = pulse.time
    return pulses


@given(TIMES, TIMES)
def test_every_pulse_comes_out_once_in_the_order_of_time(first: list[float], second: list[float]) -> None:
    line = TriggerLine(VirtualClock(start=0.0))
    line.schedule(Pulse(time, 0.1) for time in first)
    line.schedule(Pulse(time, 0.1) for time in second if time not in first)
    assert [pulse.time for pulse in drain(line)] == sorted({*first, *second})


@given(TIMES, st.floats(0.0, 1e6))
def test_cancel_takes_exactly_the_later_pulses(times: list[float], stop: float) -> None:
    line = TriggerLine(VirtualClock(start=0.0))
    line.schedule(Pulse(time, 0.0) for time in times)
    line.cancel_after(stop)
    assert [pulse.time for pulse in drain(line)] == sorted(time for time in times if time <= stop)


def test_a_pulse_without_a_finite_time_is_refused_and_nothing_is_scheduled() -> None:
    line = TriggerLine(VirtualClock())
    with pytest.raises(ValueError, match="no pulse was scheduled"):
        line.schedule([Pulse(1.0, 0.0), Pulse(math.nan, 0.0)])
    assert drain(line) == []


def test_the_angle_is_zero_until_something_turns_the_sample() -> None:
    line = TriggerLine(VirtualClock())
    assert line.angle_at(3.0) == 0.0
    line.attach_angle(lambda time: 2.0 * time)
    assert line.angle_at(3.0) == 6.0
    line.attach_angle(lambda time: -time)
    assert line.angle_at(3.0) == -3.0
