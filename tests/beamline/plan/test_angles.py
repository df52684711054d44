"""Angle plans: laws that hold for every number of views, passes and span."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.plan import plan as angles
from beamline.plan.limits import CLOSING
from beamline.plan.plan import Mode, Retake, middle_of_exposure, retake_block, spread_retakes
from beamline.plan.timeline import work_out
from drivers.base.frame import FrameKind
from tests.beamline.fakes import FakeInstrument
from tests.refused_calls import refused_calls

VIEWS = st.integers(1, 400)
START = st.floats(-10, 10)
SPAN = st.floats(0.01, 2 * math.pi) | st.floats(-2 * math.pi, -0.01)


def _inside(theta: np.ndarray, start: float, span: float) -> bool:
    position = (theta - start) / span
    return bool(np.all((position >= -1e-12) & (position < 1)))


@given(views=VIEWS, start=START, span=SPAN)
def test_fixed_steps_are_equal_and_leave_out_the_end(views: int, start: float, span: float) -> None:
    theta = angles.fixed(views, start, span)
    assert theta.shape == (views,)
    assert theta[0] == start
    assert _inside(theta, start, span)
    np.testing.assert_allclose(np.diff(theta), span / views, rtol=0, atol=1e-12)
    # One more step would be the end: the circle (or half circle) closes without a view taken twice.
    assert theta[-1] + span / views == pytest.approx(start + span, abs=1e-12)


@given(views=VIEWS, first=START, last=START)
def test_sector_includes_both_ends(views: int, first: float, last: float) -> None:
    theta = angles.sector(views, first, last)
    assert theta.shape == (views,)
    assert theta[0] == first
    if views > 1:
        assert theta[-1] == last
        np.testing.assert_allclose(np.diff(theta), (last - first) / (views - 1), rtol=0, atol=1e-12)


@given(views=VIEWS, start=START, span=SPAN, seed=st.integers(0, 2**31))
def test_random_is_sorted_without_repeats_and_repeatable(views: int, start: float, span: float, seed: int) -> None:
    theta = angles.random(views, start, span, rng=np.random.default_rng(seed))
    assert theta.shape == (views,)
    assert _inside(theta, start, span)
    assert np.all(np.diff(theta) * np.sign(span) > 0)
    np.testing.assert_array_equal(theta, angles.random(views, start, span, rng=np.random.default_rng(seed)))


def test_pass_order_is_the_published_bit_reversal() -> None:
    # Mohan et al. 2015 (TIMBIR): K = 4 and K = 8 sub-frames.
    assert angles.pass_order(4).tolist() == [0, 2, 1, 3]
    assert angles.pass_order(8).tolist() == [0, 4, 2, 6, 1, 5, 3, 7]


@given(per_pass=st.integers(2, 40), passes=st.integers(1, 16), start=START, span=SPAN)
def test_interlaced_is_the_fixed_plan_in_another_order(per_pass: int, passes: int, start: float, span: float) -> None:
    views = per_pass * passes
    theta = angles.interlaced(views, passes, start, span)
    direction = math.copysign(1, span)
    np.testing.assert_array_equal(np.sort(theta * direction), angles.fixed(views, start, span) * direction)
    sweeps = theta.reshape(passes, per_pass)
    np.testing.assert_allclose(np.diff(sweeps, axis=1), passes * span / views, rtol=0, atol=1e-9)


@given(power=st.integers(1, 5), done=st.integers(1, 32))
def test_interlaced_gaps_halve(power: int, done: int) -> None:
    """After any number of passes no gap is more than twice the smallest (the point of bit reversal)."""
    passes = 1 << power
    done = min(done, passes)
    theta = np.sort(angles.interlaced(4 * passes, passes)[: 4 * done])
    gaps = np.diff(np.append(theta, theta[0] + math.pi))
    assert gaps.max() <= 2 * gaps.min() + 1e-9


@given(views=st.integers(2, 400), start=START, span=SPAN)
def test_golden_spreads_by_the_three_gap_theorem(views: int, start: float, span: float) -> None:
    """Any n multiples of an irrational cut the circle in at most three gap lengths, the largest the sum of the others.

    For the golden section the largest is at most phi**2 = 2.618 times the smallest.
    """
    theta = angles.golden(views, start, span)
    assert _inside(theta, start, span)
    position = np.sort((theta - start) / span)
    gaps = np.diff(np.append(position, position[0] + 1.0))
    lengths = np.unique(gaps.round(9))
    assert len(lengths) <= 3
    if len(lengths) == 3:
        assert lengths[2] == pytest.approx(lengths[0] + lengths[1], abs=3e-9)
    assert gaps.max() / gaps.min() < ((1 + math.sqrt(5)) / 2) ** 2 + 1e-6


def test_file_keeps_the_order() -> None:
    theta = angles.from_text("# from the last scan\n0\n 90.0  # quarter\n\n-45\r\n1e1\n")
    np.testing.assert_allclose(theta, [0, math.pi / 2, -math.pi / 4, math.pi / 18])


@given(st.lists(st.floats(-720, 720), min_size=1, max_size=50))
def test_file_round_trip(degrees: list[float]) -> None:
    text = "\n".join(repr(value) for value in degrees)
    np.testing.assert_array_equal(angles.from_text(text), np.deg2rad(degrees))


@pytest.mark.parametrize("step", [0.25, 0.5, 1.25, 0.001, 12.345])
def test_decimals_may_follow_a_comma(step: float) -> None:
    degrees = np.round(step * np.arange(-20, 20), 3)
    text = "\n".join(f"{each:.3f} # view".replace(".", ",") for each in degrees)
    np.testing.assert_allclose(np.degrees(angles.from_text(text)), degrees)


@given(st.integers(1, 200), st.integers(1, 60))
def test_the_choice_is_bounded_even_and_in_order(n: int, most: int) -> None:
    views = [Retake(10 + i, i) for i in range(n)]
    chosen = [view.trigger for view in spread_retakes(views, most)]
    assert len(chosen) == min(n, most)
    assert chosen == sorted(set(chosen)) and set(chosen) <= set(range(n))
    if most > 1:
        assert (chosen[0], chosen[-1]) == (0, n - 1)
        assert np.diff(chosen).max(initial=0) <= -(-(n - 1) // (len(chosen) - 1 or 1))


@pytest.mark.parametrize("passes", [1, 3])
def test_a_turning_stage_is_half_an_exposure_further_in_the_middle_of_it(passes: int) -> None:
    views = FakeInstrument().timeline(n=12, passes=passes).views
    assert middle_of_exposure(views) == pytest.approx(np.full(12, views.speed * 0.02 / 2))
    back = replace(views, angles=-views.angles)
    np.testing.assert_array_equal(middle_of_exposure(back), -middle_of_exposure(views))


def test_a_standing_stage_is_where_it_was_triggered() -> None:
    views = FakeInstrument().timeline(n=12, mode=Mode.STEP).views
    np.testing.assert_array_equal(middle_of_exposure(views), np.zeros(12))
    block = retake_block(views, np.array([3, 8]))
    assert (block.kind, block.mode, block.n, block.trains) == (FrameKind.PROJECTION, Mode.STEP, 2, ())
    np.testing.assert_array_equal(block.angles, views.angles[[3, 8]])


@pytest.mark.parametrize(("share", "most"), [(0.0, 0), (0.01, 1), (0.25, 3), (1.0, 12)])
def test_bytes_and_seconds_of_the_most_are_foreseen(share: float, most: int) -> None:
    instrument = FakeInstrument()
    stage, camera = instrument.stage, instrument.camera
    plan = replace(instrument.plan(n=12), retake_share=share)
    assert plan.retakes == most
    whole = work_out(plan, stage.limits, stage.to_counts, camera.timing)
    bare = work_out(replace(plan, retake_share=0.0), stage.limits, stage.to_counts, camera.timing)
    assert (whole.duration, whole.total_bytes) == (bare.duration, bare.total_bytes)
    said = [remark for remark in whole.remarks if "projections again" in remark]
    if most == 0:
        assert (said, whole.retake_seconds) == ([], 0.0)
        return
    assert f"up to {most} " in said[0]
    assert whole.retake_seconds > most * (plan.exposure + plan.settle)
    needed = round(1.1 * bare.total_bytes * (1 + most / bare.n_frames)) + CLOSING
    for free, fits in ((needed + 9, True), (needed - 9, False)):
        tried = work_out(plan, stage.limits, stage.to_counts, camera.timing, free_bytes=free)
        assert (tried.violations == ()) is fits


test_calls_that_are_refused = refused_calls(__file__, globals())
