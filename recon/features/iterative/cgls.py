"""CGLS: conjugate gradients on the normal equations."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from operator import truediv
from typing import ClassVar, Self

import numpy as np

from recon.base.arrays import F32
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.method import ReconProblem, Reconstruction, RunControl, Traits
from recon.base.settings_check import check_settings
from recon.base.volume import Grid
from recon.base.work import Costs
from recon.kernels.cpu.vectors import combine, dot, replace_by_residual
from recon.voxels.iterative import run_iterative
from recon.voxels.voxel_problem import VoxelProblem, iterative_memory
from recon.voxels.work import on_volume, sweep


@dataclass(frozen=True)
class Cgls:
    """Conjugate gradients on the normal equations (Hestenes & Stiefel 1952); its early end is its regularisation.

    Negative values are clipped at the end. In float32 directions stop being conjugate after some eight iterations. From
    there on the residual lags one iteration behind. Memory: 3 volumes, 3 x the projections.
    """

    name: ClassVar[str] = "cgls"
    label: ClassVar[str] = "CGLS"
    traits: ClassVar[Traits] = Traits(own_length=True)

    iterations: int = 10
    allow_negative: bool = False

    def __post_init__(self) -> None:
        check_settings(self, whole={"iterations": 1})

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        return run_iterative(self, problem, control)

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        projector = problem.projector
        # The directions would not be conjugate for other rays or weights.
        decide = problem.decide if problem.weight is None else Decisions()
        root = None if problem.weight is None else np.sqrt(problem.weight)
        residual = projector.forward_lines(x)
        replace_by_residual(problem.data, residual, None, root)
        s = projector.adjoint_lines(residual if root is None else residual * root)
        direction = s.copy()
        gamma, scale = dot(s, s), problem.scale
        for k in range(self.iterations):
            if gamma == 0:
                break
            image = projector.forward_lines(direction)
            if root is not None:
                image *= root
            step = decide("step", partial(truediv, gamma, dot(image, image)))
            combine(1.0, x, step, direction, x)
            combine(1.0, residual, -step, image, residual)
            s = projector.adjoint_lines(residual if root is None else residual * root, s)
            before, gamma = gamma, dot(s, s)
            combine(1.0, s, decide("turn", partial(truediv, gamma, before)), direction, direction)
            if not problem.go_on(k + 1, math.sqrt(dot(residual, residual)) / scale):
                break
        if problem.nonnegative:
            np.maximum(x, 0, out=x)
        return x

    def toy(self) -> Self:
        return replace(self, iterations=1)

    def costs(self, geometry: Geometry, grid: Grid) -> Costs:
        step = sweep(geometry, grid) + on_volume("pass", grid, 3)
        return Costs({self.name: (1 + self.iterations) * step})

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        return iterative_memory(geometry, grid, 3.1, 4.5, 4.1 * weighted)
