"""Ordered-subset FISTA with total variation, from any first volume."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32
from recon.base.empirical import LEAST_OF_SUBSET
from recon.base.geometry import Geometry
from recon.kernels.cpu.vectors import combine, replace_by_residual
from recon.voxels.noise_balance import NoiseBalance
from recon.voxels.projector import Projector
from recon.voxels.sweeps import interleaved, whitened
from recon.voxels.tv import TotalVariationProx, difference_weights
from recon.voxels.voxel_problem import Momentum, VoxelProblem, largest_eigenvalue

_LOOKED_AT = 9  # views of a sweep whose residual is looked at


@dataclass(frozen=True, eq=False)
class Subsets:
    """Subsets of the views of a problem, which all runs with these views and weights may share.

    Attributes:
        views: indices, of each subset.
        projectors: of these views.
        step: 1 / L, with L the largest eigenvalue of AᵀWA of the subset that weighs most.
        plain_norm: the same eigenvalue, of the projector that is not sharpened.
    """

    views: Sequence[NDArray[np.intp]]
    projectors: Sequence[Projector]
    step: float
    plain_norm: float

    @classmethod
    def of(cls, problem: VoxelProblem, most: int, fewest: int = 1) -> Subsets:
        """At most so many; see `subsets_of`."""
        projector, weight = problem.projector, problem.weight
        count, heaviest = subsets_of(projector.geometry, most, fewest), 0
        views = interleaved(projector, count)
        projectors = [projector] if count == 1 else [projector.subset(some) for some in views]
        rays = [None if weight is None else weight[some] for some in views] if count > 1 else [weight]
        if weight is not None:
            heaviest = int(np.argmax([0.0 if some is None else float(some.sum(dtype=np.float64)) for some in rays]))
        norm = largest_eigenvalue(projectors[heaviest].plain, rays[heaviest])
        gain = max(part.gain(some) for part, some in zip(projectors, rays, strict=True))
        return cls(views, projectors, 1 / (norm * gain), norm)


def ordered_fista(
    problem: VoxelProblem, x: F32, weight: NoiseBalance | float, subsets: Subsets, *, sweeps: int, tv_steps: int
) -> F32:
    """min ½||A x - p||² + μ TV(x), x >= 0, by steps from a subset of the views each, with momentum and restarts.

        x <- prox_{μ/L TV}(y + (m / L) A_sᵀ W (p_s - A_s y)),    L >= the largest eigenvalue of AᵀWA, m subsets

    (Kim, Ramani & Fessler 2015, IEEE Trans. Med. Imaging 34, 167; Beck & Teboulle 2009, SIAM J. Imaging Sci. 2, 183;
    O'Donoghue & Candès 2015). With one subset this is FISTA and converges; with more it is faster by about their
    number at first, and ends near the minimum. Memory: 7 volumes, 2 x the projections.

    Args:
        x: [y, x, z], not zero; overwritten.
        weight: μ, or an object that chooses it after each sweep.
        tv_steps: dual steps of each proximal step, which continue from the last ones.
    """
    parts, projectors, step, count = subsets.views, subsets.projectors, subsets.step, len(subsets.views)
    prox = TotalVariationProx(x.shape, difference_weights(problem.projector.grid), problem.nonnegative, tv_steps)
    gradient, ahead, scale = np.empty_like(x), Momentum(x, problem.decide), problem.scale
    for k in range(sweeps):
        error, seen = 0.0, []
        for at, s in enumerate(problem.rng.permutation(count)):
            part = problem.of_views(parts[s]) if count > 1 else problem
            mu = weight.value if isinstance(weight, NoiseBalance) else weight
            residual = projectors[s].forward_lines(x)
            error += replace_by_residual(part.data, residual, part.weight)
            if isinstance(weight, NoiseBalance):
                some = slice(None, None, max(1, count * len(residual) // _LOOKED_AT))
                seen.append(whitened(residual[some].copy(), None if part.weight is None else part.weight[some]))
            if part.weight is not None:
                residual *= part.weight
            projectors[s].adjoint_lines(residual, gradient)
            combine(1.0, x, step, gradient, x)
            prox(x, mu * step / count)
            prox.turn()
            if at + 1 < count:
                ahead(x)
        if isinstance(weight, NoiseBalance):
            weight.value = problem.decide("balance", partial(weight.after_sweep, np.concatenate(seen)))
        if not problem.go_on(k + 1, math.sqrt(error) / scale) or k + 1 == sweeps:
            break
        ahead(x)
    return x


def subsets_of(geometry: Geometry, most: int, fewest: int = 1) -> int:
    """Number of subsets: of `LEAST_OF_SUBSET` views or more; from that many views on at least `fewest`."""
    whole = geometry.n_views // LEAST_OF_SUBSET
    return max(1, min(most, max(whole, fewest) if whole else 1))
