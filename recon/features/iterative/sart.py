"""SART: simultaneous algebraic reconstruction, one view a step."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.method import ReconProblem, Reconstruction, RunControl, Traits
from recon.base.settings_check import check_settings
from recon.base.volume import Grid
from recon.base.work import Costs
from recon.voxels.iterative import run_iterative
from recon.voxels.voxel_problem import VoxelProblem, iterative_memory
from recon.voxels.work import ordered_sweeps


@dataclass(frozen=True)
class Sart:
    """Simultaneous algebraic reconstruction, one view a step in random order (Andersen & Kak 1984).

    The relaxation shrinks by `decay` a sweep. Memory: 3 volumes, 3 x the projections.
    """

    name: ClassVar[str] = "sart"
    label: ClassVar[str] = "SART"
    traits: ClassVar[Traits] = Traits()

    iterations: int = 20
    relaxation: float = 1.0
    decay: float = 0.999
    allow_negative: bool = False

    def __post_init__(self) -> None:
        check_settings(self, whole={"iterations": 1}, above={"relaxation": 0.0, "decay": 0.0})

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        return run_iterative(self, problem, control)

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        sweeps, scale = problem.single_views(), problem.scale
        for k in range(self.iterations):
            error = sweeps.run(x, self.relaxation * self.decay**k, problem.nonnegative, problem.rng)
            if not problem.go_on(k + 1, math.sqrt(error) / scale):
                break
        return x

    def toy(self) -> Self:
        return replace(self, iterations=1)

    def costs(self, geometry: Geometry, grid: Grid) -> Costs:
        return Costs({self.name: ordered_sweeps(geometry, grid, self.iterations, geometry.n_views)})

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        return iterative_memory(geometry, grid, 3.5, 6.6, 4.1 * weighted)
