"""Methods on voxels: FISTA-TV, OS-SIRT-TV and PnP-DCT."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import ClassVar, Self

from recon.base.arrays import F32
from recon.base.choices import Quality
from recon.base.decisions import Prior
from recon.base.empirical import STANDS_STILL
from recon.base.geometry import Geometry
from recon.base.method import Plain
from recon.base.setting import Count, Natural, NonNegative
from recon.base.volume import Grid
from recon.kernels.cpu.patches import scratch_values
from recon.voxels.choice import TRIALS, Prediction, TrialChoice
from recon.voxels.half_voxels import HALF_VOXEL_WEIGHTS, HalfVoxels, with_halves
from recon.voxels.held_out import CHOICE_SWEEPS, TRIAL_SWEEPS
from recon.voxels.iterative import TV_WEIGHT_CHOSEN, VoxelMethod
from recon.voxels.ordered_fista import MANY_SUBSETS, SUBSETS, Subsets, ordered_fista, subsets_of
from recon.voxels.priors import TvWeight, pnp_dct, tv_prox
from recon.voxels.standstill import MOST_SWEEPS, USUAL_SWEEPS, Standstill, with_quality
from recon.voxels.trial import EARLY_TV_STEPS, PATCH_STEPS, TV_STEPS, Trial, choose_patches, choose_weight
from recon.voxels.voxel_problem import (
    NORM,
    Buffers,
    Momentum,
    VoxelProblem,
    bytes_of,
    density_unit,
    interleaved,
    largest_eigenvalue,
)


@dataclass(frozen=True)
class FistaTv(HalfVoxels):
    """min ½||A x - p||² + μ TV(x), x >= 0 by default, see `recon.voxels.ordered_fista`.

    The iterations end when the volume has converged: after about 20 iterations with 180 projections, and about 35 with
    30 projections. Memory: 8 volumes and 2 times the projections.

    The number of dual steps was chosen on a cathode of 512 columns, on whole voxels (tests/bench/ends.py). From 45
    projections, the volume of this cathode has not converged after 60 iterations with 3 dual steps (22.8 dB), but
    converges in 45 iterations with 12 dual steps (23.3 dB). From 180 projections, the volume of the cathode converges
    in 27 iterations with 3 dual steps and in 19 iterations with 12 dual steps.

    Attributes:
        iterations: largest number of iterations over all projections.
        tv_weight: threshold of one FISTA step in density units, so that μ = tv_weight x density unit x ||A||²; None: μ
            follows from held-out projections, or from the noise of the data, see `choose_weight`.
        subsets: largest number of subsets into which the first iterations divide the projections; one step of an
            iteration uses one subset.
        tv_steps: dual steps of total variation in each step of an iteration.
        still: the volume has converged if four iterations together change it by less than this share of its norm; 0:
            all `iterations` are made.
        half_voxels: whether further iterations use voxels half as wide; None: with few projections, see
            `recon.voxels.half_voxels`.
    """

    name: ClassVar[str] = "fista-tv"
    label: ClassVar[str] = "FISTA-TV"
    takes: ClassVar[frozenset[str]] = frozenset({"device", "quality"})
    halo: ClassVar[int] = 12
    error_bars: ClassVar[tuple[float, float] | None] = 2.2, 0.1
    buffers: ClassVar[Buffers] = Buffers(8.3, 3.0, 4.8, filtered=True)

    iterations: Count = MOST_SWEEPS
    tv_weight: NonNegative | None = None
    subsets: Count = SUBSETS
    tv_steps: Count = TV_STEPS
    still: NonNegative = STANDS_STILL
    allow_negative: bool = False
    half_voxels: bool | None = None

    @property
    def trial_sweeps(self) -> int:
        """Number of iterations of the test reconstructions that choose the weight of total variation."""
        return 0 if self.tv_weight is not None else CHOICE_SWEEPS

    def refit(self, share: float) -> VoxelMethod:
        """The method that computes the refits for error bars: `EarlyTv` with the fraction `share` of its default number
        of iterations, or of the number of iterations of this method, whichever is smaller.
        """
        iterations = max(1, round(share * min(self.iterations, EarlyTv.iterations)))
        return EarlyTv(iterations, self.tv_weight, allow_negative=self.allow_negative)

    def predict(self, trial: Trial, so_far: TrialChoice) -> Prediction:
        """How well this method predicts the held-out projections of `trial`.

        The method uses the weight `tv_weight`; if `tv_weight` is None, the method uses the best weight that the trial
        has found. The held-out projections are always computed from voxels as wide as a pixel, not from half voxels.
        """
        if self.tv_weight is not None or trial.weight is None:
            return trial.predicted(with_halves(self, False))
        return trial.prediction(self.name, trial.residuals_of_weight(trial.weight), Prior(trial.weight))

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        if not self.halves(problem.projector.geometry, problem.projector.grid):
            return self.with_weight(problem, x)[0]
        trial = cache(partial(Trial.of, problem))
        x, weight = self.with_weight(problem, x, trial)
        if not problem.go_on.going:
            return x
        on_halves = self.half_voxel_weight(problem, Prior(weight.value), trial)
        if not on_halves:
            return x
        trial.cache_clear()
        return self.in_half_voxels(problem, x, weight.value, on_halves, self.tv_steps)

    @property
    def half_voxel_weights(self) -> tuple[float, ...]:
        """A weight that the caller gives is the weight on half voxels, too."""
        return HALF_VOXEL_WEIGHTS if self.tv_weight is None else HALF_VOXEL_WEIGHTS[:1]

    def with_weight(
        self, problem: VoxelProblem, x: F32, trial: Callable[[], Trial | None] | None = None
    ) -> tuple[F32, TvWeight]:
        """The volume after the iterations, and the weight μ of total variation. `trial` is explained in
        `choose_weight`.
        """
        projector = problem.projector
        if not x.any():
            problem.first_sweep(x, problem.rng)
        unit = density_unit(x)
        if self.tv_weight is None:
            weight = choose_weight(problem, x, self.usual_sweeps, trial)
        else:
            share, rays = self.tv_weight, problem.weight
            norm = problem.decide(NORM, lambda: largest_eigenvalue(projector.plain, rays))
            weight = TvWeight(problem.decide("weight", lambda: share * unit * norm))
        subsets = Subsets.of(problem, subsets_of(projector.geometry, self.subsets, self.to_the_end), self.to_the_end)
        x = ordered_fista(
            problem, x, weight, subsets, sweeps=self.iterations, prox=tv_prox(problem, self.tv_steps), still=self.still
        )
        if self.tv_weight is None and unit > 0:
            used = weight.value
            problem.decide(TV_WEIGHT_CHOSEN, lambda: float(used / (subsets.plain_norm * len(subsets.views) * unit)))
        return x, weight


@dataclass(frozen=True)
class EarlyTv(FistaTv):
    """`FistaTv` with a fixed number of iterations on subsets, which end before the volume has converged.

    It is for volumes that are only compared with each other.
    """

    iterations: Count = TRIAL_SWEEPS
    subsets: Count = MANY_SUBSETS
    tv_steps: Count = EARLY_TV_STEPS

    to_the_end: ClassVar[bool] = False


@dataclass(frozen=True)
class OsSirtTv(VoxelMethod):
    """Ordered-subset SIRT; after each iteration, a proximal step of total variation and a step of momentum.

    The iterations end when the volume has converged. The weight of a ray is the inverse of the length of the ray in the
    volume. Long rays usually pass through more material and carry fewer photons. Because long rays have less weight,
    OS-SIRT-TV suits scans with very few photons (10 to 30 per pixel: up to 2 dB better than FISTA-TV). For a cone beam,
    the weight of total variation is set from the noise. On a scan of a thorax, the PSNR of OS-SIRT-TV is 2.3 dB lower
    than that of FISTA-TV, which chooses the weight with held-out projections. The momentum follows Kim, Ramani &
    Fessler (2015, IEEE TMI 34, 167). Memory: 9 volumes and 3 times the projections.

    Attributes:
        iterations: at most this many iterations; each uses all projections once.
        tv_weight: threshold of the proximal step in density units; None: chosen by held-out projections or from the
            noise, see `choose_weight`.
        still: as in `FistaTv`.
        momentum: False: without momentum; the volume then needs about three times as many iterations as with momentum.
    """

    name: ClassVar[str] = "os-sirt-tv"
    label: ClassVar[str] = "OS-SIRT-TV"
    takes: ClassVar[frozenset[str]] = frozenset({"quality"})
    halo: ClassVar[int] = 20
    buffers: ClassVar[Buffers] = Buffers(11.1, 5.2, 8.2, filtered=True)

    iterations: Count = MOST_SWEEPS
    subsets: Count = 9
    tv_weight: NonNegative | None = None
    tv_steps: Natural = 5
    still: NonNegative = STANDS_STILL
    momentum: bool = True
    allow_negative: bool = False

    @property
    def trial_sweeps(self) -> int:
        """Number of iterations of the test reconstructions that choose the weight of total variation."""
        return 0 if self.tv_weight is not None else CHOICE_SWEEPS

    @property
    def usual_sweeps(self) -> int:
        """Usual number of iterations until the volume has converged."""
        return min(self.iterations, USUAL_SWEEPS)

    def with_quality(self, quality: Quality, default_count: int) -> Self:
        """As in `FistaTv`."""
        return with_quality(self, quality)

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        projector, scale = problem.projector, problem.scale
        sweeps = problem.sweeps(interleaved(projector, self.subsets))
        prox = tv_prox(problem, self.tv_steps)
        weight: TvWeight | None = None
        threshold = 0.0
        # One order of the subsets, because a noisy volume never converges if each sweep ends with another subset.
        order = problem.rng if self.still == 0 else None
        momentum = Momentum(x, problem.decide) if self.momentum else None
        standstill = Standstill(problem.decide, self.still)
        for k in range(self.iterations):
            error = sweeps.run(x, 1.0, problem.nonnegative, order)
            if self.tv_weight is None:
                weight = weight or choose_weight(problem, x, self.usual_sweeps)
                if weight.by_noise:
                    weight.value = problem.decide("balance", partial(weight.after_sweep, sweeps.residual))
                threshold = float(weight.value * problem.decide("pace", lambda: sweeps.pace))
                prox(x, threshold)
            else:
                # The unit follows the volume, because the volume is blurred and fainter after the first iterations.
                prox(x, self.tv_weight * problem.decide("unit", partial(density_unit, x)))
            prox.turn()
            if standstill.ends(x, k + 1, problem.go_on(k + 1, math.sqrt(error) / scale)):
                break
            if momentum is not None and k + 1 < self.iterations:
                momentum(x)
        standstill.report()
        if self.tv_weight is None and (unit := density_unit(x)) > 0:
            problem.decide(TV_WEIGHT_CHOSEN, lambda: threshold / unit)
        return x


@dataclass(frozen=True)
class PnpDct(VoxelMethod):
    """Alternates steps towards the projections with a denoiser of patches of 4 x 4 x 4 voxels (PnP-DCT).

    The denoiser keeps few cosine coefficients of each patch, see `recon.voxels.priors`. The first volume is the
    FISTA-TV volume, unless a first volume is given. Memory: as for `FistaTv`.

    Attributes:
        iterations: number of steps that fit the volume to the projections, five per round; the threshold falls from
            round to round.
        patch_threshold: threshold of the last round, in density units; None: chosen by held-out projections (see
            `choose_patches`), or from the noise if no projection can be held out.
    """

    name: ClassVar[str] = "pnp-dct"
    label: ClassVar[str] = "PnP-DCT"
    takes: ClassVar[frozenset[str]] = frozenset({"device"})
    halo: ClassVar[int] = 16
    error_bars: ClassVar[tuple[float, float] | None] = 2.3, 0.25
    buffers: ClassVar[Buffers] = Buffers(5.3, 3.0, 2.2)

    iterations: Count = PATCH_STEPS
    patch_threshold: NonNegative | None = None
    allow_negative: bool = False

    first_sweeps: ClassVar[int] = MOST_SWEEPS

    @property
    def trial_sweeps(self) -> int:
        """Number of iterations of all test reconstructions together. The test reconstructions choose the weight of
        total variation, make the first volume of PnP-DCT, and try four thresholds.
        """
        return CHOICE_SWEEPS + USUAL_SWEEPS + TRIALS * self.trial_steps

    @property
    def trial_steps(self) -> int:
        """Number of PnP-DCT steps in a test reconstruction: `iterations`, but at most the default of `iterations`."""
        return min(self.iterations, PnpDct.iterations)

    @property
    def costs_little(self) -> bool:
        return self.iterations <= PATCH_STEPS

    @classmethod
    def ended_by(cls, seconds: float) -> dict[str, Plain]:
        """Empty: no setting of PnP-DCT depends on a time limit, because its number of steps is fixed."""
        return {}

    def predict(self, trial: Trial, so_far: TrialChoice) -> Prediction:
        """How well PnP-DCT predicts the held-out projections with `patch_threshold`, or with the best threshold if
        `patch_threshold` is None.

        If the sample is wider than the field of view, PnP-DCT is not tried (see `Trial.wide`), unless it is the first
        method or the caller gave a threshold.
        """
        if self.patch_threshold is None and so_far.residuals_by_number and trial.wide:
            return Prediction(
                self.name, remark=f"{self.name} not tried, because the sample is wider than the field of view"
            )
        if self.patch_threshold is not None or trial.prior is None or not trial.prior.strength:
            prediction = trial.predicted(self)
        else:
            prediction = trial.prediction(self.name, trial.residuals_of_patches(trial.prior.strength), trial.prior)
        return prediction._replace(costs_little=self.costs_little)

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        sweeps = 0 if x.any() else self.first_sweeps
        trial = cache(partial(Trial.of, problem))
        if sweeps:
            x, weight = FistaTv().with_weight(problem, x, trial)
        else:
            weight = choose_weight(problem, x, self.first_sweeps, trial)
        if not problem.go_on.going:
            return x
        problem.decide.ended = None  # weight of the first volume; patches are used after it
        share = self.patch_threshold
        if share is None:
            strength = choose_patches(problem, weight, trial, self.trial_steps).strength
        else:
            strength = problem.decide("threshold", lambda: share * density_unit(x))
        return pnp_dct(replace(problem, go_on=problem.go_on.after(sweeps)), x, strength, steps=self.iterations)

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        nz, ny, nx = grid.shape
        patches = 4 * scratch_values((ny, nx, nz)) + bytes_of(self.buffers, geometry, grid, weighted)
        # In addition to the first volume, tests make volumes from copies of the projections (of all projections if
        # there are few rows).
        trials = bytes_of(Buffers(1.0, 2.2, 2.2), geometry, grid, weighted)
        first = FistaTv(half_voxels=False).memory(geometry, grid, weighted) + trials
        return max(first, patches)
