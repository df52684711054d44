"""Ring current: decay and top-up against closed forms, and exposures that add up."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.effects.beam.ring_current import RingCurrent
from simulators.frame import sensor
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]
TAU = 100.0
SHORT = 1e-6 * TAU
RINGS = {
    "falls": RingCurrent(TAU),
    "by the clock": RingCurrent(TAU, top_up_every=30.0),
    "by the clock, with a ramp": RingCurrent(TAU, top_up_every=30.0, refill=4.0),
    "by the current": RingCurrent(TAU, top_up_below=0.8),
    "by the current, with a ramp": RingCurrent(TAU, top_up_below=0.8, refill=4.0),
}


def test_a_frame_halves_in_the_half_life() -> None:
    scene = shots.scene({"kind": "ring_current", "lifetime": TAU})
    half = shots.frame(scene, shots.shot(elapsed=TAU * math.log(2) - 0.005), sample=False)  # the middle of 10 ms
    assert (half == round(2000 / CONVERSION)).all()


@pytest.mark.parametrize("ring", RINGS.values(), ids=RINGS)
def test_the_mean_is_the_integral_of_the_current_itself(ring: RingCurrent) -> None:
    """Against the sum over the current as its words describe it, in steps of 10 ms."""
    times = (np.arange(10_000) + 0.5) * 0.01
    falls = -TAU * math.log(0.8) if ring.top_up_below else (ring.top_up_every or math.inf) - ring.refill
    phase = times % (falls + ring.refill) if math.isfinite(falls) else times
    least = math.exp(-falls / TAU)
    rise = least + (1 - least) * (phase - falls) / (ring.refill or 1.0)
    current = np.where(phase < falls, np.exp(-phase / TAU), rise)
    assert ring.mean(0.0, 100.0) == pytest.approx(current.mean(), rel=1e-4)  # a jump may fall anywhere in a step
    for start, duration in ((3.0, 10.0), (20.0, 30.0), (61.3, 0.5)):
        inside = (times > start) & (times < start + duration)
        assert ring.mean(start, duration) == pytest.approx(current[inside].mean(), rel=2e-4)


@pytest.mark.parametrize("ring", RINGS.values(), ids=RINGS)
@given(start=st.floats(0, 1e4), first=st.floats(1e-3, 100), second=st.floats(1e-3, 100))
def test_consecutive_exposures_collect_the_light_of_one_long_exposure(
    ring: RingCurrent, start: float, first: float, second: float
) -> None:
    apart = first * ring.mean(start, first) + second * ring.mean(start + first, second)
    assert (first + second) * ring.mean(start, first + second) == pytest.approx(apart, rel=1e-6)


def test_the_light_is_linear_in_the_exposure_while_the_current_stands() -> None:
    for ring in RINGS.values():
        assert ring.mean(7.0, 2e-3) == pytest.approx(ring.mean(7.0, 1e-3), rel=2e-5)  # to half of 1 ms / lifetime


def test_top_ups_start_and_end_when_they_are_said_to() -> None:
    clock, ramp = RINGS["by the clock"], RINGS["by the clock, with a ramp"]
    assert clock.mean(30.0 - SHORT, SHORT) == pytest.approx(math.exp(-0.3), rel=1e-5)
    assert clock.mean(30.0, SHORT) == pytest.approx(1.0, rel=1e-5)
    assert ramp.mean(26.0 - SHORT, SHORT) == pytest.approx(math.exp(-0.26), rel=1e-5)
    assert ramp.mean(28.0 - SHORT / 2, SHORT) == pytest.approx((1 + math.exp(-0.26)) / 2, rel=1e-5)
    share = RINGS["by the current"]
    falls = TAU * math.log(1 / 0.8)
    assert share.mean(5 * falls - SHORT, SHORT) == pytest.approx(0.8, rel=1e-5)
    assert share.mean(5 * falls + SHORT, SHORT) == pytest.approx(1.0, rel=1e-5)
