"""R2: the R²-Gaussian fit as a method, with the settings that its user chooses."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self, get_args

from recon.assess.plans import PRESETS, Quality
from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.base.method import PRECISION, Depth, MethodResult, Plain, ReconProblem, RunControl, Traits, TrialSettings
from recon.base.volume import Grid
from recon.splatting.density_control import DensityPolicy
from recon.splatting.finish import SWEEPS
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import Start, default_count
from recon.splatting.schedule import DEFAULT_STEPS
from recon.splatting.settings import FitSettings
from recon.splatting.stream import Clock, StreamingFit
from recon.splatting.train import run_fit
from recon.voxels.voxel_problem import iterative_memory

_TOY_STEPS, _TOY_GAUSSIANS = 4, 50

# What a trade-off tries, by depth.
_BASE_STEPS = {"quick": 250, "full": 1000}
_STEPS = {"quick": (60, 125, 250, 500), "full": (125, 250, 500, 1000, 2000)}
_FACTORS = {"quick": (0.25,), "full": (0.25, 0.5, 2.0)}
_BINNED_STEPS = {"quick": (250,), "full": (125, 500, 1000)}


@dataclass(frozen=True, eq=False)
class R2:
    """R²-Gaussian fit: Gaussians fitted to the views (Zha et al. 2024, refined).

    Attributes:
        steps: of the fit. 0 gives the starting point. None takes 400. It takes 200 where a finish follows and the noise
            of the views hides the gain of more (see `schedule.Schedule`). With `seconds` it takes as many as fit.
        seconds: of the whole run, from the call to the volume: start, steps, finish and volume. The rates decay along
            it. It counts by the caller's clock, and with the time to compile where `warm_up` was not called. Where they
            do not suffice for the start, a warning says so before it, and the start is made of binned views.
        gaussians: how many to start from, or the Gaussians to start from; None derives a number from the detector.
        start: the volume that Gaussians are drawn from, see `initialise.first_volume`.
        early_stop: end the fit when the residual of views held out has not fallen for a while, and return the model
            that had it lowest.
        finish: sweeps over the views after the fit that refine its volume on voxels, see `finish.finish`; None gives 8
            to 24 as views held out prefer. Rolled or tilted views have none, since the voxel projector does not take
            them. The result's `gaussians` stay the model as it was fitted.
        allow_negative: the finish keeps voxels below zero; Gaussians have none.
        fit: weights, rates and limits.
    """

    name: ClassVar[str] = "r2"
    label: ClassVar[str] = "R²-Gaussian"
    colour: ClassVar[str] = "tab:blue"
    traits: ClassVar[Traits] = Traits(
        device=True, held_out=True, checkpoints=True, presets=True, budget=True, any_grid=True, halo=16
    )

    steps: int | None = None
    seconds: float | None = None
    gaussians: int | Gaussians | None = None
    start: Start = "fbp"
    early_stop: bool = False
    finish: int | None = None
    allow_negative: bool = False
    fit: FitSettings = field(default_factory=FitSettings)

    def __post_init__(self) -> None:
        if self.start not in get_args(Start):
            raise ValueError(f"start must be one of {', '.join(get_args(Start))}, got {self.start!r}")
        if self.steps is not None and operator.index(self.steps) < 0:
            raise ValueError(f"steps must be 0 or more, got {self.steps}")
        if self.finish is not None and operator.index(self.finish) < 0:
            raise ValueError(f"finish must be 0 sweeps or more, got {self.finish}")
        if self.seconds is not None and not (math.isfinite(self.seconds) and self.seconds >= 0):
            raise ValueError(f"seconds must be a time of 0 or more, got {self.seconds}")

    @property
    def planned_steps(self) -> int | None:
        """Steps that end the fit; None where `seconds` alone do."""
        return DEFAULT_STEPS if self.steps is None and self.seconds is None else self.steps

    def finish_sweeps(self, geometry: Geometry) -> int:
        """Sweeps of the finish on these views."""
        if self.finish is None:
            return SWEEPS if geometry.is_straight else 0
        return self.finish

    def run(self, problem: ReconProblem, control: RunControl) -> MethodResult:
        return run_fit(self, problem, control)

    def stream(self, template: Geometry, seed: int, now: Clock) -> StreamingFit:
        """A fit of views to come; it takes of these settings the number of Gaussians alone.

        Raises:
            ValueError: as `StreamingFit`, or where the fit would start from Gaussians instead of a number.
        """
        if isinstance(self.gaussians, Gaussians):
            raise ValueError("a fit that follows a scan starts from a number of Gaussians, not from a model")
        return StreamingFit(template, seed=seed, gaussians=self.gaussians, now=now)

    def with_quality(self, quality: Quality, default_count: int) -> Self:
        """With the steps and Gaussians of a preset, for a grid that is worth `default_count` Gaussians."""
        preset = PRESETS[quality]
        count = max(1, round(preset.share * default_count))
        return replace(self, steps=preset.steps, gaussians=count)

    def toy(self) -> Self:
        policy = None if self.fit.policy is None else DensityPolicy(start=0, every=1, threshold=0.0)
        rays = self.fit.rays
        if rays.exact_above < math.inf:
            rays = replace(rays, exact_above=0.0)  # so that the toy has exact rays, too
        fit = replace(self.fit, policy=policy, rays=rays, coarse=min(self.fit.coarse, 2))
        return replace(self, steps=_TOY_STEPS, seconds=None, gaussians=_TOY_GAUSSIANS, early_stop=False, fit=fit)

    @classmethod
    def trials(cls, gaussians: int, depth: Depth) -> Sequence[TrialSettings]:
        base: dict[str, Plain] = {"steps": _BASE_STEPS[depth], "gaussians": gaussians}
        found = [TrialSettings("method", base)]
        found += [TrialSettings("steps", base | {"steps": n}) for n in _STEPS[depth] if n != base["steps"]]
        counts = [max(1, round(factor * gaussians)) for factor in _FACTORS[depth]]
        found += [TrialSettings("gaussians", base | {"gaussians": count}) for count in counts]
        # A bin of two halves the detail across: a quarter of the Gaussians describes it.
        coarse = max(1, gaussians // 4)
        found += [
            TrialSettings("binning", {"steps": steps, "gaussians": coarse}, binning=2) for steps in _BINNED_STEPS[depth]
        ]
        others = [kernel.value for kernel in Kernel if kernel is not FitSettings().kernel]
        found += [TrialSettings("kernel", base | {"fit.kernel": name}) for name in others]
        found.append(TrialSettings("start", base | {"start": "tv"}))
        found.append(TrialSettings("loss", base | {"fit.ssim_weight": 0.0}))
        found += [TrialSettings("loss", base | {"fit.loss": loss}) for loss in ("l2", "poisson")]
        return [*found, TrialSettings(PRECISION)]

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        count = self.gaussians.n if isinstance(self.gaussians, Gaussians) else self.gaussians or default_count(grid)
        of_gaussians = 1000 * min(count, math.prod(grid.shape))
        return of_gaussians + iterative_memory(geometry, grid, 10, 9, 9 * weighted, filtered=True)

    def work(self, n_views: int, binning: int) -> float:
        count = self.gaussians.n if isinstance(self.gaussians, Gaussians) else self.gaussians or 0
        spread = self.fit.kernel.reach(self.fit.truncation.sigmas) / FitSettings().kernel.radius
        return (self.planned_steps or 0) * (1 + count / 2e4 * spread**2)
