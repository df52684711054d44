"""R2: the R²-Gaussian fit as a reconstruction method, with the settings that users choose."""

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
    """R²-Gaussian fit: fits a sum of Gaussians to the projections (Zha et al. 2024, with refinements).

    The learning rates decay over the time `seconds`, which includes the compilation of kernels, unless `warm_up` was
    called before. Even if `seconds` is too short, the fit places its first Gaussians and makes one step.
    `Reconstruction.gaussians` is the fitted model before the voxel refinement.

    Attributes:
        steps: number of steps; 0: the result is the starting point; None: 400 steps, or, if `seconds` is given, as many
            steps as the time allows.
        seconds: time limit of the whole run, which consists of the start, the steps, the voxel refinement and the
            volume. The time is that of `RunControl.now`.
        gaussians: number of Gaussians at the start, or the Gaussians to start from; None: a number derived from the
            detector.
        start: volume from which the first Gaussians are sampled, see `initialise.first_volume`.
        early_stop: stop the fit when the residual in held-out projections no longer falls, and return the model with
            the lowest residual.
        finish: iterations of the voxel refinement after the fit, see `finish.finish`; None: 8 iterations, then discrete
            levels or steps of PnP-DCT if one of these predicts held-out projections better.
        allow_negative: True: the voxel refinement keeps voxels below zero; Gaussians are never negative.
        fit: further settings of the fit: weights of the loss terms, learning rates and limits.
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
        """Number of steps after which the fit ends; None if only the time limit `seconds` ends it."""
        return DEFAULT_STEPS if self.steps is None and self.seconds is None else self.steps

    def for_trial(self, share: float, of_steps: float) -> Self:
        """The fit for a test reconstruction: without voxel refinement, with the fraction `share` of the Gaussians and
        of the steps."""
        steps = None if self.planned_steps is None else round(of_steps * self.planned_steps)
        return replace(self.for_part(share, 1.0), steps=steps, finish=0)

    @property
    def finish_sweeps(self) -> int:
        return FINISH_SWEEPS if self.finish is None else self.finish

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        return run_fit(self, problem, control)

    @property
    def trial_sweeps(self) -> int:
        """Usual number of voxel iterations and fitting steps, taken together, in a test reconstruction."""
        refined = FINISH_SWEEPS + PnpDct.iterations
        return PnpDct().trial_sweeps + round(FIRST_SHARE * (self.planned_steps or 0)) + refined

    def predict(self, trial: Trial, so_far: TrialChoice) -> Prediction:
        """The residuals of the method's volume in the held-out projections.

        The test makes a quarter of the steps of the fit. The test makes all steps only if a quarter of the steps does
        not decide whether the fit predicts best, see `trial_fit.predict`. The test runs the whole method unchanged,
        with its stopping rule and its voxel refinement, in these cases: `finish`, `seconds` or `early_stop` is set; the
        fit starts from given Gaussians; the trial could not choose a regularisation weight.
        """
        by_other_settings = self.finish is not None or self.seconds is not None or isinstance(self.gaussians, Gaussians)
        if by_other_settings or self.early_stop or trial.prior is None:
            return trial.predicted(self)
        weight = trial.early_weight
        return predict(self, trial, so_far, trial.prior if weight is None else trial.prior._replace(weight=weight))

    def stream(self, template: Geometry, seed: int, now: Clock) -> StreamingFit:
        """A fit that takes projections during a scan, and starts with `gaussians` Gaussians.

        The fit has the settings `WHILE_VIEWS_COME`; values of `fit` that differ from their defaults override them.

        Raises:
            ValueError: as for `StreamingFit`, or `gaussians` is a model instead of a number.
        """
        if isinstance(self.gaussians, Gaussians):
            raise ValueError("a fit during a scan cannot start from a given model; set gaussians to a number")
        return StreamingFit(template, seed=seed, gaussians=self.gaussians, settings=while_views_come(self.fit), now=now)

    def for_part(self, share: float, of_time: float) -> Self:
        """The same method for a part of a volume, with the fraction `share` of the Gaussians and the fraction `of_time`
        of the time limit.
        """
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
            rays = replace(rays, exact_above=0.0)  # so that the small example also runs the kernels for exact rays
        fit = replace(self.fit, policy=policy, rays=rays, joined_pixels=min(self.fit.joined_pixels or 1, 2))
        return replace(self, steps=_TOY_STEPS, seconds=None, gaussians=_TOY_GAUSSIANS, early_stop=False, fit=fit)

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        requested = self.gaussians.n if isinstance(self.gaussians, Gaussians) else self.gaussians
        count = requested or default_count(geometry, grid.voxel_size)
        grown = growth(self.fit) / DensityPolicy.growth
        of_gaussians = round(1000 * grown * min(count, math.prod(grid.shape)))
        refined = bytes_of(Buffers(10, 9, 9, filtered=True), geometry, grid, weighted)
        return max(of_gaussians + refined, PnpDct().memory(geometry, grid, weighted))
