"""Remaining time: the rest of a work takes as long per step as the work so far."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.core.durations import seconds_left


@given(st.floats(0.1, 1e3), st.floats(0, 1e3), st.floats(0.1, 1e3))
def test_the_rest_takes_as_long_as_so_far_for_each_unit(done: float, more: float, pace: float) -> None:
    assert seconds_left(done, done + more, pace * done) == pytest.approx(pace * more, rel=1e-6, abs=1e-6)
    assert seconds_left(0, more, pace) is None and seconds_left(done, 0.0, pace) == 0
