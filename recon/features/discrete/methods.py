"""Discrete tomography with partial voxels: total variation, then a pull to discrete levels if these predict better."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, ClassVar, Self

import numpy as np

from recon.base.arrays import F32
from recon.base.decisions import Decisions, MaterialPrior, Prior
from recon.base.empirical import STANDS_STILL
from recon.base.method import Plain, ReconProblem, Reconstruction, RunControl
from recon.base.setting import Count, NonNegative
from recon.base.volume import Volume
from recon.features.discrete.choose import COUNTS, WEAK_PULL, MaterialTrial, pull_to
from recon.features.discrete.mixture import NOISE, probabilities, undecided_share
from recon.voxels.choice import Prediction, TrialChoice
from recon.voxels.half_voxels import FEW_WITH_LEVELS, HalfVoxels
from recon.voxels.held_out import CHOICE_SWEEPS
from recon.voxels.iterative import VoxelMethod
from recon.voxels.methods import EarlyTv, FistaTv
from recon.voxels.ordered_fista import MANY_SUBSETS, SUBSETS, Subsets, ordered_fista, subsets_of
from recon.voxels.priors import TvWeight, tv_prox
from recon.voxels.projector import volume_lines
from recon.voxels.standstill import MOST_SWEEPS
from recon.voxels.trial import EARLY_TV_STEPS, TV_STEPS, Trial
from recon.voxels.voxel_problem import Buffers, VoxelProblem

MATERIALS, UNDECIDED, _OF = "materials", "undecided_share", "_of_materials"
"""Names of two decisions, and the end of the names of settings for the levels.

