"""Keeps the densities of a few materials in each voxel at zero or above."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from recon.base.arrays import F64
from recon.kernels.cpu.activation import F32, OPTIONS


@njit(**OPTIONS)
def _nonnegative_mix(z: F32, back: F64, to: F64, gram: F64) -> None:
    n, voxels = z.shape
    for i in prange(voxels):
        start, found = np.empty(n), np.empty(n)
        below = False
        for m in range(n):
            total = 0.0
            for k in range(n):
                total += back[m, k] * z[k, i]
            start[m] = total
            found[m] = max(total, 0.0)
            below = below or total < 0.0
        if below:
            for m in range(n):
                slope = 0.0
                for k in range(n):
                    slope += gram[m, k] * (start[k] - found[k])
                found[m] = max(found[m] + slope / gram[m, m], 0.0)
            for k in range(n):
                total = 0.0
                for m in range(n):
                    total += to[k, m] * found[m]
                z[k, i] = total


def nonnegative_mix(z: F32, back: F64, to: F64) -> None:
    """Replace components z [component, ...] by nearby components whose densities are 0 or more.

    One round of coordinate descent from max(D, 0) on |to (d - D)|², d >= 0, where D = back z. If a density is raised to
    0, the others become lower, so that the sum, which determines the projections, changes little. Voxels with D >= 0 do
    not change, bit for bit.

    Args:
        back: [material, component], from components to densities.
        to: its inverse.
    """
    _nonnegative_mix(z.reshape(len(z), -1), back, to, to.T @ to)
