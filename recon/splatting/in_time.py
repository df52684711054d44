"""In time: divides a fit's seconds among its start, its steps, its finish on voxels, and its volume."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import ClassVar, NamedTuple, Self

import numpy as np

from recon.base.geometry import Geometry
from recon.base.method import Clock, Progress, ReconProblem, Reconstruction, RunControl, Traits
from recon.base.volume import Grid, Volume
from recon.splatting.finish import FINISH_SWEEPS, SUBSETS, TV_STEPS, finish
from recon.splatting.fit_method import StreamingMethod
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import sample_gaussians
from recon.splatting.splat import voxelize
from recon.splatting.stream import StreamingFit
from recon.voxels.held_out import CHOICE_SWEEPS, choice_sweeps
from recon.voxels.methods import PnpDct
from recon.voxels.priors import subsets_of
from recon.voxels.projector import Projector
from recon.voxels.voxel_problem import TotalVariationProx, difference_weights

FINISH_SHARE = 0.8
"""Largest share of the finish in the time after the first steps: it adds more than most steps before it."""

_GROWTH = 1.5  # a fit may end with so many times the Gaussians, and filling then takes so many times longer
_SLAB = 16  # slices that are filled to measure it
_DRAWN = 8  # slices that Gaussians are drawn from to measure it
_SWEPT_VIEWS = 8
_COLS = 96  # binned pixels of the views that time a start
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
    parts = subsets_of(geometry, SUBSETS)
    return (projected - begin) * geometry.n_views / some.n_views + (now() - projected) * parts


def first_sweep_seconds(geometry: Geometry, grid: Grid, now: Clock) -> float:
    """The same, estimated quickly at the beginning from binned pixels."""
    factor = max(1, min(geometry.detector_shape[1] // _COLS, geometry.detector_shape[0]))
    coarse = geometry.binned(factor)
    box = Grid.of_field(coarse, coarse.sample_pitch)
    share = math.prod(grid.shape) / math.prod(box.shape)
    return sweep_seconds(coarse, box, now) * share


def first_draw_seconds(grid: Grid, count: int, now: Clock) -> float:
    """Time to draw so many Gaussians from a first volume, measured on some slices of noise, which count as matter."""
    nz, ny, nx = grid.shape
    slices = min(_DRAWN, nz)
    slab, rng = grid.part(slice(0, slices), slice(0, ny), slice(0, nx)), np.random.default_rng(0)
    noise = Volume(rng.random(slab.shape, dtype=np.float32), slab)
    begin = now()
    sample_gaussians(noise, max(1, count * slices // nz), rng, field_radius=math.inf)
    return (now() - begin) * nz / slices


def fill_seconds(gaussians: Gaussians, grid: Grid, now: Clock) -> float:
    """Time to fill the grid at the end of a fit that starts from these Gaussians, measured on a slab."""
    slab = replace(grid, shape=(min(_SLAB, grid.shape[0]), *grid.shape[1:]))
    begin = now()
    voxelize(gaussians, slab)
    return (now() - begin) * grid.shape[0] / slab.shape[0] * _GROWTH


class FinishPlan(NamedTuple):
    """What a finish may take.

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
    before = (_EIGENVALUE_ROUNDS / subsets_of(geometry, SUBSETS) + _FIRST_SWEEPS) * sweep
    choice, patches = choice_sweeps(geometry) * sweep, PnpDct()
    most = before + (FINISH_SWEEPS + patches.iterations) * sweep + choice * patches.trial_sweeps / CHOICE_SWEEPS
    if choice and most <= min(seconds, beside_steps):
        return FinishPlan(None, most)
    trials = before + choice + FINISH_SWEEPS * sweep <= seconds
    before += choice if trials else 0.0
    if not before + 2 * sweep <= seconds:
        return FinishPlan(0, 0.0)
    sweeps = min(FINISH_SWEEPS, int((seconds - before) / sweep)) if sweep > 0 else FINISH_SWEEPS
    return FinishPlan(sweeps, before + sweeps * sweep, trials)


def _ignore(progress: Progress) -> None:
    pass


@dataclass(frozen=True, eq=False)
class LastRound:
    """The last round of a fit, over the views that it has learnt already, and the sweeps after it.

    Attributes:
        fit: holds the line integrals of the problem that it is run on, in the same order.
        method: that began the fit.
        seconds: for the round and the sweeps, at most.
        began: when the fit began to wait for views, by the clock of the run; `Progress.seconds` count from there.
        before: the progress of the fit until now.
        on_progress: is told of each progress of the round, too, while the fit can be looked at.
    """

    fit: StreamingFit
    method: StreamingMethod
    seconds: float
    began: float
    before: Sequence[Progress] = ()
    on_progress: Callable[[Progress], None] = _ignore

    name: ClassVar[str] = "the last round"
    label: ClassVar[str] = "Last round of a fit whose views came one by one"
    traits: ClassVar[Traits] = Traits()

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        """The volume, marked with the name of the method that began it.

        Raises:
            ValueError: no view has arrived, or the views hold no matter.
        """
        begin, stop = control.now(), control.stop
        end, history = begin + self.seconds, list(self.before)
        plan = self._finish_plan(problem, control)

        def tell(progress: Progress) -> None:
            progress = replace(progress, seconds=control.now() - self.began)
            history.append(progress)
            control.tell(progress)

        def on_progress(progress: Progress) -> bool:
            tell(progress)
            self.on_progress(progress)
            return stop()

        tell(self.fit.finish(max(end - plan.seconds - control.now(), 0.0), on_progress))
        volume, gaussians, reached, sweeps = self.fit.snapshot(), self.fit.gaussians, history[-1], 0
        if plan.sweeps != 0 and gaussians is not None and not stop():
            late = replace(control.by(end), stop_trials=None if plan.trials else lambda: True)
            volume, sweeps = finish(volume, gaussians, problem, plan.sweeps, self.fit.settings, late)
        whole = plan.sweeps == self.method.finish and reached.step >= reached.steps and control.now() < end
        if not (whole or stop.stopped):
            warnings.warn(
                f"{self.seconds:g} s did not suffice for the last round: {reached.step} of {reached.steps} steps, and "
                f"{'a whole' if plan.sweeps is None else 'a shorter' if sweeps else 'no'} finish on voxels. "
                "A reconstruction of the finished scan leaves nothing out",
                stacklevel=2,
            )
        settings = {
            **asdict(self.fit.settings),
            "finish": sweeps,
            "seconds_after_scan": control.now() - begin,
            "gaussians": reached.n_gaussians,
        }
        seconds = control.now() - self.began
        return Reconstruction(volume, settings, history, gaussians, method=self.method.name, seconds=seconds)

    def _finish_plan(self, problem: ReconProblem, control: RunControl) -> FinishPlan:
        """The finish that a fit of the whole scan has; less of it where the seconds are too few."""
        if not self.method.finish_sweeps:
            return FinishPlan(0, 0.0)
        beside = self.seconds - self.fit.last_steps * self.fit.step_seconds
        plan = finish_within(FINISH_SHARE * self.seconds, beside, problem.geometry, problem.grid, control.now)
        return plan if self.method.finish is None or plan.sweeps == 0 else plan._replace(sweeps=self.method.finish)

    def toy(self) -> Self:
        """The same: its kernels were compiled when the fit began."""
        return self

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        """Most bytes beside the projections: as the method that began the fit."""
        return self.method.memory(geometry, grid, weighted)
