"""Auto: the method that predicts views held out best, chosen on a part of the scan."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np

from recon.base.choices import AUTO
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.method import ChoosingMethod, Method, Progress, ReconProblem, Reconstruction, RunControl, Traits
from recon.base.volume import Grid
from recon.base.work import CostedMethod, Costs
from recon.splatting.initialise import leaves_the_field
from recon.splatting.r2 import R2
from recon.trials import ROWS, of_views, part_of, predicts_best
from recon.voxels.direct import Fbp
from recon.voxels.methods.fista_tv import FistaTv
from recon.voxels.methods.pnp_dct import PnpDct, prior_of
from recon.voxels.work import patch_choice, trial_part, weight_choice


def _candidates() -> tuple[Method, ...]:
    return Fbp(), FistaTv(), PnpDct(), R2()


@dataclass(frozen=True, eq=False)
class Auto:
    """Tries methods on a part of the scan, and reconstructs the whole by the one that predicts unseen views best.

    The part is a slab of 32 rows where most matter is. A cone's part is the rows in its middle, or all rows at half the
    resolution. One of eight views is held out. The method that leaves least of these is taken. There is no trial with
    fewer than 16 views, or of a sample wider than the field: the last one takes these. docs/choosing.md has reasons.

    Attributes:
        candidates: the methods, the simplest and cheapest first.
    """

    name: ClassVar[str] = AUTO
    label: ClassVar[str] = "Automatic choice"
    traits: ClassVar[Traits] = Traits(
        device=True, budget=True, needs_matter=True, halo=max(R2.traits.halo, FistaTv.traits.halo)
    )

    candidates: tuple[Method, ...] = field(default_factory=_candidates)

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        """The result of the chosen method; its settings say `chosen_method` and `chosen_because`.

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
        return replace(result, settings=settings, method=chosen.name)

    def choose(self, problem: ReconProblem, control: RunControl, decide: Decisions) -> tuple[int, str, bool]:
        """Number of the chosen method, the reason, and whether there were trials.

        The prior is sought once, on the whole, and `decide` takes it for the chosen method. (From the part's fewer
        views it costs 0.4 dB on a walnut.)
        """
        last = len(self.candidates) - 1
        wider = [n for n, method in enumerate(self.candidates) if method.traits.any_grid]
        if wider and is_wider(problem):
            name = self.candidates[wider[0]].name
            why = "views do not fall to zero at their edges, as of a sample wider than the field"
            return wider[0], f"{why}, and only {name} models what is beyond it", False
        part, where = part_of(problem)
        if part is None:
            return last, where, False
        prior: Mapping[str, Sequence[Any]] = {}
        same_pixels = part.geometry.pixel_pitch == problem.geometry.pixel_pitch
        if same_pixels and any(isinstance(method, PnpDct) for method in self.candidates):
            prior = prior_of(problem, _trial_of_prior(control, problem.geometry.n_views))
        at, residuals = predicts_best(part, self.candidates, control, prior=prior)
        if at is None:
            return last, residuals, False
        decide.preset(prior)
        return at, f"residual of views held out, {where}: {residuals}", True

    def toy(self) -> Self:
        return replace(self, candidates=tuple(method.toy() for method in self.candidates))

    def costs(self, geometry: Geometry, grid: Grid) -> Costs:
        """Of trials of all candidates; a sample wider than the field has none."""
        methods = [
            method.as_candidate() if isinstance(method, ChoosingMethod) else method for method in self.candidates
        ]
        costed = [method for method in methods if isinstance(method, CostedMethod)]
        part = trial_part(geometry, grid, ROWS)
        if part is None:
            return costed[-1].costs(geometry, grid)
        volumes = {name: work for method in costed for name, work in method.costs(geometry, grid).volumes.items()}
        trials = [work for method in costed for work in method.costs(*part).volumes.values()]
        return Costs(volumes, sum(trials, weight_choice(geometry, grid) + patch_choice(geometry, grid)))

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        return max(method.memory(geometry, grid, weighted) for method in self.candidates)


def is_wider(problem: ReconProblem) -> bool:
    """Whether some views show that the sample leaves the field; only methods with the trait `any_grid` model this."""
    some = of_views(problem, np.arange(0, problem.geometry.n_views, max(1, problem.geometry.n_views // 32)))
    return leaves_the_field(masked(some.projections, some.use.weights)[0], some.geometry)


def _trial_of_prior(control: RunControl, n_views: int) -> Callable[[], bool]:
    """Tells of each sweep of the trials of a prior, and asks whether to stop. In a slab only slices are counted."""
    begin, done = control.now(), 0

    def on_trial() -> bool:
        nonlocal done
        done += 1
        if control.on_progress is not None and control.decide is None:
            seconds = control.now() - begin
            control.on_progress(Progress(done, 0, seconds, math.nan, math.nan, 0, n_views, unit="sweeps of trials"))
        return control.should_stop is not None and control.should_stop()

    return on_trial
