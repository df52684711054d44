"""Total variation as a prior of volumes: its proximal step, with a warm start from the last step."""

from __future__ import annotations

import numpy as np

from recon.base.arrays import F32
from recon.base.volume import Grid
from recon.kernels.cpu import tv as tv_cpu


def difference_weights(grid: Grid) -> tuple[float, float, float]:
    """Weights of the differences along (y, x, z), so that TV does not depend on the shape of the voxels."""
    return 1.0, 1.0, grid.voxel_size / grid.spacing[0]


_BACK = (0, 0), (1, 0), (0, 1), (1, 1)  # the four mirror images, but for reflections in a point


class TotalVariationProx:
    """argmin_y ½|y - x|² + threshold TV(y), y >= 0 if wanted; isotropic TV, differences of voxels in 1/voxel.

    A few steps of the dual problem a call (Chambolle 2004, J. Math. Imaging Vis. 20, 89; with the bound: Beck &
    Teboulle 2009, IEEE Trans. Image Process. 18, 2419). The dual field stays from one call to the next: in an outer
    iteration x changes little, so later calls continue the steps. Memory: three volumes.

    Differences of a voxel are those to its three next ones; `turn` takes the ones before along y, x or both.
    """

    def __init__(self, shape: tuple[int, int, int], weights: tv_cpu.Weights, nonnegative: bool, steps: int) -> None:
        self._weights, self._dual, self._scratch = weights, tv_cpu.dual_field(shape), tv_cpu.dual_scratch(shape)
        self._nonnegative, self._steps, self._turn = nonnegative, steps, 0

    def __call__(self, x: F32, threshold: float) -> None:
        """Replace x [y, x, z] by the proximal point; `threshold` in the unit of x, 0 or more."""
        if threshold > 0:
            given, back = (threshold, self._weights, self._nonnegative, self._scratch), _BACK[self._turn]
            for _ in range(self._steps):
                tv_cpu.dual_step(x, self._dual, *given, back)
            tv_cpu.primal(x, self._dual, *given, x)
        elif self._nonnegative:
            np.maximum(x, 0, out=x)

    def turn(self) -> None:
        """Take the differences of the next of four mirror images from here on, so that no side is preferred.

        The differences, which the dual field holds, stay: only which three of them belong to a voxel changes.
        """
        self._turn = (self._turn + 1) % len(_BACK)
