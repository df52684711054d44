"""Auto: the method that predicts views held out best, chosen on a part of the scan."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from recon.base.choices import AUTO
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.method import ChoosingMethod, Method, ReconProblem, Reconstruction, RunControl, Traits
from recon.base.settings_check import check_settings
from recon.base.volume import Grid
from recon.base.work import CostedMethod, Costs, Work
from recon.splatting.finish import Candidates
from recon.splatting.fit_method import FitMethod
from recon.splatting.r2 import R2
from recon.splatting.train import trials_of
from recon.trials import LEFT, ROWS, part_of, predicts_best
from recon.voxels.direct import Fbp
from recon.voxels.held_out import TRIAL_ROWS
from recon.voxels.methods.fista_tv import FistaTv
from recon.voxels.methods.pnp_dct import PnpDct
from recon.voxels.work import trial_part


def _candidates() -> tuple[Method, ...]:
    return Fbp(), FistaTv(), PnpDct(), R2()


@dataclass(frozen=True, eq=False)
class Auto:
    """Tries methods on a part of the scan, and reconstructs the whole by the one that predicts unseen views best.

    The part is the sixteen rows where most matter is, of a cone those in its middle. One of eight views is held out,
    and the method that leaves least of these is taken. Where the middle of a cone holds little matter, or methods have
    settings of their own, each is run on 32 rows, or on all of them at half the resolution. Trials need at
    least 16 views; with fewer the last candidate is used. docs/choosing.md has reasons.

    Attributes:
        candidates: the methods, the simplest and cheapest first.
    """

    name: ClassVar[str] = AUTO
    label: ClassVar[str] = "Automatic choice"
    traits: ClassVar[Traits] = Traits(
        device=True, budget=True, needs_matter=True, halo=max(R2.traits.halo, FistaTv.traits.halo)
    )

    candidates: tuple[Method, ...] = field(default_factory=_candidates)

    def __post_init__(self) -> None:
        check_settings(self)
        if not self.candidates:
            raise ValueError("candidates must be at least one method, got none")

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        """The result of the chosen method, with the reason.

        Raises:
            ValueError: no candidate takes these views or data.
        """
        decide = control.decide or Decisions(problem.seed)
        at, because, tried = decide("method", lambda: self.choose(problem, control, decide))
        chosen = self.candidates[at]
        if tried and isinstance(chosen, ChoosingMethod):  # with its rivals
            chosen = chosen.as_candidate()
        device = problem.device if chosen.traits.device else "cpu"
        result = chosen.run(replace(problem, device=device), replace(control, decide=decide))
        settings = {**result.settings, "chosen_method": chosen.name, "chosen_because": because}
        return replace(result, settings=settings, method=chosen.name, chosen=because)

    def choose(self, problem: ReconProblem, control: RunControl, decide: Decisions) -> tuple[int, str, bool]:
        """Number of the chosen method, the reason, and whether there were trials.

        Methods that views held out judge in one trial, as `r2` does, are not run for it. `decide` takes its prior.
        """
        data = problem.projections
        if not any(np.isfinite(view).any() and np.nan_to_num(view, posinf=0, neginf=0).any() for view in data):
            raise ValueError("projections are zero everywhere: there is nothing to reconstruct")
        last = len(self.candidates) - 1
        fit = self._fit
        if fit is not None:
            listen = control.on_progress if control.decide is None else None  # in a slab only slices are counted
            tried = trials_of(fit, problem, replace(control, on_progress=listen))
            residuals = [_residual(method, tried) for method in self.candidates]
            if min(residuals) < math.inf:
                decide.preset(tried.prior)
                named = zip(self.candidates, residuals, strict=True)
                listed = "; ".join(f"{method.name} {each:.4g}" for method, each in named if each < math.inf)
                rows = min(TRIAL_ROWS, problem.geometry.detector_shape[0])
                return int(np.argmin(residuals)), f"trials on {rows} rows, {LEFT}: {listed}", True
        part, where = part_of(problem)
        if part is None:
            return last, where, False
        at, because = predicts_best(part, self.candidates, control)
        if at is None:
            return last, because, False
        return at, f"trials on {where}, {LEFT}: {because}", True

    @property
    def _fit(self) -> FitMethod | None:
        """The fit among the candidates, where one trial judges all of them; else None."""
        *others, last = self.candidates
        fits = last if isinstance(last, FitMethod) and last.by_content else None
        return fits if all(_judged_beside(method) for method in others) else None

    def toy(self) -> Self:
        return replace(self, candidates=tuple(method.toy() for method in self.candidates))

    def costs(self, geometry: Geometry, grid: Grid) -> Costs:
        """Of the trial that judges all candidates, or of one of each."""
        methods = [
            method.as_candidate() if isinstance(method, ChoosingMethod) else method for method in self.candidates
        ]
        costed = [method for method in methods if isinstance(method, CostedMethod)]
        part = trial_part(geometry, grid, ROWS)
        if part is None:
            return costed[-1].costs(geometry, grid)
        volumes = {name: work for method in costed for name, work in method.costs(geometry, grid).volumes.items()}
        fit = self._fit
        if isinstance(fit, CostedMethod):
            return Costs(volumes, fit.costs(geometry, grid).choice)
        trials = [work for method in costed for work in method.costs(*part).volumes.values()]
        return Costs(volumes, sum(trials, Work()))

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        return max(method.memory(geometry, grid, weighted) for method in self.candidates)


def _judged_beside(method: Method) -> bool:
    """The trial of a fit judges this method, too."""
    match method:
        case FistaTv():
            return method.tv_weight is None
        case PnpDct():
            return method.patch_threshold is None
    return isinstance(method, Fbp)


def _residual(method: Method, tried: Candidates) -> float:
    """Mean of what the method leaves of views held out; infinite where it was not tried."""
    of_voxels = {Fbp: tried.direct, FistaTv: tried.smooth, PnpDct: tried.patches}
    residuals = of_voxels.get(type(method), tried.fit)
    return math.inf if residuals is None else float(residuals.mean())
