"""PnP-DCT: sparse patches as the prior, from a volume of total variation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import ClassVar, NamedTuple, Self

from recon.base.arrays import F32, F64
from recon.base.empirical import FIRST_THRESHOLD, TRIAL_THRESHOLD
from recon.base.geometry import Geometry
from recon.base.method import ReconProblem, Reconstruction, RunControl, Traits
from recon.base.settings_check import check_settings
from recon.base.volume import Grid
from recon.base.work import Costs, Work
from recon.kernels.cpu.patches import scratch_values
from recon.voxels.held_out import (
    CHOICE_SWEEPS,
    TRIAL_SWEEPS,
    TRIALS,
    HeldOutTrial,
    choose_weight,
    preferred_strength,
)
from recon.voxels.iterative import run_iterative
from recon.voxels.methods.fista_tv import FistaTv
from recon.voxels.noise_balance import NoiseBalance
from recon.voxels.pnp_dct import TRIAL_STEPS, noise_of_volume, pnp_dct
from recon.voxels.voxel_problem import VoxelProblem, density_unit, iterative_memory
from recon.voxels.work import patch_choice, patch_steps


@dataclass(frozen=True)
class PnpDct:
    """Steps towards the views, and patches of 4 x 4 x 4 voxels with few cosine coefficients, in turn; see
    `recon.voxels.pnp_dct`. The first volume is that of FISTA-TV, unless one is given. Memory: as `FistaTv`.

    Attributes:
        iterations: steps towards the views, five between two thresholds.
        patch_threshold: of the last round, in density units; None: as views held out prefer, see `choose_patches`,
            or by the noise.
    """

    name: ClassVar[str] = "pnp-dct"
    label: ClassVar[str] = "PnP-DCT"
    traits: ClassVar[Traits] = Traits(halo=16, own_length=True, error_bars=(2.3, 0.25))

    iterations: int = 35
    patch_threshold: float | None = None
    allow_negative: bool = False

    def __post_init__(self) -> None:
        check_settings(self, whole={"iterations": 1}, least={"patch_threshold": 0.0})

    @property
    def first_sweeps(self) -> int:
        """Sweeps of FISTA-TV before the first step."""
        return FistaTv().iterations

    @property
    def trial_sweeps(self) -> int:
        """Those for the weight of total variation, those of a first volume, and steps with four thresholds."""
        return CHOICE_SWEEPS + TRIAL_SWEEPS + TRIALS * TRIAL_STEPS

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        return run_iterative(self, problem, control)

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        ended, sweeps = False, 0 if x.any() else self.first_sweeps

        def first(sweep: int, residual: float) -> bool:
            nonlocal ended
            ended = not problem.go_on(sweep, residual)
            return not ended

        trial = cache(partial(HeldOutTrial.of, problem))
        weight: NoiseBalance | float
        if sweeps:
            x, weight = FistaTv().with_weight(replace(problem, go_on=first), x, trial)
        else:
            weight = choose_weight(problem, x, self.first_sweeps, trial)
        if ended:
            return x
        share = self.patch_threshold
        if share is None:
            strength = choose_patches(problem, weight, trial).strength
        else:
            strength = problem.decide("threshold", lambda: share * density_unit(x))
        further = replace(problem, go_on=lambda step, residual: problem.go_on(sweeps + step, residual))
        return pnp_dct(further, x, strength, steps=self.iterations)

    def toy(self) -> Self:
        return replace(self, iterations=1)

    def costs(self, geometry: Geometry, grid: Grid) -> Costs:
        first = FistaTv().costs(geometry, grid)
        choice = patch_choice(geometry, grid) if self.patch_threshold is None else Work()
        work = first.volumes[FistaTv.name] + patch_steps(geometry, grid, self.iterations)
        return Costs({self.name: work}, first.choice + choice)

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        nz, ny, nx = grid.shape
        patches = 4 * scratch_values((ny, nx, nz)) + iterative_memory(geometry, grid, 5.3, 3.0, 2.2 * weighted)
        # Beside the first volume, trials make total variation of copies of the views: where rows are few, of all.
        first = FistaTv().memory(geometry, grid, weighted) + iterative_memory(geometry, grid, 1.0, 2.2, 2.2 * weighted)
        return max(first, patches)


class Patches(NamedTuple):
    """What views held out tell of sparse patches.

    Attributes:
        strength: of `pnp_dct`.
        better: patches predict these views better than total variation alone.
    """

    strength: float
    better: bool


def choose_patches(
    problem: VoxelProblem, weight: NoiseBalance | float, trial: Callable[[], HeldOutTrial | None]
) -> Patches:
    """The strength of `pnp_dct` that views held out prefer, from volumes of total variation with a weight μ.

    The search begins at the noise that a volume of all views has without a prior. That is also the strength where no
    views can be held out. There total variation is taken to predict as well. Neither knows of the densest matter: weak
    matter beside metal keeps its detail.
    """

    def chosen() -> list[float]:
        judge = None if isinstance(weight, NoiseBalance) else trial()
        first = FIRST_THRESHOLD * noise_of_volume(problem if judge is None else judge.problem)
        if judge is None or isinstance(weight, NoiseBalance) or first == 0:
            return [first, 0]
        smooth = judge.with_weight(weight) if judge.smooth is None else judge.smooth
        found = preferred_strength(partial(residuals_of_patches, judge, smooth), first)
        if found is None:
            return [first, 0]
        judge.keep("patches", found)
        return [found.strength, found.residuals.mean() < judge.of_weight(weight).mean()]

    strength, better = problem.decide("strength", chosen)
    return Patches(strength, bool(better))


def residuals_of_patches(trial: HeldOutTrial, x: F32, strength: float) -> F64:
    """What the volume that patches make of this one leaves of the views held out."""

    def made(strength: float) -> F32:
        return trial.made(lambda part, first: pnp_dct(part, first, TRIAL_THRESHOLD * strength, steps=TRIAL_STEPS), x)

    return trial.residuals_of("patches", strength, made)
