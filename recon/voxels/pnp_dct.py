"""Plug-and-play reconstruction: least squares with sparse patches as the prior, from any first volume."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from recon.base.arrays import F32
from recon.base.empirical import FALL, PULL
from recon.base.noise import noise_beside_structure
from recon.kernels.cpu.patches import denoise, patch_scratch, pulled_step
from recon.kernels.cpu.vectors import replace_by_residual
from recon.voxels.resolution import smoothed
from recon.voxels.sweeps import whitened
from recon.voxels.voxel_problem import VoxelProblem

TRIAL_STEPS = 15
"""Steps with patches. Without, with all 35: level within 0.1 dB, and half as much CPU time again."""

STEPS = 5
"""Steps towards the views between two thresholds."""


def pnp_dct(problem: VoxelProblem, x: F32, strength: float, *, steps: int) -> F32:
    """The volume that explains the views and whose 4 x 4 x 4 patches have few cosine coefficients.

        z <- D(x, strength 1.25^(rounds to come)),    x <- some steps towards min ½||A x - p||² + m/2 |x - z|², x >= 0

    and D(x, strength) in the end. D is the mean of all overlapping patches, each without coefficients up to the
    threshold (the first stage of BM4D without groups: Maggioni et al. 2013, IEEE Trans. Image Process. 22, 119). The
    rounds are half-quadratic splitting (Geman & Yang 1995, IEEE Trans. Image Process. 4, 932) with a denoiser plugged
    in (Venkatakrishnan, Bouman & Wohlberg 2013, IEEE GlobalSIP, 945). The steps are Chebyshev's on the known bounds of
    the eigenvalues, m to L + m with m = 0.03 L, so that no scalar product decides: a slice depends on those near it
    alone, three further ones a round. A step that would leave x >= 0 ends there, and its momentum, too.

    Memory: 4 volumes, two more that reach three voxels beyond the faces, and the projections once more.

    Args:
        x: [y, x, z], overwritten. Far from the sample, more steps are needed.
        strength: last threshold, in the unit of the volume.
        steps: towards the views, five a round.
    """
    bound = problem.decide("bound", lambda: problem.norm)
    scratch, z, rounds = patch_scratch(x.shape), np.empty_like(x), -(-steps // STEPS)
    for k in range(rounds):
        threshold = strength * FALL ** (k - rounds)
        denoise(x, threshold, problem.nonnegative, scratch, z)
        done = k * STEPS
        if not towards_views(problem, x, z, bound, steps=min(STEPS, steps - done), done=done):
            denoise(x, threshold, problem.nonnegative, scratch, x)
            return x
    denoise(x, strength, problem.nonnegative, scratch, x)
    return x


def towards_views(problem: VoxelProblem, x: F32, z: F32, bound: float, *, steps: int, done: int = 0) -> bool:
    """Steps of Chebyshev's semi-iteration from x towards min ½||A x - p||² + m/2 |x - z|², in place.

    Golub & Varga 1961, Numer. Math. 3, 147. Whether `problem.go_on` was content, which is told `done` and more steps.
    """
    pull = PULL * bound
    centre, half = pull + bound / 2, bound / 2
    change, gradient = np.zeros_like(x), np.empty_like(x)
    scale, momentum, pace = problem.scale, 0.0, 1 / centre
    for k in range(steps):
        residual = problem.projector.forward_lines(x)
        error = replace_by_residual(problem.data, residual, problem.weight)
        if problem.weight is not None:
            residual *= problem.weight
        problem.projector.adjoint_lines(residual, gradient)
        pulled_step(x, change, momentum, pace, gradient, pull, z, problem.nonnegative)
        if not problem.go_on(done + k + 1, math.sqrt(error) / scale):
            return False
        after = 1 / (centre - half**2 * pace / (2 if k == 0 else 4))
        momentum, pace = after * centre - 1, after
    return True


def noise_of_volume(problem: VoxelProblem) -> float:
    """Standard deviation that the noise of the views leaves in a volume after the steps of a round."""
    rng = np.random.default_rng(0)
    data = rng.normal(0, 1, problem.data.shape).astype(np.float32)
    if problem.weight is not None:
        np.divide(data, np.sqrt(problem.weight), out=data, where=problem.weight > 0)
        data[problem.weight == 0] = 0
    data = smoothed(data, problem.projector.resolution, None if problem.weight is None else problem.weight > 0)
    alone = replace(problem, data=data, nonnegative=False, go_on=lambda *_: True)
    nz, ny, nx = problem.projector.grid.shape
    x, z = (np.zeros((ny, nx, nz), np.float32) for _ in range(2))
    towards_views(alone, x, z, problem.norm, steps=STEPS)
    noise = noise_beside_structure(whitened(problem.views, problem.weight), problem.projector.geometry)
    return noise * float(np.sqrt(np.mean(np.square(x, dtype=np.float64))))
