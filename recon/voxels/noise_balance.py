"""NoiseBalance: the weight of total variation by the noise of the data, corrected by what the residual shows."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from recon.base.arrays import F32, median_deviation
from recon.base.empirical import HALF_OF_MANY, MANY_VIEWS, MOST_BY_RESIDUAL, SETTLED, SHARE_OF_NOISE
from recon.base.geometry import Geometry
from recon.base.noise import noise_beside_structure, noise_level
from recon.kernels.cpu.tv import total_variation
from recon.voxels.sweeps import whitened
from recon.voxels.tv import difference_weights
from recon.voxels.voxel_problem import VoxelProblem, density_unit

MATTER = 0.05  # of the density unit: voxels above it count


@dataclass(eq=False)
class NoiseBalance:
    """The weight μ of total variation in min ½||A x - p||² + μ TV(x), x >= 0, adapted after each sweep over the views.

    It begins with 0.75 σ² N / TV(x₀), where x₀ is the filtered back-projection, N its voxels of matter and σ the noise
    of a ray: as if each voxel's change were drawn from a Laplace distribution of the mean change. After each sweep it
    is the first weight times (σ / s)², at least once and at most four times it, where s is the noise-like part of the
    residual. It rises where the residual has less noise than the data, since then the volume has taken it up. Rings and
    errors of the geometry or of the air, which no volume explains, make s large and bend the volume as noise does. So
    when three eighths of the sweeps are done, an s larger than σ takes its place: the weight is (s / σ)² times the
    first one, at most four times. Here s is the least so far, so that the weight only falls.

    Attributes:
        first: the weight to begin with.
        noise: of a ray, with which the residual is compared: `noise_beside_structure` of the data. For many views it is
            up to 1.3 times that (π / 2 times the columns determine a slice). Then little of it fits into a volume.
        sweeps: of the method. After three eighths of them the residual is looked at. Before, a method that has not
            converged seems to leave what no volume explains. Then the weight would be too heavy, and the residual
            large, up to the end.
    """

    first: float
    noise: float
    sweeps: int
    value: float = field(init=False)
    _done: int = field(default=0, init=False)
    _least: float = field(default=math.inf, init=False)

    def __post_init__(self) -> None:
        self.value = self.first

    @classmethod
    def of(cls, problem: VoxelProblem, start: F32, sweeps: int, evenly: bool = True) -> NoiseBalance:
        """For a problem that starts from the volume `start` [y, x, z], not zero.

        Args:
            sweeps: of the method.
            evenly: evenly spread views may tell noise from structure. Without it the noise of few and of many of the
                views is alike.
        """

        def noise_of(views: F32) -> float:
            seen = whitened(views, problem.weight)
            return noise_beside_structure(seen, problem.projector.geometry) if evenly else noise_level(seen)

        noise = noise_of(problem.views)
        first = problem.filtered("hann")
        volume = start if first is None else np.maximum(first, 0, out=first)
        variation = total_variation(volume, difference_weights(problem.projector.grid))
        matter = int(np.count_nonzero(volume > MATTER * density_unit(volume)))
        share = SHARE_OF_NOISE * noise**2 * matter / variation if variation > 0 else 0.0
        left = noise if problem.measured is None else noise_of(problem.data)
        return cls(share, left * _by_views(problem.projector.geometry), sweeps)

    def after_sweep(self, residual: F32) -> float:
        """Adapt the weight to the residual (some views [view, col, row], whitened), and return it."""
        self._done += 1
        deviation = median_deviation(residual)
        if not (deviation > 0 and self.noise > 0):
            return self.value
        self._least = min(self._least, deviation / self.noise)
        unexplained = self._done >= math.ceil(SETTLED * self.sweeps) and self._least > 1
        ratio = self._least if unexplained else self.noise / deviation
        factor = float(np.clip(ratio**2, 1.0, MOST_BY_RESIDUAL))
        self.value = self.first * factor
        return self.value


def _by_views(geometry: Geometry) -> float:
    """Factor on the noise by the number of views, over those that determine a slice: π / 2 a column."""
    determined = min(1.0, geometry.n_views / (math.pi / 2 * geometry.detector_shape[1]))
    return 1 + MANY_VIEWS * min(max(determined / HALF_OF_MANY - 1, 0.0), 1.0)
