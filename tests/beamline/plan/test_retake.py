"""Views to take again: a bounded, even choice, and a standing stage that shows what the turning one should have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.plan.plan import Mode
from beamline.plan.retake import Retake, middle_of_exposure, retake_block, spread
from beamline.plan.timeline import work_out
from drivers.base.frame import FrameKind
from tests.beamline.fakes import FakeInstrument


@given(st.integers(1, 200), st.integers(1, 60))
def test_the_choice_is_bounded_even_and_in_order(n: int, most: int) -> None:
    views = [Retake(10 + i, i) for i in range(n)]
    chosen = [view.trigger for view in spread(views, most)]
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
    said = [remark for remark in whole.remarks if "taken again" in remark]
    if most == 0:
        assert (said, whole.retake_seconds) == ([], 0.0)
        return
    assert f"up to {most} " in said[0]
    assert whole.retake_seconds > most * (plan.exposure + plan.settle)
    needed = round(1.1 * bare.total_bytes * (1 + most / bare.n_frames))
    for free, fits in ((needed + 9, True), (needed - 9, False)):
        tried = work_out(plan, stage.limits, stage.to_counts, camera.timing, free_bytes=free)
        assert (tried.violations == ()) is fits
