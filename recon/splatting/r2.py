"""R2: the R²-Gaussian fit as a method, with the settings that its user chooses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

from recon.assess.time_model import PRESETS
from recon.base.choices import Quality, Start
from recon.base.empirical import DEFAULT_STEPS
from recon.base.geometry import Geometry
from recon.base.method import Clock, Plain, ReconProblem, Reconstruction, RunControl
from recon.base.setting import Count, Natural, NonNegative
from recon.base.volume import Grid
from recon.splatting.anytime import while_views_come
from recon.splatting.finish import FINISH_SWEEPS
from recon.splatting.fit_method import Fit
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import default_count
from recon.splatting.settings import DensityPolicy, FitSettings, growth
from recon.splatting.stream import StreamingFit
from recon.splatting.train import run_fit
from recon.splatting.trial_fit import FIRST_SHARE, predict
from recon.voxels.choice import Prediction, TrialChoice
from recon.voxels.methods import PnpDct
from recon.voxels.trial import Trial
from recon.voxels.voxel_problem import Buffers, bytes_of

_TOY_STEPS, _TOY_GAUSSIANS = 4, 50


@dataclass(frozen=True, eq=False)
class R2(Fit):
    """R²-Gaussian fit: Gaussians fitted to the views (Zha et al. 2024, refined).

    Attributes:
        steps: of the fit. 0 gives the starting point. None takes 400; with `seconds` it takes as many as fit.
        seconds: of the whole run, from the call to the volume: start, steps, finish and volume. The rates decay along
            it. It counts by the caller's clock, and with the time to compile where `warm_up` was not called. The
            start and one step are made in any case.
        gaussians: how many to start from, or the Gaussians to start from; None derives a number from the detector.
        start: the volume that Gaussians are drawn from, see `initialise.first_volume`.
        early_stop: end the fit when the residual of views held out has not fallen for a while, and return the model
        with the lowest residual.
        finish: sweeps over the views after the fit that refine its volume on voxels, see `finish.finish`; None gives 8,
            and a pull to few materials or steps with sparse patches as views held out prefer. The result's
            `gaussians` stay the model as it was fitted.
        allow_negative: the finish keeps voxels below zero; Gaussians have none.
        fit: weights, rates and limits.
    """

    name: ClassVar[str] = "r2"
    label: ClassVar[str] = "R²-Gaussian"
    halo: ClassVar[int] = 16
    error_bars: ClassVar[tuple[float, float] | None] = 2.2, 0.1

    steps: Natural | None = None
    seconds: NonNegative | None = None
    gaussians: Count | Gaussians | None = None
    start: Start = "fbp"
    early_stop: bool = False
    finish: Natural | None = None
    allow_negative: bool = False
    fit: FitSettings = field(default_factory=FitSettings)

    @property
    def planned_steps(self) -> int | None:
        """Number of steps that end the fit; None if only `seconds` do."""
        return DEFAULT_STEPS if self.steps is None and self.seconds is None else self.steps

    def for_trial(self, share: float, of_steps: float) -> Self:
        """The fit alone, of this share of the rows, with this share of the steps."""
        steps = None if self.planned_steps is None else round(of_steps * self.planned_steps)
        return replace(self.for_part(share, 1.0), steps=steps, finish=0)

    @property
    def finish_sweeps(self) -> int:
        return FINISH_SWEEPS if self.finish is None else self.finish

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        return run_fit(self, problem, control)

    @property
    def trial_sweeps(self) -> int:
        """Sweeps on voxels and steps of a trial, as a rule."""
        refined = FINISH_SWEEPS + PnpDct.iterations
        return PnpDct().trial_sweeps + round(FIRST_SHARE * (self.planned_steps or 0)) + refined

    def predict(self, trial: Trial, so_far: TrialChoice) -> Prediction:
        """The prediction of a fit by steps with the usual finish; of another one that of its volume."""
        other = self.finish is not None or self.seconds is not None or isinstance(self.gaussians, Gaussians)
        if other or self.early_stop or trial.prior is None:
            return trial.predicted(self)
        return predict(self, trial, so_far, trial.prior)

    def stream(self, template: Geometry, seed: int, now: Clock) -> StreamingFit:
        """A fit of future views, from this number of Gaussians.

        Settings of `fit` that differ from the defaults replace those of `WHILE_VIEWS_COME`.

        Raises:
            ValueError: as `StreamingFit`, or where the fit would start from Gaussians instead of a number.
        """
        if isinstance(self.gaussians, Gaussians):
            raise ValueError("a fit that follows a scan starts from a number of Gaussians, not from a model")
        return StreamingFit(template, seed=seed, gaussians=self.gaussians, settings=while_views_come(self.fit), now=now)

    def for_part(self, share: float, of_time: float) -> Self:
        """The fit of this share of a volume: its share of the Gaussians, in this share of the seconds."""
        count, seconds = self.gaussians, self.seconds
        return replace(
            self,
            gaussians=max(1, round(share * count)) if isinstance(count, int) else count,
            seconds=None if seconds is None else of_time * seconds,
        )

    @property
    def provenance(self) -> tuple[FitSettings, Mapping[str, Plain]]:
        assert not isinstance(self.gaussians, Gaussians)
        return self.fit, {"start": self.start, "gaussians": self.gaussians or 0}

    def with_quality(self, quality: Quality, default_count: int) -> Self:
        preset = PRESETS[quality]
        count = max(1, round(preset.share * default_count))
        return replace(self, steps=preset.steps, gaussians=count)

    def toy(self) -> Self:
        policy = None if self.fit.policy is None else DensityPolicy(start=0, every=1, threshold=0.0)
        rays = self.fit.rays
        if rays.exact_above < math.inf:
            rays = replace(rays, exact_above=0.0)  # so that the toy has exact rays, too
        fit = replace(self.fit, policy=policy, rays=rays, joined_pixels=min(self.fit.joined_pixels or 1, 2))
        return replace(self, steps=_TOY_STEPS, seconds=None, gaussians=_TOY_GAUSSIANS, early_stop=False, fit=fit)

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        given = self.gaussians.n if isinstance(self.gaussians, Gaussians) else self.gaussians
        count = given or default_count(geometry, grid.voxel_size)
        grown = growth(self.fit) / DensityPolicy.growth
        of_gaussians = round(1000 * grown * min(count, math.prod(grid.shape)))
        refined = bytes_of(Buffers(10, 9, 9, filtered=True), geometry, grid, weighted)
        return max(of_gaussians + refined, PnpDct().memory(geometry, grid, weighted))
