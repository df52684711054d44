"""How many steps a fit takes: fewer where noise hides what more would gain, else as many as asked for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import recon
from recon.base.decisions import Decisions
from recon.base.kernel import Kernel
from recon.splatting import optimise as fit
from recon.splatting.finish import FinishTrial
from recon.splatting.gaussians import Gaussians
from recon.splatting.schedule import DEFAULT_STEPS, SHORT_STEPS, TRIAL_AT, Schedule, residual_over_noise
from recon.splatting.settings import FitSettings
from recon.splatting.splat import project
from recon.voxels.held_out_weight import Preferred
from recon.voxels.voxel_problem import VoxelProblem

pytestmark = pytest.mark.usefixtures("one_thread")

VIEWS = recon.Geometry.parallel(np.linspace(0, np.pi, 8, endpoint=False), (8, 32))
GRID = recon.Grid.matching(VIEWS)
RNG = np.random.default_rng(0)
BALLS = Gaussians.from_physical(
    RNG.uniform((-6, -6, -3), (6, 6, 3), (40, 3)), np.full(40, 2.0), np.full(40, 0.05), density_unit=0.05
)
CLEAN = project(BALLS, VIEWS).numpy()
NOISE = RNG.normal(size=CLEAN.shape).astype(np.float32)
TINY = recon.R2(gaussians=40, fit=FitSettings(ssim_weight=0.0, tv_weight=0.0))


def steps_of(noise: float, method: recon.R2 = TINY, **others: Any) -> int:
    return int(recon.reconstruct(CLEAN + noise * NOISE, VIEWS, method, **others).settings["steps"])


def test_noisy_views_are_worth_half_of_the_steps() -> None:
    assert steps_of(0.3) == SHORT_STEPS
    assert steps_of(0.001) == DEFAULT_STEPS


def test_steps_that_are_asked_for_are_taken() -> None:
    assert steps_of(0.3, replace(TINY, steps=260)) == 260
    assert steps_of(0.3, replace(TINY, finish=0)) == DEFAULT_STEPS  # nothing makes up for them


def test_a_shortened_fit_goes_on_from_its_rates_to_the_last_ones() -> None:
    schedule = Schedule(DEFAULT_STEPS, by_content=True)
    before = [schedule.fraction(step, 0.0) for step in range(101)]
    problem = fit.problem_of(CLEAN + 0.3 * NOISE, VIEWS, GRID, 0.05, FitSettings())
    state = fit.init(BALLS, 0)
    state.step, state.residual = 100, 0.0
    schedule.look(state, problem)
    after = [schedule.fraction(step, 0.0) for step in range(100, SHORT_STEPS + 1)]
    assert schedule.steps == SHORT_STEPS and after[0] == before[-1] and after[-1] == 1.0
    assert (np.diff(before + after[1:]) > 0).all()
    assert vars(Schedule.resumed(Schedule(DEFAULT_STEPS, by_content=True), schedule.arrays())) == vars(schedule)


def test_a_fit_that_is_not_worth_its_steps_ends_after_a_hundred() -> None:
    schedule = Schedule(DEFAULT_STEPS, by_content=True)
    assert schedule.least(TRIAL_AT, True) == 100 and schedule.least(TRIAL_AT, False) == SHORT_STEPS
    assert schedule.least(100, False) == Schedule(DEFAULT_STEPS).least(1, True) == 0
    schedule.after_trial(FinishTrial(0, 2.0, 0.5), TRIAL_AT)
    assert schedule.steps == DEFAULT_STEPS and schedule.least(TRIAL_AT + 1, True) == SHORT_STEPS
    schedule.after_trial(FinishTrial(16, 2.0, 0.5), TRIAL_AT)
    assert schedule.steps == 100 and schedule.least(TRIAL_AT + 1, True) == 0
    after = [schedule.fraction(step, 0.0) for step in range(TRIAL_AT, 101)]
    assert after[0] == TRIAL_AT / DEFAULT_STEPS and after[-1] == 1.0 and (np.diff(after) > 0).all()
    assert vars(Schedule.resumed(Schedule(DEFAULT_STEPS, by_content=True), schedule.arrays())) == vars(schedule)


@pytest.mark.parametrize(
    ("left", "sweeps"),
    [([1.1, 0.99, 0.97], 0), ([1.3], 0), ([1.1, 1.02, 1.0], 24), ([1.1, 0.994, 0.99], 16), ([0.99, 1.0], 8)],
)
def test_a_fit_is_worth_its_steps_where_it_helps_to_predict_views(
    left: list[float], sweeps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Residuals of views held out, round for round: 1 with total variation alone. The finish of a fit that is ended
    takes the sweeps of the trial, and its weight, which are found once; others ask for their sweeps again."""
    searches: list[float] = []

    def search(problem: VoxelProblem, first: float) -> Preferred:
        searches.append(first)
        return Preferred(first, 1.0)

    for module in ("recon.splatting.finish", "recon.voxels.held_out_weight"):
        monkeypatch.setattr(f"{module}.preferred_weight", search)
    monkeypatch.setattr("recon.splatting.finish.residuals_of_rounds", lambda *_: left)
    monkeypatch.setattr("recon.splatting.finish.preferred_sweeps", lambda *_: 9)
    monkeypatch.setattr("recon.splatting.finish.bregman_weight", lambda *_: None)
    decide = Decisions()
    control = recon.RunControl(decide=decide)
    found = recon.reconstruct(CLEAN + 0.01 * NOISE, VIEWS, TINY, control=control)
    assert found.settings["steps"] == (100 if sweeps else DEFAULT_STEPS)
    assert found.settings["finish"] == (sweeps or 9)
    assert decide.made["weight"] == [[pytest.approx(searches[0])]] and len(searches) == 1
    asked = recon.reconstruct(CLEAN + 0.01 * NOISE, VIEWS, replace(TINY, steps=60))
    assert asked.settings["steps"] == 60 and len(searches) == 2


