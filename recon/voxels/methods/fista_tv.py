"""FISTA-TV: least squares with total variation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, Self

from recon.base.arrays import F32
from recon.base.empirical import FEWEST_SUBSETS
from recon.base.geometry import Geometry
from recon.base.method import ReconProblem, Reconstruction, RunControl, Traits
from recon.base.settings_check import check_settings
from recon.base.volume import Grid
from recon.base.work import Costs, Work
from recon.voxels.held_out import CHOICE_SWEEPS, HeldOutTrial, choose_weight
from recon.voxels.iterative import TV_WEIGHT_CHOSEN, run_iterative
from recon.voxels.noise_balance import NoiseBalance
from recon.voxels.ordered_fista import Subsets, ordered_fista, subsets_of
from recon.voxels.sweeps import interleaved
from recon.voxels.voxel_problem import VoxelProblem, density_unit, iterative_memory, largest_eigenvalue
from recon.voxels.work import fista_sweeps, ordered_sweeps, power_rounds, weight_choice


@dataclass(frozen=True)
class FistaTv:
    """min ½||A x - p||² + μ TV(x), x >= 0 by default, see `recon.voxels.ordered_fista`. Memory: 7 volumes,
    2 x the projections.

    Attributes:
        iterations: passes over all views.
        tv_weight: None chooses μ by views held out, or by the noise of the data, see `choose_weight`; a number is the
            threshold of one step of FISTA in density units: μ = tv_weight x density unit x ||A||².
        subsets: of the views, a step each; 1 is FISTA without subsets, which needs about ten times the iterations.
        tv_steps: dual steps of total variation in each step.
    """

    name: ClassVar[str] = "fista-tv"
    label: ClassVar[str] = "FISTA-TV"
    traits: ClassVar[Traits] = Traits(budget=True, halo=12, error_bars=(2.2, 0.1))

    iterations: int = 20
    tv_weight: float | None = None
    subsets: int = 9
    tv_steps: int = 3
    allow_negative: bool = False

    def __post_init__(self) -> None:
        check_settings(self, whole={"iterations": 1, "subsets": 1, "tv_steps": 1}, least={"tv_weight": 0.0})

    @property
    def trial_sweeps(self) -> int:
        """Those for the weight."""
        return 0 if self.tv_weight is not None else CHOICE_SWEEPS

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        return run_iterative(self, problem, control)

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        return self.with_weight(problem, x)[0]

    def with_weight(
        self, problem: VoxelProblem, x: F32, trial: Callable[[], HeldOutTrial | None] | None = None
    ) -> tuple[F32, NoiseBalance | float]:
        """`iterate`, and the weight μ; `trial`: as of `choose_weight`."""
        projector = problem.projector
        if not x.any():
            # A sweep of OS-SIRT: a better start than zero, and the source of the density unit.
            problem.sweeps(interleaved(projector, 9)).run(x, 1.0, problem.nonnegative, problem.rng)
        weight: NoiseBalance | float
        unit = density_unit(x)
        if self.tv_weight is None:
            weight = choose_weight(problem, x, self.iterations, trial)
        else:
            share, plain = self.tv_weight, projector.plain
            weight = problem.decide("weight", lambda: share * unit * largest_eigenvalue(plain, problem.weight))
        subsets = Subsets.of(problem, self.subsets, FEWEST_SUBSETS)
        x = ordered_fista(problem, x, weight, subsets, sweeps=self.iterations, tv_steps=self.tv_steps)
        if self.tv_weight is None and unit > 0:
            used = weight.value if isinstance(weight, NoiseBalance) else weight
            problem.decide(TV_WEIGHT_CHOSEN, lambda: float(used / (subsets.plain_norm * len(subsets.views) * unit)))
        return x, weight

    def toy(self) -> Self:
        return replace(self, iterations=1)

    def costs(self, geometry: Geometry, grid: Grid) -> Costs:
        count = subsets_of(geometry, self.subsets, FEWEST_SUBSETS)
        start = ordered_sweeps(geometry, grid, 1, 9) + power_rounds(geometry, grid, count)
        sweeps = fista_sweeps(geometry, grid, self.iterations, self.subsets, self.tv_steps, FEWEST_SUBSETS)
        choice = weight_choice(geometry, grid) if self.tv_weight is None else Work()
        return Costs({self.name: start + sweeps}, choice)

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        return iterative_memory(geometry, grid, 7.3, 3.0, 4.8 * weighted, filtered=True)
