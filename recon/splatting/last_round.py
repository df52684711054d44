"""LastRound ends a streaming fit, as a method: a last round over all views, then sweeps on voxels."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import ClassVar, Self

from recon.base.geometry import Geometry
from recon.base.method import Progress, ReconProblem, Reconstruction, RunControl, Traits
from recon.base.volume import Grid
from recon.splatting.finish import finish
from recon.splatting.fit_method import StreamingMethod
from recon.splatting.in_time import FINISH_SHARE, FinishPlan, finish_within
from recon.splatting.stream import StreamingFit


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
            if control.on_progress is not None:
                control.on_progress(progress)

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
