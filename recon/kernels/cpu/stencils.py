"""Sums over a few neighbours in the plane of each slice (numba, threaded)."""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.kernels.cpu.activation import F32, OPTIONS

_f = np.float32


@njit(**OPTIONS)
def _weighted_sum(x: F32, places: NDArray[np.int64], shares: F32, out: F32) -> None:
    ny, nx, nz = x.shape
    for j in prange(ny):
        for i in range(nx):
            row = out[j, i]
            for k in range(nz):
                row[k] = _f(0)
            for n in range(shares.size):
                other = x[min(max(j + places[n, 0], 0), ny - 1), min(max(i + places[n, 1], 0), nx - 1)]
                share = shares[n]
                for k in range(nz):
                    row[k] += share * other[k]


def weighted_sum(x: F32, stencil: F32, out: F32) -> None:
    """out[j, i, k] = Σ stencil[a, b] x[j + a - middle, i + b - middle, k]; beyond the edge, x has the value at the
    edge.

    Args:
        stencil: [odd, odd]; its zeros cost nothing.
    """
    places = np.argwhere(stencil)
    _weighted_sum(x, places - np.array(stencil.shape) // 2, stencil[tuple(places.T)].astype(np.float32), out)
