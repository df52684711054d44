"""Time limit: divides the seconds of a fit between its start, steps, voxel refinement and volume."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import ClassVar, NamedTuple, Self

import numpy as np

from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.method import Clock, Progress, ReconProblem, Reconstruction, RunControl
from recon.base.method_kinds import Iterative
from recon.base.volume import Grid
from recon.splatting.finish import FINISH_SWEEPS, PULLED_SWEEPS, REFINEMENT, finish
from recon.splatting.fit_method import Fit
from recon.splatting.gaussians import Gaussians
from recon.splatting.splat import voxelize
from recon.splatting.stream import StreamingFit
from recon.voxels.choice import TRIALS
from recon.voxels.held_out import EARLY_CHOICE_SWEEPS, TRIAL_SWEEPS, choice_sweeps
from recon.voxels.methods import FistaTv, PnpDct
from recon.voxels.ordered_fista import MANY_SUBSETS, pull_methods, subsets_of
from recon.voxels.projector import Projector
from recon.voxels.trial import EARLY_TV_STEPS
from recon.voxels.voxel_problem import TotalVariationProx, difference_weights

FINISH_SHARE = 0.8
"""Largest share of the time after the first steps that the voxel refinement gets. It improves the volume more than most
fitting steps."""

# a fit may end with this many times the Gaussians of its start; filling the volume then takes this many times longer
_GROWTH = 1.5
_SLAB = 16  # number of slices that are filled to measure the time for the volume
_SWEPT_VIEWS = 8
# Work before the iterations of a voxel refinement, without the choice of its weight, in units of an iteration: the
# largest eigenvalue of a subset, projections and an FBP.
_EIGENVALUE_ROUNDS, _FIRST_SWEEPS = 6, 3


def sweep_seconds(geometry: Geometry, grid: Grid, now: Clock) -> float:
    """Time in s of one FISTA-TV iteration over all projections.

    The time is measured with forward and back-projections of a few projections and one proximal step of total
    variation.
    """
    sampled = geometry.select(np.arange(0, geometry.n_views, max(1, geometry.n_views // _SWEPT_VIEWS))[:_SWEPT_VIEWS])
    projector = Projector(sampled, grid)
    begin = now()
    x = projector.adjoint_lines(projector.forward_lines(np.ones((*grid.shape[1:], grid.shape[0]), np.float32)))
    projected = now()
    TotalVariationProx(x.shape, difference_weights(grid), True, EARLY_TV_STEPS)(x, float(x.max()) / 100)
    parts = subsets_of(geometry, MANY_SUBSETS, to_the_end=False)
    return (projected - begin) * geometry.n_views / sampled.n_views + (now() - projected) * parts


def fill_seconds(gaussians: Gaussians, grid: Grid, now: Clock) -> float:
    """Time in s to fill the grid at the end of a fit that starts with these Gaussians, measured on a slab."""
    slab = replace(grid, shape=(min(_SLAB, grid.shape[0]), *grid.shape[1:]))
    begin = now()
    voxelize(gaussians, slab)
    return (now() - begin) * grid.shape[0] / slab.shape[0] * _GROWTH


class FinishPlan(NamedTuple):
    """Plan of a voxel refinement: iterations, seconds and test reconstructions.

    Attributes:
        sweeps: number of total-variation iterations; None: the default number, followed by PnP-DCT steps.
        seconds: expected duration.
        trials: True: test reconstructions choose the regularisation with held-out projections. False: the
            regularisation is total variation, with a weight from the noise.
    """

    sweeps: int | None
    seconds: float
    trials: bool = True


def finish_within(seconds: float, seconds_after_steps: float, geometry: Geometry, grid: Grid, now: Clock) -> FinishPlan:
    """Plan the voxel refinement of a fit within `seconds`.

    `seconds_after_steps` is the time that the fitting steps leave. If it and `seconds` are enough, the plan is the
    default refinement with PnP-DCT and test reconstructions. Otherwise the plan has at most the usual number of
    iterations. If time is short, the weight is chosen without test reconstructions. (For few rows, test reconstructions
    take longer than seven refinements.) If there is time for fewer than two iterations, the plan has no iterations,
    because the work before the iterations takes longer than two of them.
    """
    if seconds <= 0:
        return FinishPlan(0, 0.0)
    sweep = sweep_seconds(geometry, grid, now)
    setup_seconds = (_EIGENVALUE_ROUNDS / subsets_of(geometry, MANY_SUBSETS, to_the_end=False) + _FIRST_SWEEPS) * sweep
    choice_seconds, patches = choice_sweeps(geometry, early=True) * sweep, PnpDct()
    full_seconds, available = setup_seconds + FINISH_SWEEPS * sweep, seconds
    if choice_seconds:  # otherwise there are too few projections to hold some out, and PnP-DCT is not tried
        trials_of_patches = EARLY_CHOICE_SWEEPS + TRIAL_SWEEPS + TRIALS * patches.trial_steps
        rejected_sweeps = sum(each.refused_sweeps for each in pull_methods(iterations=PULLED_SWEEPS))
        full_seconds += (
            patches.iterations * sweep + choice_seconds * (trials_of_patches + rejected_sweeps) / EARLY_CHOICE_SWEEPS
        )
        available = min(seconds, seconds_after_steps)
    if full_seconds <= available:
        return FinishPlan(None, full_seconds)
    trials = setup_seconds + choice_seconds + FINISH_SWEEPS * sweep <= seconds
    setup_seconds += choice_seconds if trials else 0.0
    if not setup_seconds + 2 * sweep <= seconds:
        return FinishPlan(0, 0.0)
    sweeps = min(FINISH_SWEEPS, int((seconds - setup_seconds) / sweep)) if sweep > 0 else FINISH_SWEEPS
    return FinishPlan(sweeps, setup_seconds + sweeps * sweep, trials)


def planned_finish(method: Fit, remaining: float, steps: float, problem: ReconProblem, now: Clock) -> FinishPlan:
    """The plan for the voxel refinement of a method, within its share of the remaining seconds. The fitting steps take
    `steps` of these seconds.

    If there is time for two iterations, and the method states a number of iterations, the plan has this number.
    """
    available, geometry = FINISH_SHARE * remaining, problem.geometry.at_row(0)
    plan = finish_within(available, remaining - steps, geometry, problem.grid, now)
    return plan if method.finish is None or plan.sweeps == 0 else plan._replace(sweeps=method.finish, seconds=available)


@dataclass(frozen=True, eq=False)
class FinalFit(Iterative):
    """The final fit after a scan, to the projections that have arrived, and the voxel refinement after it.

    Attributes:
        fit: the fit during the scan. It contains the line integrals of the problem in the same order, except laterally
            offset projections.
        method: the method that started the fit.
        seconds: time limit for the final fit and the voxel refinement.
        began: time at which the fit began to wait for projections, by the clock of the run. `Progress.seconds` counts
            from this time.
        before: progress of the fit so far.
        on_progress: function that also gets each progress of the final fit, at moments at which the fit may be read.
    """

    fit: StreamingFit
    method: Fit
    seconds: float
    began: float
    before: Sequence[Progress] = ()
    on_progress: Callable[[Progress], None] = lambda progress: None

    name: ClassVar[str] = "the final fit"
    label: ClassVar[str] = "Final fit after a scan"

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        """The volume, labelled with the name of the method that started the fit.

        Raises:
            ValueError: no projection has arrived, or the projections show no material.
        """
        begin, stop, decide = control.now(), control.stop, control.decide or Decisions(problem.seed)
        end, history = begin + self.seconds, list(self.before)
        plan = FinishPlan(0, 0.0)
        if self.method.finish_sweeps:
            round_seconds = self.fit.last_steps * self.fit.step_seconds
            plan = planned_finish(self.method, self.seconds, round_seconds, problem, control.now)

        def tell(progress: Progress) -> None:
            progress = replace(progress, seconds=control.now() - self.began)
            history.append(progress)
            control.tell(progress)

        def on_progress(progress: Progress) -> bool:
            tell(progress)
            self.on_progress(progress)
            return stop()

        tell(self.fit.finish(max(end - plan.seconds - control.now(), 0.0), on_progress))
        volume, gaussians, reached, sweeps = self.fit.snapshot(problem.grid), self.fit.gaussians, history[-1], 0
        if plan.sweeps != 0 and gaussians is not None and not stop():
            limited_control = replace(control.by(end), decide=decide, stop_trials=None if plan.trials else lambda: True)
            if problem.wide:
                # Gaussians from a fit during the scan do not determine the offset in the middle: -2 dB on grains.
                refined = FistaTv(half_voxels=False).run(problem, limited_control)  # as its memory is stated
                volume, sweeps = refined.volume, len(refined.history)
                decide.settings[REFINEMENT] = FistaTv.name
                plan = plan._replace(sweeps=self.method.finish)
            else:
                volume, sweeps = finish(volume, gaussians, problem, plan.sweeps, self.fit.settings, limited_control)
        # The time limit may also cut PnP-DCT steps, which the number of iterations does not show.
        finished = plan.sweeps == self.method.finish and (sweeps == plan.sweeps or control.now() < end)
        if not ((finished and reached.step >= reached.steps) or stop.stopped):
            refinement = "complete" if finished else "shorter" if sweeps else "left out"
            warnings.warn(
                "to get the full quality, reconstruct the finished scan: "
                f"{self.seconds:g} s were not enough for the final fit. The fit made {reached.step} of "
                f"{reached.steps} steps, and the voxel refinement was {refinement}",
                stacklevel=2,
            )
        settings = {
            **asdict(self.fit.settings),
            "finish": sweeps,
            "seconds_after_scan": control.now() - begin,
            "gaussians": reached.n_gaussians,
            **decide.record,
        }
        seconds = control.now() - self.began
        return Reconstruction(volume, settings, history, gaussians, method=self.method.name, seconds=seconds)

    def toy(self) -> Self:
        """The same method, because its kernels were compiled when the fit started."""
        return self

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        """Peak memory in bytes without the projections: that of the method that started the fit."""
        return self.method.memory(geometry, grid, weighted)
