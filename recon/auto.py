"""Auto: the method that predicts views held out best, chosen on a part of the scan."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from recon.base.choices import AUTO
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.method import Method, ReconProblem, Reconstruction, RunControl, Traits
from recon.base.volume import Grid
from recon.methods import with_settings
from recon.splatting.finish import SWEEPS
from recon.splatting.initialise import leaves_the_field
from recon.splatting.r2 import R2
from recon.trials import of_views, part_of, predicts_best
from recon.voxels.direct import Fbp
from recon.voxels.methods.fista_tv import FistaTv


def _candidates() -> tuple[Method, ...]:
    # OS-SIRT-TV, a third of the cost, was nowhere the best by more than 0.02 dB (docs/notes/exploration.md).
    return R2(), FistaTv(), Fbp()


@dataclass(frozen=True, eq=False)
class Auto:
    """Tries methods on a part of the scan, and reconstructs the whole by the one that predicts unseen views best.

    The part is a slab of 32 rows where most matter is, with 8 rows where the sample is weakest. A cone's part is the
    rows in its middle, or all rows at half the resolution. One of eight views is held out. There is no trial with
    fewer than 16 views: the first candidate takes them. A sample wider than the field, which only a fit models, is not
    tried either. A volume that is too smooth misses the edges of unseen views, one that follows the noise misses them
    by its noise; so neither is preferred. Where methods are level, the first one is taken that leaves no structure in
    its own views. docs/choosing.md has all rules and their reasons.

    Attributes:
        candidates: the methods, by preference.
    """

    name: ClassVar[str] = AUTO
    label: ClassVar[str] = "Automatic choice"
    traits: ClassVar[Traits] = Traits(
        device=True, budget=True, needs_matter=True, halo=max(R2.traits.halo, FistaTv.traits.halo)
    )

    candidates: tuple[Method, ...] = field(default_factory=_candidates)

    @property
    def longer_fit(self) -> Method | None:
        """A fit with more sweeps, tried if the fit is not taken, and then preferred to all others.

        A fit chooses its sweeps by views that it already knows, so it makes too few if it is far off.
        """
        first = self.candidates[0]
        return with_settings(first, {"finish": 3 * SWEEPS}) if getattr(first, "finish", 0) is None else None

    @property
    def methods(self) -> tuple[Method, ...]:
        """All, by preference."""
        first, *others = self.candidates
        return self.candidates if self.longer_fit is None else (first, self.longer_fit, *others)

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        """The result of the chosen method; its settings say `chosen_method` and `chosen_because`.

        Raises:
            ValueError: no candidate takes these views or data.
        """
        decide = control.decide or Decisions(problem.seed)
        at, because = decide("method", lambda: self.choose(problem, control))
        chosen = self.methods[at]
        device = problem.device if chosen.traits.device else "cpu"
        found = chosen.run(replace(problem, device=device), control)
        settings = {**found.settings, "chosen_method": chosen.name, "chosen_because": because}
        return replace(found, settings=settings, method=chosen.name)

    def choose(self, problem: ReconProblem, control: RunControl) -> tuple[int, str]:
        """The chosen method and the reason."""
        wider = [n for n, method in enumerate(self.methods) if method.traits.any_grid]
        if wider and is_wider(problem):
            name = self.methods[wider[0]].name
            return wider[0], f"the sample is wider than the field, and only {name} models what is beyond it"
        part, where = part_of(problem)
        if part is None:
            return 0, where
        at, residuals = predicts_best(part, self.methods, control, None if self.longer_fit is None else 1)
        if at is None:
            return 0, residuals
        return at, f"residual of views held out, {where}: {residuals}"

    def toy(self) -> Self:
        return replace(self, candidates=tuple(method.toy() for method in self.candidates))

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        return max(method.memory(geometry, grid, weighted) for method in self.candidates)


def is_wider(problem: ReconProblem) -> bool:
    """Whether some views show that the sample leaves the field; only methods with the trait `any_grid` model this."""
    some = of_views(problem, np.arange(0, problem.geometry.n_views, max(1, problem.geometry.n_views // 32)))
    return leaves_the_field(masked(some.projections, some.use.weights)[0], some.geometry)
