"""Priors: total variation, with its weight from the noise, and the denoiser of sparse patches (PnP-DCT)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from recon.base.arrays import F32, median_deviation
from recon.base.decisions import GoesOn
from recon.base.empirical import (
    FALL,
    HALF_OF_MANY,
    MANY_VIEWS,
    MOST_BY_RESIDUAL,
    PULL,
    SETTLED,
    SHARE_OF_NOISE,
)
from recon.base.geometry import Geometry
from recon.base.noise import noise_beside_structure
from recon.kernels.cpu.tv import total_variation
from recon.voxels.devices import LineProjector, projector_on, voxel_device
from recon.voxels.resolution import smoothed
from recon.voxels.voxel_problem import (
    TotalVariationProx,
    VoxelProblem,
    density_unit,
    difference_weights,
    whitened,
)

MATTER = 0.05  # share of the density unit above which a voxel is material


@dataclass(eq=False)
class TvWeight:
    """The weight μ of total variation in min ½||A x - p||² + μ TV(x), x >= 0, and what it follows from.

    A weight that held-out projections, an earlier run or the caller chose stays as it is. A weight that follows the
    noise is adapted after each sweep over the views. It begins with 0.75 σ² N / TV(x₀), where x₀ is the filtered
    back-projection, N its number of voxels of material and σ the noise of a ray. This assumes a Laplace distribution,
    with the mean change, for the change of each voxel. After each sweep the weight is the first weight times (σ / s)²,
    limited to 1 to 4 times the first weight, where s is the noise-like part of the residual. The weight rises if the
    residual has less noise than the data, because then the volume has fitted the noise. Rings, and errors of the
    geometry or of the air, which no volume explains, make s large and change the volume like noise. So after three
    eighths of the sweeps, s replaces σ if it is larger: the weight is (s / σ)² times the first one, at most four times.
    Here s is the smallest value so far, so that the weight can only fall.

    Attributes:
        first: the first weight.
        noise: None: the weight stays as it is. Otherwise the noise of a ray, with which the residual is compared:
            `noise_beside_structure` of the data. With many projections it is up to 1.3 times as large, because then
            little of the noise fits into a volume (π / 2 times the number of columns determine a slice).
        sweeps: number of sweeps of the method. The residual is used after three eighths of them. Before, the residual
            of a method that has not converged would look unexplainable, and the weight and the residual would stay too
            large up to the end.
    """

    first: float
    noise: float | None = None
    sweeps: int = 0
    value: float = field(init=False)
    _done: int = field(default=0, init=False)
    _least: float = field(default=math.inf, init=False)

    def __post_init__(self) -> None:
        self.value = self.first

    @property
    def by_noise(self) -> bool:
        """True if the weight follows the noise, because no projections could be held out."""
        return self.noise is not None

    @classmethod
    def of_noise(cls, problem: VoxelProblem, start: F32 | None, sweeps: int) -> TvWeight:
        """The weight for a problem by the noise of its data.

        Args:
            start: [y, x, z], not zero; the volume x₀ if no direct method can make one. None: then the weight is 0.
            sweeps: number of sweeps of the method.
        """

        def noise_of(views: F32) -> float:
            return noise_beside_structure(whitened(views, problem.weight), problem.projector.geometry)

        noise = noise_of(problem.views)
        first = problem.filtered("hann")
        volume, share = start if first is None else np.maximum(first, 0, out=first), 0.0
        if volume is not None:
            variation = total_variation(volume, difference_weights(problem.projector.grid))
            n_material = int(np.count_nonzero(volume > MATTER * density_unit(volume)))
            share = SHARE_OF_NOISE * noise**2 * n_material / variation if variation > 0 else 0.0
        whitened_noise = noise if problem.measured is None else noise_of(problem.data)
        return cls(share, whitened_noise * _by_views(problem.projector.geometry), sweeps)

    def after_sweep(self, residual: F32) -> float:
        """Adapt the weight to the residual (some whitened projections [view, col, row]), and return the weight."""
        self._done += 1
        deviation = median_deviation(residual)
        if not (self.noise and deviation > 0):
            return self.value
        self._least = min(self._least, deviation / self.noise)
        unexplained = self._done >= math.ceil(SETTLED * self.sweeps) and self._least > 1
        ratio = self._least if unexplained else self.noise / deviation
        factor = float(np.clip(ratio**2, 1.0, MOST_BY_RESIDUAL))
        self.value = self.first * factor
        return self.value


def tv_prox(problem: VoxelProblem, steps: int) -> TotalVariationProx:
    """The proximal step of total variation on the grid and the device of a problem, with this number of dual steps."""
    grid, device = problem.projector.grid, voxel_device(problem.projector.device)
    nz, ny, nx = grid.shape
    return TotalVariationProx((ny, nx, nz), difference_weights(grid), problem.nonnegative, steps, device)


def _by_views(geometry: Geometry) -> float:
    """Factor on the noise from the number of projections; π / 2 projections per column determine a slice."""
    determined = min(1.0, geometry.n_views / (math.pi / 2 * geometry.detector_shape[1]))
    return 1 + MANY_VIEWS * min(max(determined / HALF_OF_MANY - 1, 0.0), 1.0)


STEPS = 5
"""Number of steps towards the projections between two thresholds."""


def pnp_dct(problem: VoxelProblem, x: F32, strength: float, *, steps: int) -> F32:
    """The volume that fits the projections and whose patches of 4 x 4 x 4 voxels have few cosine coefficients.

        z <- D(x, strength 1.25^(rounds to come)),    x <- some steps towards min ½||A x - p||² + m/2 |x - z|², x >= 0

    and D(x, strength) at the end. D is the mean of all overlapping patches, each without the coefficients below the
    threshold (the first stage of BM4D without groups: Maggioni et al. 2013, IEEE Trans. Image Process. 22, 119). The
    rounds are half-quadratic splitting (Geman & Yang 1995, IEEE Trans. Image Process. 4, 932) with a denoiser plugged
    in (Venkatakrishnan, Bouman & Wohlberg 2013, IEEE GlobalSIP, 945). The steps are Chebyshev steps on the known bounds
    of the eigenvalues, m to L + m with m = 0.03 L. They need no scalar products, so that a slice depends only on slices
    near it: three more on each side per round. A step that would leave x >= 0 ends at 0, and so does its momentum.

    Memory: 4 volumes, two more that reach three voxels beyond the faces, and the projections once more.

    Args:
        x: [y, x, z], overwritten. Far from the sample, more steps are needed.
        strength: last threshold, in the unit of the volume.
        steps: number of steps towards the projections, five per round.
    """
    bound = problem.decide("bound", lambda: problem.norm)
    device, rounds = voxel_device(problem.projector.device), -(-steps // STEPS)
    scratch, x = device.patch_scratch(x.shape), device.array(x)
    z, views = device.copy(x), views_on_device(problem)
    for k in range(rounds):
        threshold = strength * FALL ** (k - rounds)
        device.denoise(x, threshold, problem.nonnegative, scratch, z)
        done = k * STEPS
        if not towards_views(problem, views, x, z, bound, steps=min(STEPS, steps - done), done=done):
            break
    else:
        threshold = strength
    device.denoise(x, threshold, problem.nonnegative, scratch, x)
    return device.numpy(x)


ViewsOnDevice = tuple[LineProjector[Any], Any, Any]
"""Projector, line integrals and weights of a problem; the arrays are on its device."""


def views_on_device(problem: VoxelProblem) -> ViewsOnDevice:
    """The data with which `towards_views` compares a volume; on the CPU the arrays of the problem."""
    device = voxel_device(problem.projector.device)
    weight = None if problem.weight is None else device.array(problem.weight)
    return projector_on(device, problem.projector), device.array(problem.data), weight


def towards_views(
    problem: VoxelProblem, views: ViewsOnDevice, x: Any, z: Any, bound: float, *, steps: int, done: int = 0
) -> bool:
    """Steps of Chebyshev's semi-iteration from x towards min ½||A x - p||² + m/2 |x - z|², in place.

    Golub & Varga 1961, Numer. Math. 3, 147. The result is that of `problem.go_on`, which gets the number of steps,
    counted from `done`. `views` are those of the problem; x and z [y, x, z] are arrays of its device.
    """
    device, pull = voxel_device(problem.projector.device), PULL * bound
    projector, data, rays = views
    centre, half_range = pull + bound / 2, bound / 2
    change, gradient = device.zeros(x.shape), device.copy(x)
    scale, momentum, step_length = problem.scale, 0.0, 1 / centre
    for k in range(steps):
        residual = projector.forward_lines(x)
        error = device.replace_by_residual(data, residual, rays)
        if rays is not None:
            residual *= rays
        projector.adjoint_lines(residual, gradient)
        device.pulled_step(x, change, momentum, step_length, gradient, pull, z, problem.nonnegative)
        if not problem.go_on(done + k + 1, math.sqrt(error) / scale):
            return False
        next_step_length = 1 / (centre - half_range**2 * step_length / (2 if k == 0 else 4))
        momentum, step_length = next_step_length * centre - 1, next_step_length
    return True


def noise_of_volume(problem: VoxelProblem) -> float:
    """Standard deviation that the noise of the projections causes in a volume after the steps of one round."""
    rng = np.random.default_rng(0)
    data = rng.normal(0, 1, problem.data.shape).astype(np.float32)
    if problem.weight is not None:
        np.divide(data, np.sqrt(problem.weight), out=data, where=problem.weight > 0)
        data[problem.weight == 0] = 0
    data = smoothed(data, problem.projector.resolution, None if problem.weight is None else problem.weight > 0)
    alone = replace(problem, data=data, nonnegative=False, go_on=GoesOn())
    device = voxel_device(problem.projector.device)
    nz, ny, nx = problem.projector.grid.shape
    x, z = (device.zeros((ny, nx, nz)) for _ in range(2))
    towards_views(alone, views_on_device(alone), x, z, problem.norm, steps=STEPS)
    noise = noise_beside_structure(whitened(problem.views, problem.weight), problem.projector.geometry)
    return noise * float(np.sqrt(np.mean(np.square(device.numpy(x), dtype=np.float64))))