The decisions are the levels in the units of the scan, and the expected share of misclassified voxels (on the wrong side
of the middle between two levels).
"""
_REFIT_SWEEPS = 16  # number of iterations; error bars make a share of them
_TRIALS = 7  # usual number of test reconstructions with levels
# Number of them after which levels are rejected for the voxel refinement of a fit, usually at most: the numbers of
# levels, two more shares of total variation, a weaker pull, and further iterations of total variation. (2, if total
# variation alone predicts better.)
_TRIALS_TO_REJECT = len(COUNTS) + 4

# the reason that a volume without levels states
_NO_LEVELS = (
    "this is the volume of fista-tv, because no discrete levels were found that predict held-out projections better"
)
_REJECTED_IN_TRIAL = "no levels were found that pass all tests with held-out projections"


@dataclass(frozen=True)
class Discrete(HalfVoxels):
    """Discrete tomography: FISTA-TV, then min ½||A x - p||² + μ TV(x) + β Σ φ(x), x >= 0.

    φ pulls voxels to a few discrete grey levels, but not partial-volume voxels, which may lie between two levels; see
    `recon.features.discrete.mixture`. Memory: 10 volumes and 2 times the projections.

    Held-out projections choose the number of levels, their values, and the factor on the FISTA-TV weight μ. If no
    discrete levels pass all tests with held-out projections (see `MaterialTrial.choose`), the result is the FISTA-TV
    volume. If there are too few projections to hold some out, the result is also the FISTA-TV volume, unless `levels`
    are given: then voxels are pulled weakly to these levels. If the caller gives a volume to start from, the method
    uses total variation alone.

    Attributes:
        iterations: largest number of iterations over all projections, not counting the FISTA-TV iterations before them.
        levels: densities of the materials in 1/mm, ascending; None: found by expectation maximisation (EM).
        still, half_voxels: as in `FistaTv`.
        few: half voxels are used only if there are fewer projections than `few` times the number of columns; if no
            levels were found, the limit of `FistaTv` holds instead.
    """

    name: ClassVar[str] = "discrete"
    label: ClassVar[str] = "Discrete"
    takes: ClassVar[frozenset[str]] = frozenset({"device", "quality"})
    halo: ClassVar[int] = FistaTv.halo + 12
    error_bars: ClassVar[tuple[float, float] | None] = 3.0, 0.2
    buffers: ClassVar[Buffers] = Buffers(10.6, 3.0, 4.8, filtered=True)
    few: ClassVar[float] = FEW_WITH_LEVELS
    first_sweeps: ClassVar[int] = MOST_SWEEPS

    iterations: Count = MOST_SWEEPS
    levels: tuple[float, ...] | None = None
    still: NonNegative = STANDS_STILL
    allow_negative: bool = False
    half_voxels: bool | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.levels is not None and not (len(self.levels) > 1 and all(np.diff(self.levels) > 0)):
            raise ValueError(f"levels must be two or more values in ascending order, got {self.levels}")

    def refit(self, share: float) -> VoxelMethod:
        """The method of the refits for error bars: `EarlyTv`. The refit makes the fraction `share` of 16 iterations,
        because error bars were calibrated with 16 iterations.
        """
        return EarlyTv(iterations=max(1, round(share * _REFIT_SWEEPS)), allow_negative=self.allow_negative)

    @property
    def trial_sweeps(self) -> int:
        """Iterations of the test reconstructions for the weight of total variation and for the levels."""
        return CHOICE_SWEEPS + _TRIALS * self.usual_sweeps

    @property
    def refused_sweeps(self) -> int:
        """Largest number of iterations that the tests of discrete levels usually make before they reject the levels.

        The forecast of the time of a Gaussian fit includes these iterations: the voxel refinement after the fit tries
        PnP-DCT only after its tests have rejected the levels.
        """
        return _TRIALS_TO_REJECT * self.usual_sweeps

    @classmethod
    def probabilities(cls, volume: Volume, settings: Mapping[str, Any]) -> F32 | None:
        """[material, z, y, x] probability that a voxel belongs to a material, in ascending order of the levels.

        The probabilities of a voxel add up to less than 1; the difference from 1 is the probability that the voxel is a
        partial-volume voxel. The result is None if `settings` contains no discrete levels, because the volume was then
        not pulled to any levels.
        """
        fields: list[Any] = [settings.get(name + _OF, ()) for name in MaterialPrior._fields]
        if not len(fields[0]):
            return None
        of_lines = probabilities(volume_lines(volume.data), MaterialPrior(*fields))
        return np.ascontiguousarray(of_lines.transpose(0, 3, 1, 2))

    @classmethod
    def ended_by(cls, seconds: float) -> dict[str, Plain]:
        """No settings: a time limit cannot end discrete tomography, because it needs all iterations of its tests to
        find levels."""
        return {}

    def toy(self) -> Self:
        return replace(self, iterations=1, levels=(0.0, 1.0))

    def predict(self, trial: Trial, so_far: TrialChoice) -> Prediction:
        """How well the method predicts held-out projections: with the best discrete levels, or with total variation
        alone if no levels are better. If no levels are better, and a simpler candidate has already predicted with total
        variation alone, the method counts as not tried.
        """
        if trial.weight is None:
            return Prediction(
                self.name, remark=f"{self.name}: not tried, because no weight of total variation could be chosen"
            )
        trial_result = self._choice(trial, trial.weight)
        prior = Prior(trial.weight, materials=trial_result.materials)
        prediction = trial.prediction(self.name, trial_result.best, prior)
        same = any(each.residuals == prediction.residuals for each in so_far.predictions)
        if same and not (trial_result.materials.levels or trial.ended):
            return Prediction(self.name, remark=f"{self.name}: {_REJECTED_IN_TRIAL}")
        return prediction

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        decide = control.decide or Decisions(problem.seed)
        result = super().run(problem, replace(control, decide=decide))
        of_volume = decide.made.get(MATERIALS)
        if of_volume is None or MaterialPrior(*of_volume[-1]).levels:
            return result
        return replace(result, chosen=_NO_LEVELS)

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        without_levels = FistaTv(self.iterations, still=self.still, half_voxels=self.half_voxels)
        if x.any():  # a pull would hide the noise that the refits for error bars must show
            return without_levels.iterate(problem, x)
        trial = cache(partial(Trial.of, problem))
        x, weight = FistaTv(still=self.still).with_weight(problem, x, trial)
        materials, mu = self.materials(problem, weight, trial), weight.value
        if not problem.go_on.going:
            return x
        if materials is None:
            on_halves = without_levels.half_voxel_weight(problem, Prior(mu), trial)
            return without_levels.in_half_voxels(problem, x, mu, on_halves, TV_STEPS) if on_halves else x
        sweeps_before = 0 if problem.decide.ended is None else problem.decide.ended.after
        x = self.pulled(problem, x, weight, materials, self.first_sweeps)
        if (ended := problem.decide.ended) is not None:
            problem.decide.ended = ended._replace(after=sweeps_before + ended.after)
        if not problem.go_on.going:
            return x
        on_halves = self.half_voxel_weight(problem, Prior(mu, materials=materials), trial)
        if not on_halves:
            return x
        pull = partial(pull_to, materials)
        return self.in_half_voxels(
            problem, x, mu * materials.tv_share, on_halves, TV_STEPS, pull, self.first_sweeps - sweeps_before
        )

    def half_voxel_weight_of(self, trial: Trial, prior: Prior) -> float:
        """The weight that `best_half_voxel_weight` finds: with the levels of the prior if it has levels, otherwise as
        in `HalfVoxels`."""
        materials = prior.materials
        if materials is None or not materials.levels:
            return super().half_voxel_weight_of(trial, prior)
        return MaterialTrial(trial, prior.weight, self.iterations, materials.levels).half_voxel_weight(materials)

    def materials(
        self, problem: VoxelProblem, weight: TvWeight, trial: Callable[[], Trial | None]
    ) -> MaterialPrior | None:
        """The grey levels in the units of the problem. The result is None if discrete levels do not predict held-out
        projections better than total variation alone. The levels are found once and then reused.

        Args:
            weight: weight of total variation.
            trial: function that returns the test reconstruction of the problem.
        """
        density = problem.units.density
        decided: list[Any] = problem.decide(
            MATERIALS, lambda: [*self._materials(problem, weight, trial()).scaled(density)]
        )
        materials = MaterialPrior(*decided).scaled(-density)
        return materials if materials.levels else None

    def pulled(
        self, problem: VoxelProblem, x: F32, weight: TvWeight, materials: MaterialPrior, done: int,
        to_the_end: bool = True,
    ) -> F32:  # fmt: skip
        """Iterate further from a volume [y, x, z], pull its voxels to the grey levels, and return the new volume
        [y, x, z].

        The function makes at most `iterations` iterations. `done` is the number of iterations that the method made
        before; the reported progress counts on from this number. `to_the_end` is explained in `Subsets.of`.
        """
        pull, further = pull_to(materials, problem, x), replace(problem, go_on=problem.go_on.after(done))
        count = subsets_of(problem.projector.geometry, SUBSETS if to_the_end else MANY_SUBSETS, to_the_end)
        subsets = Subsets.of(problem, count, to_the_end)
        x = ordered_fista(
            further, x, TvWeight(weight.value * materials.tv_share), subsets, sweeps=self.iterations,
            prox=tv_prox(problem, TV_STEPS if to_the_end else EARLY_TV_STEPS), pull=pull, still=self.still,
        )  # fmt: skip
        share = problem.decide(UNDECIDED, lambda: undecided_share(x[pull.where], materials))
        of_scan = materials.scaled(problem.units.density)._asdict()
        problem.decide.settings |= {UNDECIDED: share, **{name + _OF: value for name, value in of_scan.items()}}
        return x

    def _materials(self, problem: VoxelProblem, weight: TvWeight, trial: Trial | None) -> MaterialPrior:
        """The levels in the units of the problem; empty if they do not predict held-out projections better."""
        if problem.prior is not None:
            return problem.prior.materials or MaterialPrior()
        if trial is None or weight.by_noise:
            levels = self.levels or ()
            weights = tuple(1 / len(levels) for _ in levels)
            return MaterialPrior(levels, weights, 1.0, WEAK_PULL, NOISE).scaled(-problem.units.density)
        return self._choice(trial, weight.value).materials

    def _choice(self, trial: Trial, weight: float) -> MaterialTrial:
        unit = -trial.problem.units.density
        levels = None if self.levels is None else [math.ldexp(level, unit) for level in self.levels]
        material_trial = MaterialTrial(trial, weight, self.iterations, levels)
        material_trial.choose()
        return material_trial
