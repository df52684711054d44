"""Time limit: the seconds of a fit cover the whole run."""

from __future__ import annotations

import time

import numpy as np
import pytest

import recon
from recon import R2, Geometry, Grid, RunControl
from recon.base.decisions import Decisions
from recon.base.method import ReconProblem
from recon.base.view_data import Views
from recon.splatting.time_limit import FinishPlan, finish_within, planned_finish
from recon.voxels.projector import Projector
from tests.clock import SteppedClock

VIEWS = Geometry.cone(np.deg2rad(np.arange(61) * 360 / 61), (24, 40), 0.2, 100.0, 150.0)


@pytest.fixture(scope="module")
def data() -> np.ndarray:
    grid = Grid.matching(VIEWS)
    _, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    radius = grid.shape[2] * grid.voxel_size / 2
    disc = (np.hypot(x, y) < 0.6 * radius) & ~(np.hypot(x - 0.2 * radius, y) < 0.2 * radius)
    views = Projector(VIEWS, grid).forward((0.05 * disc).astype(np.float32))
    return views + np.random.default_rng(0).normal(0, 0.01, views.shape).astype(np.float32)


def test_a_finish_gets_as_many_sweeps_as_its_time_suffices_for() -> None:
    views = Geometry.parallel(np.linspace(0, np.pi, 24, endpoint=False), (6, 40))
    grid = Grid.matching(views)
    # 24 views in two subsets, a look a tick: 3 ticks of views, 2 steps of total variation; before the first sweep 6,
    # and four trials of 20 over seven of eight views where time is left for these.
    found = [
        finish_within(s, 0.0, views, grid, SteppedClock(tick=1.0)) for s in (0.0, 39.0, 40.0, 69.0, 419.0, 420.0, 1e3)
    ]
    none, trials = [(0, 0.0, True)] * 2, [(8, 420.0, True)] * 2
    assert found == [*none, (2, 40.0, False), (7, 65.0, False), (8, 70.0, False), *trials]
    # With patches, where time is left for their 35 steps, and for the trials of total variation, of few materials that
    # are refused, and of patches.
    found = [finish_within(2e3, spare, views, grid, SteppedClock(tick=1.0)) for spare in (1714.0, 1715.0)]
    assert found == [(8, 420.0, True), (None, 1715.0, True)]
    few = views.select(np.arange(12))  # of which none are held out: sweeps alone, on two subsets, are a whole finish
    assert [finish_within(s, 0.0, few, grid, SteppedClock(tick=1.0)).sweeps for s in (48.0, 49.0)] == [7, None]


def test_sweeps_that_are_given_keep_their_whole_share_of_the_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    views = Geometry.parallel(np.linspace(0, np.pi, 24, endpoint=False), (6, 40))
    problem = ReconProblem(Views(np.zeros((24, 6, 40), np.float32), views), Grid.matching(views))
    for found, given, planned in ((3, 20, (20, 80.0)), (0, 20, (0, 0.2)), (3, None, (3, 0.2))):
        monkeypatch.setattr("recon.splatting.time_limit.finish_within", lambda *_, found=found: FinishPlan(found, 0.2))
        plan = planned_finish(R2(finish=given), 100.0, 10.0, problem, SteppedClock(tick=1.0))
        assert (plan.sweeps, plan.seconds) == planned


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_the_seconds_bound_start_steps_finish_and_volume(data: np.ndarray) -> None:
    """In processor seconds: the time beyond them is at most that of a sweep, or of what measures it."""
    recon.reconstruct(data, VIEWS, R2(steps=4, gaussians=300), control=RunControl(should_stop=lambda: True))
    begin = time.process_time()
    found = recon.reconstruct(data, VIEWS, R2(seconds=2.0), control=RunControl(now=time.process_time))
    assert 0.5 < time.process_time() - begin < 2.4
    assert found.settings["steps"] > 3


@pytest.mark.usefixtures("one_thread")
def test_too_few_seconds_still_give_a_volume(data: np.ndarray) -> None:
    found = recon.reconstruct(data, VIEWS, R2(seconds=0.001, gaussians=300))
    assert found.settings["steps"] == 1 and found.settings["finish"] == 0
    assert np.isfinite(found.volume.data).all() and found.volume.data.max() > 0


@pytest.fixture(scope="module")
def parallel() -> tuple[np.ndarray, Geometry]:
    views = Geometry.parallel(np.linspace(0, np.pi, 24, endpoint=False), (2, 40))
    truth = np.random.default_rng(0).random((2, 40, 40)).astype(np.float32)
    return Projector(views, Grid.matching(views)).forward(truth), views


@pytest.mark.slow
def test_slabs_make_as_many_sweeps_as_the_first_one_decided(
    parallel: tuple[np.ndarray, Geometry], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seconds do not suffice for the same finish in every slab; another one would show as a seam."""
    decided = Decisions().made
    for found in (3, 0):
        monkeypatch.setattr("recon.splatting.time_limit.finish_within", lambda *_, found=found: FinishPlan(found, 0.3))
        control = RunControl(now=SteppedClock(tick=1e-3), decide=(decide := Decisions(followed=decided)))
        done = recon.reconstruct(*parallel, R2(seconds=0.4, gaussians=50), control=control)
        assert done.settings["finish"] == 3
        decided = decide.made


@pytest.mark.slow
def test_a_finish_without_time_for_trials_has_the_weight_by_the_noise(
    parallel: tuple[np.ndarray, Geometry], monkeypatch: pytest.MonkeyPatch
) -> None:
    for trials in (True, False):
        monkeypatch.setattr("recon.splatting.time_limit.finish_within", lambda *_, t=trials: FinishPlan(2, 0.3, t))
        control = RunControl(now=SteppedClock(tick=1e-3), decide=Decisions(), stop_trials=lambda: True)
        done = recon.reconstruct(*parallel, R2(seconds=0.4, gaussians=50), control=control)
        assert done.settings["finish"] == 2 and control.decide is not None
        assert len(control.decide.made["weight"][0]) == (1 if trials else 2)  # the weight, and the noise to follow
