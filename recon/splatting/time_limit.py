"""A time limit: divides a fit's seconds among its start, its steps, its finish on voxels, and its volume."""

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
from recon.splatting.finish import FINISH_SWEEPS, PULLED_SWEEPS, finish
from recon.splatting.fit_method import Fit
from recon.splatting.gaussians import Gaussians
from recon.splatting.splat import voxelize
from recon.splatting.stream import StreamingFit
from recon.voxels.choice import TRIALS
from recon.voxels.held_out import EARLY_CHOICE_SWEEPS, TRIAL_SWEEPS, choice_sweeps
from recon.voxels.methods import FistaTv, PnpDct
from recon.voxels.ordered_fista import MANY_SUBSETS, pull_methods, subsets_of
from recon.voxels.projector import Projector
from recon.voxels.trial import TV_STEPS
from recon.voxels.voxel_problem import TotalVariationProx, difference_weights

FINISH_SHARE = 0.8
"""Largest share of the finish in the time after the first steps: it adds more than most steps before it."""

_GROWTH = 1.5  # a fit may end with so many times the Gaussians, and filling then takes so many times longer
_SLAB = 16  # slices that are filled to measure it
_SWEPT_VIEWS = 8
# Work before the sweeps of a finish, beside the choice of its weight, in sweeps: the largest eigenvalue of a subset,
# projections and an FBP.
_EIGENVALUE_ROUNDS, _FIRST_SWEEPS = 6, 3


