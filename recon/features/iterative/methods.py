"""Classical iterative reconstruction methods: SIRT, SART, CGLS and ASD-POCS."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from operator import truediv
from typing import ClassVar

import numpy as np

from recon.base.arrays import F32
from recon.base.decisions import Decisions
from recon.base.method import Plain
from recon.base.setting import Count, Natural, NonNegative, Positive
from recon.kernels.cpu import tv as tv_cpu
from recon.kernels.cpu.vectors import combine, dot, replace_by_residual
from recon.voxels.iterative import VoxelMethod
from recon.voxels.voxel_problem import Buffers, VoxelProblem, density_unit, difference_weights


@dataclass(frozen=True)
class Sirt(VoxelMethod):
    """Simultaneous iterative reconstruction (Gilbert 1972). Memory: 3 volumes and 3 times the projections."""

    name: ClassVar[str] = "sirt"
    label: ClassVar[str] = "SIRT"
    buffers: ClassVar[Buffers] = Buffers(4.5, 3.2, 3.1)

    iterations: Count = 100
    relaxation: Positive = 1.0
    allow_negative: bool = False

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        sweeps, scale = problem.sweeps([np.arange(problem.projector.geometry.n_views)]), problem.scale
        for k in range(self.iterations):
            error = sweeps.run(x, self.relaxation, problem.nonnegative, None)
            if not problem.go_on(k + 1, math.sqrt(error) / scale):
                break
        return x


@dataclass(frozen=True)
class Sart(VoxelMethod):
    """Simultaneous algebraic reconstruction (SART), one projection per step in random order (Andersen & Kak 1984).

    The relaxation is multiplied by `decay` in each iteration. Memory: 3 volumes and 3 times the projections.
    """

    name: ClassVar[str] = "sart"
    label: ClassVar[str] = "SART"
    buffers: ClassVar[Buffers] = Buffers(3.5, 6.6, 4.1)

    iterations: Count = 20
    relaxation: Positive = 1.0
    decay: Positive = 0.999
    allow_negative: bool = False

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        sweeps, scale = problem.single_views(), problem.scale
        for k in range(self.iterations):
            error = sweeps.run(x, self.relaxation * self.decay**k, problem.nonnegative, problem.rng)
            if not problem.go_on(k + 1, math.sqrt(error) / scale):
                break
        return x


@dataclass(frozen=True)
class Cgls(VoxelMethod):
    """Conjugate gradients on the normal equations (CGLS; Hestenes & Stiefel 1952). The only regularisation of CGLS is
    to stop early.

    After the last iteration, negative voxels are set to 0, unless `allow_negative` is True. In float32, rounding makes
    the search directions lose conjugacy after about eight iterations. After about eight iterations, CGLS in float32 is
    about one iteration behind CGLS in exact arithmetic. Memory: 3 volumes and 3 times the projections.
    """

    name: ClassVar[str] = "cgls"
    label: ClassVar[str] = "CGLS"
    buffers: ClassVar[Buffers] = Buffers(3.1, 4.5, 4.1)

    iterations: Count = 10
    allow_negative: bool = False

    @classmethod
    def ended_by(cls, seconds: float) -> dict[str, Plain]:
        """Empty: a time limit sets no number of iterations of CGLS, because more iterations make its volume noisier."""
        return {}

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        projector = problem.projector
        # With other rays or weights in an iteration, the directions would not be conjugate.
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


@dataclass(frozen=True)
class AsdPocs(VoxelMethod):
    """Adaptive steepest descent of TV, alternating with SART (Sidky & Pan 2008, PMB 53, 4777).

    One iteration of ASD-POCS is one SART iteration, then `tv_steps` steps down the gradient of TV. At first, each TV
    step is `alpha` times as long as the change of the volume in the first SART iteration. If the TV steps of an
    iteration change the volume by more than `ratio` times the change of its SART iteration, and the residual is still
    above `goal`, the length of the next TV steps is multiplied by `alpha_decay`. Memory: 5 volumes and 3 times the
    projections.

    Attributes:
        goal: relative residual ||A x - p|| / ||p|| at which the TV steps are no longer shortened. If `goal` is None,
            the goal is 0.15 times the residual of filtered back-projection (FBP or FDK). FDK cannot reconstruct a
            cone-beam scan of less than 360°. For such a scan, the goal is 0.15 times the residual after one iteration
            of ordered-subset SIRT. The residual after one iteration of ordered-subset SIRT is similar to the residual
            of FDK: with 20 to 180 projections of a box in a box, and 0 or 2 % noise, the residual is 0.085 to 0.12 for
            SIRT and 0.075 to 0.11 for FDK.
    """

    name: ClassVar[str] = "asd-pocs"
    label: ClassVar[str] = "ASD-POCS"
    halo: ClassVar[int] = 8
    buffers: ClassVar[Buffers] = Buffers(5.1, 7.8, 4.1, filtered=True)

    iterations: Count = 10
    relaxation: Positive = 1.0
    decay: Positive = 0.9999
    tv_steps: Natural = 20
    alpha: NonNegative = 0.002
    alpha_decay: NonNegative = 0.95
    ratio: NonNegative = 0.94
    goal: NonNegative | None = None
    allow_negative: bool = False

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        projector, decide = problem.projector, problem.decide
        sweeps = problem.single_views()
        weights = difference_weights(projector.grid)
        scale = problem.scale
        goal = self.goal if self.goal is not None else decide("goal", lambda: 0.15 * _baseline(problem))
        before, slope = np.empty_like(x), np.empty_like(x)
        step = 0.0
        for k in range(self.iterations):
            before[...] = x
            sweeps.run(x, self.relaxation * self.decay**k, problem.nonnegative, problem.rng)
            combine(1.0, x, -1.0, before, before)
            swept = math.sqrt(dot(before, before))
            model = projector.forward_lines(x)
            error = math.sqrt(replace_by_residual(problem.data, model, problem.weight)) / scale
            if k == 0:
                step = self.alpha * swept
            if not problem.go_on(k + 1, error) or k + 1 == self.iterations:
                break  # end after the step that fits the data, as in the publication
            before[...] = x
            smoothing = 1e-4 * decide("unit", partial(density_unit, x))
            for _ in range(self.tv_steps if smoothing > 0 else 0):
                norm = tv_cpu.gradient(x, smoothing, weights, slope)
                pace = decide("pace", partial(_share, step, norm))
                if pace == 0:
                    break
                combine(1.0, x, -pace, slope, x)
            combine(1.0, x, -1.0, before, before)
            undone = math.sqrt(dot(before, before)) > self.ratio * swept
            if decide("shorter", partial(bool, undone and error > goal)):
                step *= self.alpha_decay
        return x


def _share(step: float, norm: float) -> float:
    return step / norm if norm > 0 else 0.0


def _baseline(problem: VoxelProblem) -> float:
    """Relative residual of filtered back-projection, or of one iteration if FBP and FDK cannot be used."""
    projector, volume = problem.projector, problem.filtered("ram-lak")
    if volume is None:
        nz, ny, nx = projector.grid.shape
        volume = np.zeros((ny, nx, nz), np.float32)
        problem.first_sweep(volume, None)
    return math.sqrt(replace_by_residual(problem.data, projector.forward_lines(volume), problem.weight)) / problem.scale
