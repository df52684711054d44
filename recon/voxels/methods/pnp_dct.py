"""PnP-DCT: sparse patches as the prior, from a volume of total variation."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.method import ReconProblem, Reconstruction, RunControl, Traits
from recon.base.volume import Grid
from recon.kernels.cpu.patches import scratch_values
from recon.voxels.held_out_weight import (
    CHOICE_SWEEPS,
    WeightTrial,
    heaviest_in_octaves,
    is_coarse_cone,
    least_in_octaves,
)
from recon.voxels.iterative import run_iterative
from recon.voxels.methods.fista_tv import FistaTv
from recon.voxels.pnp_dct import noise_of_volume, pnp_dct
from recon.voxels.voxel_problem import VoxelProblem, density_unit, iterative_memory

_FIRST = 8.0  # times the noise of a volume: views held out prefer 7 to 11 on slabs of shell, teapot and walnut


@dataclass(frozen=True)
class PnpDct:
    """Steps towards the views, and patches of 4 x 4 x 4 voxels with few cosine coefficients, in turn; see
    `recon.voxels.pnp_dct`. The first volume is that of FISTA-TV by default. Memory: as `FistaTv`.

    Attributes:
        iterations: steps towards the views, five between two thresholds.
        patch_threshold: of the last round, in density units; None: as views held out prefer, see `preferred_strength`,
            or by the noise.
    """

    name: ClassVar[str] = "pnp-dct"
    label: ClassVar[str] = "PnP-DCT"
    traits: ClassVar[Traits] = Traits(halo=16, own_length=True)

    iterations: int = 35
    patch_threshold: float | None = None
    allow_negative: bool = False

    def __post_init__(self) -> None:
        if self.patch_threshold is not None and not 0 <= self.patch_threshold < math.inf:
            raise ValueError(f"patch_threshold must be finite and 0 or more, got {self.patch_threshold}")

    @property
    def first_sweeps(self) -> int:
        """Sweeps of FISTA-TV before the first step."""
        return FistaTv().iterations

    @property
    def trial_sweeps(self) -> int:
        """Those for the weight of total variation, those of a first volume, and steps with four thresholds."""
        return CHOICE_SWEEPS + CHOICE_SWEEPS // 4 + 4 * PnpDct().iterations

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        return run_iterative(self, problem, control)

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        ended, sweeps = False, self.first_sweeps

        def first(sweep: int, residual: float) -> bool:
            nonlocal ended
            ended = not problem.go_on(sweep, residual)
            return not ended

        x, weight = FistaTv().with_weight(replace(problem, go_on=first), x)
        if ended:
            return x
        share = self.patch_threshold
        strength = problem.decide(
            "strength", lambda: preferred_strength(problem, weight) if share is None else share * density_unit(x)
        )
        further = replace(problem, go_on=lambda step, residual: problem.go_on(sweeps + step, residual))
        return pnp_dct(further, x, strength, steps=self.iterations)

    def toy(self) -> Self:
        return replace(self, iterations=1)

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        nz, ny, nx = grid.shape
        patches = 4 * scratch_values((ny, nx, nz)) + iterative_memory(geometry, grid, 5.3, 3.0, 2.2 * weighted)
        # Beside the first volume, trials make total variation of copies of the views: where rows are few, of all.
        first = FistaTv().memory(geometry, grid, weighted) + iterative_memory(geometry, grid, 1.0, 2.2, 2.2 * weighted)
        return max(first, patches)


def preferred_strength(problem: VoxelProblem, weight: float) -> float:
    """The strength of `pnp_dct` that views held out prefer, sought as `preferred_weight` and, of coarse voxels,
    `heaviest_weight` seek a weight of total variation.

    It begins at the noise that a volume of all views has without a prior. That is also the strength where no views can
    be held out. Neither knows of the densest matter: weak matter beside metal keeps its detail.

    Args:
        weight: μ of total variation in the first volumes of trials.
    """
    first = _FIRST * noise_of_volume(problem)
    trial = WeightTrial.of_some_rows(problem) if first > 0 else None
    if trial is None:
        return first
    trial.begin_from(weight)
    steps = PnpDct().iterations

    def error(strength: float) -> float:
        return trial.left_by(lambda part, x: pnp_dct(part, x, strength, steps=steps))

    if is_coarse_cone(problem.projector):
        return heaviest_in_octaves(error, first) or first
    found = least_in_octaves(error, first)
    return first if found is None else found.weight
