"""Travel: the least distance of pulses, the trains that a stage gets, and when it counts as standing still."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.base.errors import DeviceRefused
from drivers.base.protocols import StageLimits, TriggerTrain
from drivers.stages.settings import StageFigures
from drivers.stages.shared import POLL, STOP_MARGIN, longest_stop, until_standing
from drivers.stages.travel import Travel, least_interval
from simulators.devices.clock import VirtualClock
from tests.messages import refused


@given(polls=st.integers(-10, 100), part=st.floats(0.01, 0.99), timeout=st.floats(-1, 1))
def test_the_last_status_is_the_first_of_a_standing_stage_or_at_the_deadline(
    polls: int, part: float, timeout: float
) -> None:
    """Looks fall on every POLL and on the deadline; where there is no time left, there is one all the same. The move
    ends between two of them."""
    clock, end = VirtualClock(), (polls + part) * POLL
    begun, looks = clock.now(), []

    def look() -> float:
        looks.append(clock.now() - begun)
        return looks[-1]

    last = until_standing(clock, look, lambda now: now < end, timeout)
    due = max(0.0, min((polls + 1) * POLL, timeout))
    assert last == looks[-1] == pytest.approx(due, abs=1e-6)
    assert all(b - a <= POLL + 1e-6 for a, b in itertools.pairwise(looks))
    assert len(looks) <= due / POLL + 3


def test_a_stop_may_take_the_ramp_from_full_speed() -> None:
    """30 deg/s at 60 deg/s² are half a second."""
    limits = StageLimits(360_000, math.radians(30), math.radians(60), 0.0, 1.0, True)
    assert longest_stop(limits) == pytest.approx(0.5 + STOP_MARGIN)


LIMITS = StageLimits(360_000, math.radians(30), math.radians(60), 0.0, math.radians(100), True, 0, 2e-3)
"""30 000 counts/s at full speed, of which 60 take 2 ms."""


@given(
    counts=st.integers(1, 10**9),
    speed=st.integers(1, 10_000),
    microseconds=st.integers(0, 10**6),
    unit=st.sampled_from([1, 2]),
)
def test_the_least_interval_is_the_fewest_units_that_take_the_spacing(
    counts: int, speed: int, microseconds: int, unit: int
) -> None:
    """With a speed in thousandths of a degree/s all is a fraction: exact where floats are off by less than a count."""
    limits = replace(LIMITS, counts_per_turn=counts, max_speed=math.radians(speed / 1000), interval_unit=unit)
    least = least_interval(replace(limits, pulse_spacing=microseconds / 1e6))
    exact = Fraction(counts * speed * microseconds, 360 * 1000 * 10**6)
    slack = Fraction(2, 10**6) + exact / 10**12
    assert least % unit == 0
    assert least > 0
    assert exact - slack <= least
    assert least == unit or least - unit < exact


@pytest.mark.parametrize("unit", [1, 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_train_at_the_least_interval_is_taken_and_a_closer_one_is_not(unit: int, sign: int) -> None:
    travel = Travel("stage", replace(LIMITS, interval_unit=unit))
    travel.refuse_train(TriggerTrain(5000, sign * 60, 9))
    with refused(DeviceRefused):
        travel.refuse_train(TriggerTrain(5000, sign * (60 - unit), 9))
    travel.refuse_train(TriggerTrain(5000, sign, 1))


def test_an_interval_that_is_no_multiple_of_the_unit_is_refused() -> None:
    Travel("stage", LIMITS).refuse_train(TriggerTrain(5000, 61, 9))
    with refused(DeviceRefused) as error:
        Travel("stage", replace(LIMITS, interval_unit=2)).refuse_train(TriggerTrain(5000, 61, 9))
    assert "lower max_speed" not in str(error.value)


@pytest.mark.parametrize(
    "train",
    [TriggerTrain(0, 100, 0), TriggerTrain(0, 0, 1), TriggerTrain(-1, 100, 3), TriggerTrain(99_801, 100, 3)],
)
def test_no_pulse_no_way_between_them_and_a_place_beyond_the_limits_are_refused(train: TriggerTrain) -> None:
    with refused(DeviceRefused):
        Travel("stage", LIMITS).refuse_train(train)
    Travel("stage", LIMITS).refuse_train(TriggerTrain(99_800, 100, 3))


@pytest.mark.parametrize("spacing", [-1e-6, math.nan, math.inf, 1e300])
def test_a_spacing_that_no_pulses_can_have_is_refused(spacing: float) -> None:
    with refused(ValueError):
        StageFigures(counts_per_turn=360_000, max_speed=0.5, acceleration=1.0, low=0.0, high=1.0).limits_with(
            1.0, spacing
        )
