"""Trigger trains: every projection gets its pulse at a whole count, for any plan and direction of the stage."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from beamline.plan import plan as angles
from beamline.plan.limits import Scale, plan_flight
from drivers.base.protocols import TriggerTrain
from tests.refused_calls import refused_calls

COUNTS = st.sampled_from([7200, 36_000, 360_000, 1_048_576])


def stage(counts_per_turn: int = 360_000, zero: int = 0, direction: int = 1) -> Callable[[float], int]:
    return lambda angle: zero + direction * round(angle / (2 * math.pi) * counts_per_turn)


@given(counts=COUNTS, zero=st.integers(-(10**6), 10**6), direction=st.sampled_from([-1, 1]), turn=st.floats(-7, 7))
def test_scale_inverts_the_stage(counts: int, zero: int, direction: int, turn: float) -> None:
    to_counts = stage(counts, zero, direction)
    back = Scale.of(to_counts).angles(np.array([to_counts(turn)]))[0]
    assert back == pytest.approx(turn, abs=math.pi / counts + 1e-9)


def _walk(train: TriggerTrain) -> list[int]:
    """A stage that goes through a pass count by count, and the pulses of its position compare."""
    way = int(math.copysign(1, train.interval))
    path = range(train.start - 3 * way, train.end + 4 * way, way)
    return [c for c in path if (c - train.start) * way >= 0 and (c - train.start) % train.interval == 0][: train.n]


@given(
    views=st.integers(2, 60),
    counts=COUNTS,
    zero=st.integers(-1000, 1000),
    direction=st.sampled_from([-1, 1]),
    start=st.floats(-3, 3),
    span=st.floats(0.5, 6.2) | st.floats(-6.2, -0.5),
)
def test_fixed_plans_fly_in_one_train(
    views: int, counts: int, zero: int, direction: int, start: float, span: float
) -> None:
    to_counts = stage(counts, zero, direction)
    theta = angles.fixed(views, start, span)
    flight = plan_flight(theta, to_counts)
    (train,) = flight.trains
    assert train.n == views
    assert math.copysign(1, train.interval) == direction * math.copysign(1, span)
    # Rounding the step by at most half a count moves the last view by at most half a count a step, and the start's own.
    triggered = Scale.of(to_counts).angles(flight.counts())
    assert np.abs(triggered - theta).max() <= views * math.pi / counts + 1e-9
    assert flight.drift == pytest.approx(np.abs(triggered - theta).max())
    assert abs(train.end - train.start) == flight.interval * (views - 1)
    assert flight.exact == pytest.approx(abs(span) / views / (2 * math.pi) * counts)


@given(per_pass=st.integers(2, 12), passes=st.integers(1, 8), counts=COUNTS, span=st.sampled_from([math.pi, -math.pi]))
def test_interlaced_passes_are_trains(per_pass: int, passes: int, counts: int, span: float) -> None:
    views = per_pass * passes
    theta = angles.interlaced(views, passes, 0.0, span)
    flight = plan_flight(theta, stage(counts))
    assert [train.n for train in flight.trains] == [per_pass] * passes
    assert len({train.interval for train in flight.trains}) == 1
    assert flight.interval == passes * flight.step
    # As many pulses as views, one after another as planned, and all on one lattice with no two alike.
    pulses = flight.counts()
    assert pulses.size == theta.size
    if counts <= 36_000:
        assert [count for train in flight.trains for count in _walk(train)] == pulses.tolist()
    lattice = np.sort(pulses)
    np.testing.assert_array_equal(np.diff(lattice), flight.interval // passes)
    assert np.abs(Scale.of(stage(counts)).angles(pulses) - theta).max() <= views * math.pi / counts + 1e-9


def test_serpentine_and_text_files_fly_too() -> None:
    serpentine = angles.from_text("0\n2\n4\n5\n3\n1")
    trains = plan_flight(serpentine, stage()).trains
    assert [(train.start, train.interval, train.n) for train in trains] == [(0, 2000, 3), (5000, -2000, 3)]
    # Three digits after the point, as another program would write a sixth of a degree.
    text = "\n".join(f"{k / 6:.3f}" for k in range(1080))
    flight = plan_flight(angles.from_text(text), stage())
    assert len(flight.trains) == 1
    assert flight.interval == 167


@given(views=st.integers(3, 60), seed=st.integers(0, 999))
def test_random_views_cannot_fly(views: int, seed: int) -> None:
    theta = angles.random(views, rng=np.random.default_rng(seed))
    steps = np.diff(theta)
    assume(steps.max() > 1.1 * steps.min())
    with pytest.raises(ValueError, match=r"not equally spaced.*scan\.mode: step"):
        plan_flight(theta, stage())


test_calls_that_are_refused = refused_calls(__file__, globals())
