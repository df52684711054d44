"""Clocks: a virtual second passes at once, a scaled one in proportion, and none goes back."""

from __future__ import annotations

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.base.clock import Clock
from simulators.devices.clock import ScaledClock, VirtualClock


@given(st.lists(st.floats(-10.0, 1e4), max_size=20))
def test_a_virtual_clock_adds_up_its_sleeps_and_never_goes_back(sleeps: list[float]) -> None:
    clock: Clock = VirtualClock(start=0.0)
    last = clock.now()
    for seconds in sleeps:
        clock.sleep(seconds)
        assert clock.now() >= last
        last = clock.now()
    assert clock.now() == pytest.approx(sum(s for s in sleeps if s > 0))


def test_sleeps_in_several_threads_are_all_counted() -> None:
    clock = VirtualClock(start=0.0)
    threads = [threading.Thread(target=lambda: [clock.sleep(1.0) for _ in range(500)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert clock.now() == 2000.0


@given(st.floats(0.01, 1000.0), st.floats(0.0, 1e4))
def test_a_scaled_clock_runs_in_proportion_to_its_base_and_sleeps_by_itself(speed: float, seconds: float) -> None:
    base = VirtualClock(start=100.0)
    clock = ScaledClock(base, speed)
    assert clock.now() == 100.0
    base.sleep(seconds)
    assert clock.now() == pytest.approx(100.0 + seconds * speed)
    clock.sleep(seconds)
    assert clock.now() == pytest.approx(100.0 + seconds * (speed + 1))


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan")])
def test_a_clock_that_stands_or_goes_back_is_refused(speed: float) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        ScaledClock(VirtualClock(), speed)


def test_clocks_may_start_later_than_their_base() -> None:
    base = VirtualClock(start=100.0)
    assert ScaledClock(base, 10.0, not_before=50.0).now() == 100.0
    clock = ScaledClock(base, 10.0, not_before=5000.0)
    base.sleep(2.0)
    assert clock.now() == 5020.0
