"""density_at, on_level: the density of Gaussians and its gradient at any points, and points moved onto a level."""

from __future__ import annotations

import numpy as np

from recon.base.arrays import F64
from recon.splatting.gaussians import Gaussians

_SIGMAS = 5.0  # where a true Gaussian ends: exp(-12.5)
PAIRS, TOGETHER = 2**20, 2048  # pairs of Gaussian and point that are held, about; Gaussians looked up at once
_STEPS, _FARTHEST = 8, 0.5


def density_at(gaussians: Gaussians, points: F64) -> tuple[F64, F64]:
    """Density σ [n] and its gradient [n, 3] at points [n, 3] (x, y, z), in float64.

    With d from the centre, A = Σ⁻¹ and q = dᵀAd, a Gaussian adds ρ f(q) to σ and 2 ρ f'(q) A d to its gradient.
    """
    from scipy.spatial import cKDTree

    from recon.kernels.reference import rotation_matrices  # loads torch

    kernel, n = gaussians.kernel, len(points)
    density, gradient = np.zeros(n), np.zeros((n, 3))
    means = gaussians.means.detach().double().numpy()
    scales = gaussians.scales.detach().double()
    whiten = (rotation_matrices(gaussians.quaternions.detach().double()).transpose(1, 2) / scales[:, :, None]).numpy()
    rho = gaussians.densities.detach().double().numpy()
    reach = kernel.reach(_SIGMAS) * scales.numpy().max(axis=1)
    tree = cKDTree(points)
    for first in range(0, gaussians.n, TOGETHER):
        near = tree.query_ball_point(means[first : first + TOGETHER], reach[first : first + TOGETHER])
        ends = np.cumsum([len(some) for some in near])
        cuts = np.unique([0, *np.searchsorted(ends, np.arange(PAIRS, ends[-1], PAIRS))])
        for low, high in zip(cuts, [*cuts[1:], len(near)], strict=True):
            sizes = [len(some) for some in near[low:high]]
            at = np.fromiter((p for some in near[low:high] for p in some), np.intp, sum(sizes))
            of = np.repeat(np.arange(first + low, first + high), sizes)
            white = np.einsum("nij,nj->ni", whiten[of], points[at] - means[of])
            q = np.einsum("ni,ni->n", white, white)
            if kernel.is_compact:
                m, inside = kernel.exponent, np.maximum(1 - q / kernel.radius**2, 0)
                value, slope = inside**m, -m / kernel.radius**2 * inside ** (m - 1)
            else:
                value = np.exp(-q / 2)
                slope = -value / 2
            density += np.bincount(at, rho[of] * value, n)
            step = (2 * rho[of] * slope)[:, None] * np.einsum("nji,nj->ni", whiten[of], white)
            gradient += np.stack([np.bincount(at, part, n) for part in step.T], axis=1)
    return density, gradient


def on_level(gaussians: Gaussians, points: F64, level: float, voxel: float) -> F64:
    """Points [n, 3] moved along the gradient until the density is `level` (Newton), by half a voxel at most.

    A point that does not come nearer to the level within that stays where it was.
    """
    moved, (density, gradient) = points.copy(), density_at(gaussians, points)
    begin = np.abs(density - level)
    for _ in range(_STEPS):
        squared = np.einsum("ni,ni->n", gradient, gradient)
        moved += np.divide(level - density, squared, out=np.zeros_like(squared), where=squared > 0)[:, None] * gradient
        away = moved - points
        length = np.linalg.norm(away, axis=1)
        moved = points + away * np.minimum(1, _FARTHEST * voxel / np.maximum(length, 1e-30))[:, None]
        density, gradient = density_at(gaussians, moved)
        if np.abs(density - level).max(initial=0) < 1e-6 * level:
            break
    return np.where((np.abs(density - level) < begin)[:, None], moved, points)
