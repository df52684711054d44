"""LastRound: how a fit whose views came one by one ends, as a method: a round over all views, and sweeps on voxels."""

from __future__ import annotations

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
        seconds: for the round and the sweeps.
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
        begin, stop, sweeps = control.now(), control.stop, self.method.finish_sweeps
        plan = FinishPlan(0, 0.0)
        if sweeps:
            plan = finish_within(FINISH_SHARE * self.seconds, 0.0, problem.geometry, problem.grid, control.now)
        history = list(self.before)

        def tell(progress: Progress) -> None:
            progress = replace(progress, seconds=control.now() - self.began)
            history.append(progress)
            if control.on_progress is not None:
                control.on_progress(progress)

        def on_progress(progress: Progress) -> bool:
            tell(progress)
            self.on_progress(progress)
            return stop()

        tell(self.fit.finish(max(begin + self.seconds - plan.seconds - control.now(), 0.0), on_progress))
        volume, gaussians = self.fit.snapshot(), self.fit.gaussians
        sweeps = sweeps if plan.sweeps is None else min(sweeps, plan.sweeps)
        if sweeps and gaussians is not None and not stop():
            late = replace(control.by(begin + self.seconds), stop_trials=None if plan.trials else lambda: True)
            volume, sweeps = finish(volume, gaussians, problem, sweeps, self.fit.settings, late)
        settings = {
            **asdict(self.fit.settings),
            "finish": sweeps,
            "seconds_after_scan": self.seconds,
            "gaussians": history[-1].n_gaussians,
        }
        seconds = control.now() - begin  # since the last view: before it the fit waited for views
        return Reconstruction(volume, settings, history, gaussians, method=self.method.name, seconds=seconds)

    def toy(self) -> Self:
        """The same: its kernels were compiled when the fit began."""
        return self

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        """Most bytes beside the projections: as the method that began the fit."""
        return self.method.memory(geometry, grid, weighted)