def test_a_fit_taken_up_again_is_shortened_as_the_one_that_was_not_left() -> None:
    data, left = CLEAN + 0.3 * NOISE, []
    for at in (60, 180):
        seen: list[int] = []

        def stop(at: int = at, seen: list[int] = seen) -> bool:
            seen.append(1)
            return len(seen) >= at

        part = recon.reconstruct(data, VIEWS, TINY, control=recon.RunControl(stop))
        assert part.settings["steps"] == at
        left.append(recon.reconstruct(data, VIEWS, TINY, control=recon.RunControl(resume=part.checkpoint)))
    whole = recon.reconstruct(data, VIEWS, TINY)
    for resumed in left:
        np.testing.assert_array_equal(resumed.volume.data, whole.volume.data)


def test_a_fit_that_is_left_during_its_trial_asks_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """It was left at step 51 without the answer, and took all 400 steps instead of 100."""
    left: list[bool] = []
    monkeypatch.setattr("recon.splatting.finish.residuals_of_rounds", lambda *_: [0.99])

    def search(problem: VoxelProblem, first: float) -> Preferred:
        left.append(True)
        problem.trial_goes_on()
        return Preferred(first, 1.0)

    monkeypatch.setattr("recon.splatting.finish.preferred_weight", search)
    part = recon.reconstruct(CLEAN + 0.01 * NOISE, VIEWS, TINY, control=recon.RunControl(lambda: bool(left)))
    assert part.settings["steps"] == TRIAL_AT
    again = recon.reconstruct(CLEAN + 0.01 * NOISE, VIEWS, TINY, control=recon.RunControl(resume=part.checkpoint))
    assert again.settings["steps"] == 100 and len(left) == 2


@pytest.mark.parametrize("trial", [[], [1.0, 2.0], [1.0, np.nan, 1.0], [0.0, -1.0, 1.0], [1.0] * 5])
def test_a_checkpoint_whose_trial_is_none_is_refused(trial: list[float]) -> None:
    with pytest.raises(ValueError, match="trial of the checkpoint is"):
        Schedule.resumed(
            Schedule(DEFAULT_STEPS, by_content=True),
            {"schedule": np.array([400.0, 0.0, 0.0]), "trial": np.array(trial)},
        )


def test_the_residual_is_measured_in_the_noise_of_a_pixel() -> None:
    """By numpy, for a model that explains the views but for their noise."""
    problem = fit.problem_of(CLEAN + 0.02 * NOISE, VIEWS, GRID, 0.05, FitSettings(kernel=Kernel.GAUSSIAN))
    state = fit.init(BALLS, 0)
    state.residual = fit.misfit_of(state, problem, FitSettings())
    off = 0.02 * NOISE / problem.scale
    expected = np.sqrt(np.mean(off**2)) / problem.noise
    assert residual_over_noise(state, problem) == pytest.approx(expected, rel=0.02)
