"""FISTA-TV: least squares with total variation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from recon.base.method import Depth, MethodResult, ReconProblem, RunControl, Traits, TrialSettings
from recon.kernels.cpu.vectors import combine, misfit
from recon.voxels.iterative import run_iterative
from recon.voxels.sweeps import interleaved
from recon.voxels.tv import TotalVariationProx, difference_weights
from recon.voxels.voxel_problem import Momentum, VoxelProblem, density_unit, iteration_trials, largest_eigenvalue

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class FistaTv:
    """min ½||A x - p||² + μ TV(x), x >= 0, by FISTA with restarts (Beck & Teboulle 2009; O'Donoghue & Candès 2015).

    μ = tv_weight x density unit x ||A||², so `tv_weight` is the threshold of one proximal step in density units.
    Memory: 7 volumes, 2 x the projections.

    The weight: 60 views of a simulated battery give 29.3, 32.6, 35.0, 32.9 dB at 0.0002, 0.0005, 0.001, 0.002, of a
    measured walnut 28.2, 28.6, 28.9 and (after 40 iterations) 29.6.
    """

    name: ClassVar[str] = "fista-tv"
    label: ClassVar[str] = "FISTA-TV"
    colour: ClassVar[str] = "tab:red"
    traits: ClassVar[Traits] = Traits()

    iterations: int = 100
    tv_weight: float = 1e-3
    tv_steps: int = 5

    def __post_init__(self) -> None:
        if not 0 <= self.tv_weight < math.inf:
            raise ValueError(f"tv_weight must be finite and 0 or more, got {self.tv_weight}")

    def run(self, problem: ReconProblem, control: RunControl) -> MethodResult:
        return run_iterative(self, problem, control)

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        """The volume [y, x, z] after the iterations, from `x`, which is overwritten."""
        projector = problem.projector
        if not x.any():
            # A sweep of OS-SIRT: a better start than nothing, and the density unit comes from it.
            problem.sweeps(interleaved(projector, 9)).run(x, 1.0, problem.nonnegative, problem.rng)
        threshold = self.tv_weight * density_unit(x)
        step = 1 / largest_eigenvalue(projector, problem.weight)
        prox = TotalVariationProx(x.shape, difference_weights(projector.grid), problem.nonnegative, self.tv_steps)
        gradient, ahead, scale = np.empty_like(x), Momentum(x), problem.scale
        for k in range(self.iterations):
            model = projector.forward_lines(x)
            error = misfit(problem.data, model, problem.weight, problem.weight)
            projector.adjoint_lines(model, gradient)
            combine(1.0, x, step, gradient, x)
            prox(x, threshold)
            if not problem.go_on(k + 1, math.sqrt(error) / scale) or k + 1 == self.iterations:
                break
            ahead(x)
        return x

    def toy(self) -> Self:
        return replace(self, iterations=1)

    @classmethod
    def trials(cls, gaussians: int, depth: Depth) -> Sequence[TrialSettings]:
        return iteration_trials({"quick": (20, 60), "full": (20, 50, 100, 200)}[depth])

    def work(self, n_views: int, binning: int) -> float:
        return n_views * self.iterations / binning**3
