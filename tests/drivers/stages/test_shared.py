"""Standing: when the last look at a moving stage falls, against the grid of looks worked out by hand."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.base.protocols import StageLimits
from drivers.stages.shared import POLL, STOP_MARGIN, longest_stop, until_standing
from simulators.devices.clock import VirtualClock


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