def sweep_seconds(geometry: Geometry, grid: Grid, now: Clock) -> float:
    """Time of a sweep of FISTA-TV over all views.

    It is measured on projections of a few views in both directions and one proximal step of total variation.
    """
    some = geometry.select(np.arange(0, geometry.n_views, max(1, geometry.n_views // _SWEPT_VIEWS))[:_SWEPT_VIEWS])
    projector = Projector(some, grid)
    begin = now()
    x = projector.adjoint_lines(projector.forward_lines(np.ones((*grid.shape[1:], grid.shape[0]), np.float32)))
    projected = now()
    TotalVariationProx(x.shape, difference_weights(grid), True, TV_STEPS)(x, float(x.max()) / 100)
    parts = subsets_of(geometry, MANY_SUBSETS, damped=False)
    return (projected - begin) * geometry.n_views / some.n_views + (now() - projected) * parts


def fill_seconds(gaussians: Gaussians, grid: Grid, now: Clock) -> float:
    """Time to fill the grid at the end of a fit that starts from these Gaussians, measured on a slab."""
    slab = replace(grid, shape=(min(_SLAB, grid.shape[0]), *grid.shape[1:]))
    begin = now()
    voxelize(gaussians, slab)
    return (now() - begin) * grid.shape[0] / slab.shape[0] * _GROWTH


class FinishPlan(NamedTuple):
    """Length of a finish: its sweeps, seconds and trials.

    Attributes:
        sweeps: of total variation; None: as many as it makes by default, and steps with sparse patches.
        seconds: that it will take.
        trials: views held out choose its prior; else it is total variation by the noise.
    """

    sweeps: int | None
    seconds: float
    trials: bool = True


def finish_within(seconds: float, beside_steps: float, geometry: Geometry, grid: Grid, now: Clock) -> FinishPlan:
    """A fit's finish within `seconds`: the usual sweeps at most, unless `beside_steps` suffice for patches and trials.

    Where time is short it goes without trials of its weight, which on few rows cost more than seven finishes. A time
    for fewer than two sweeps gives 0, because the work before them takes as long.
    """
    if seconds <= 0:
        return FinishPlan(0, 0.0)
    sweep = sweep_seconds(geometry, grid, now)
    before = (_EIGENVALUE_ROUNDS / subsets_of(geometry, MANY_SUBSETS, damped=False) + _FIRST_SWEEPS) * sweep
    choice, patches = choice_sweeps(geometry, early=True) * sweep, PnpDct()
    most, room = before + FINISH_SWEEPS * sweep, seconds
    if choice:  # else views are too few to hold some out, and patches are not tried
        trials_of_patches = EARLY_CHOICE_SWEEPS + TRIAL_SWEEPS + TRIALS * patches.trial_steps
        refused = sum(each.refused_sweeps for each in pull_methods(iterations=PULLED_SWEEPS))
        most += patches.iterations * sweep + choice * (trials_of_patches + refused) / EARLY_CHOICE_SWEEPS
        room = min(seconds, beside_steps)
    if most <= room:
        return FinishPlan(None, most)
    trials = before + choice + FINISH_SWEEPS * sweep <= seconds
    before += choice if trials else 0.0
    if not before + 2 * sweep <= seconds:
        return FinishPlan(0, 0.0)
    sweeps = min(FINISH_SWEEPS, int((seconds - before) / sweep)) if sweep > 0 else FINISH_SWEEPS
    return FinishPlan(sweeps, before + sweeps * sweep, trials)


def planned_finish(method: Fit, remaining: float, steps: float, problem: ReconProblem, now: Clock) -> FinishPlan:
    """The finish of a method in its share of the remaining seconds, of which all steps take `steps`.

    If the time suffices for two sweeps, the method's own number is used.
    """
    room, geometry = FINISH_SHARE * remaining, problem.geometry.at_row(0)
    plan = finish_within(room, remaining - steps, geometry, problem.grid, now)
    return plan if method.finish is None or plan.sweeps == 0 else plan._replace(sweeps=method.finish, seconds=room)


@dataclass(frozen=True, eq=False)
class FinalFit(Iterative):
    """The last round of a fit, over the views that it was already fitted to, and the sweeps after it.

    Attributes:
        fit: holds the line integrals of the problem that it is run on, in the same order, but for offset views.
        method: that began the fit.
        seconds: for the round and the sweeps, at most.
        began: when the fit began to wait for views, by the clock of the run; `Progress.seconds` count from there.
        before: the progress of the fit until now.
        on_progress: gets each progress of the round, too, while the fit can be looked at.
    """

    fit: StreamingFit
    method: Fit
    seconds: float
    began: float
    before: Sequence[Progress] = ()
    on_progress: Callable[[Progress], None] = lambda progress: None

    name: ClassVar[str] = "the last round"
    label: ClassVar[str] = "Last round of a fit whose views came one by one"

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        """The volume, marked with the name of the method that began it.

        Raises:
            ValueError: no view has arrived, or the views hold no matter.
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
            late = replace(control.by(end), decide=decide, stop_trials=None if plan.trials else lambda: True)
            if problem.wide:
                # Gaussians that learnt while views came leave the offset of the middle open: -2 dB on grains.
                made = FistaTv().run(problem, late)
                volume, sweeps = made.volume, len(made.history)
                plan = plan._replace(sweeps=self.method.finish)
            else:
                volume, sweeps = finish(volume, gaussians, problem, plan.sweeps, self.fit.settings, late)
        # The end cuts steps with patches, which no number of sweeps tells.
        finished = plan.sweeps == self.method.finish and (sweeps == plan.sweeps or control.now() < end)
        if not ((finished and reached.step >= reached.steps) or stop.stopped):
            warnings.warn(
                f"{self.seconds:g} s did not suffice for the last round: {reached.step} of {reached.steps} steps, and "
                f"{'a whole' if finished else 'a shorter' if sweeps else 'no'} finish on voxels. "
                "A reconstruction of the finished scan leaves nothing out",
                stacklevel=2,
            )
        settings = {
            **asdict(self.fit.settings),
            "finish": sweeps,
            "seconds_after_scan": control.now() - begin,
            "gaussians": reached.n_gaussians,
            **decide.settings,
        }
        seconds = control.now() - self.began
        return Reconstruction(volume, settings, history, gaussians, method=self.method.name, seconds=seconds)

    def toy(self) -> Self:
        """The same method: its kernels were compiled when the fit began."""
        return self

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        """Peak memory in bytes without the projections: that of the method that began the fit."""
        return self.method.memory(geometry, grid, weighted)
