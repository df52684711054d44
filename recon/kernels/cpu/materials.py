"""Posterior means of voxels that are one of a few materials or lie between two of them (numba, threaded).

    z = (Σ_k P_k c_k E_k + Σ_i Q_i d_i y) / (Σ_k P_k c_k + Σ_i Q_i d_i)

y is the voxel's value, c_k its likelihood under material k, E_k = m_k + kept_k (y - m_k) its mean given y, and d_i the
likelihood of a partial voxel between the materials i and i + 1. d_i is one divided by the gap between both materials,
for any value of the voxel. Probabilities follow from the neighbours: f_k is the share of material k, by the value
alone, blurred by a Gaussian of one voxel; Q_i = least + (most - least) min(1, 4 f_i f_{i+1}) and P_k = max(1 - Σ Q,
0.05) f_k + 0.01.

Volumes are [a, b, c]. A thread takes a block of lines along c, with two lines around it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from recon.kernels.cpu.activation import F32, OPTIONS

BLUR = (0.40262, 0.244201, 0.0544886)
"""Weights of a voxel, its first and its second neighbour along an axis: a Gaussian of one voxel, truncated after the
second neighbour."""
LEAST_OF_MATERIALS, LEAST_OF_EACH = 0.05, 0.01
_BLOCK, _SHORTEST = 2**15, 8  # approximate number of voxels of a block; least number of lines of its sides
_f = np.float32


class MaterialTable(NamedTuple):
    """Tables of K materials for the kernel; row n of a table is for the value `first` + n / `scale`.

    Attributes:
        shares: [row, K], share of each material in a voxel from its value alone; partial voxels count for both
            materials.
        likelihoods: [row, K], c.
        levels, kept: [K], m, and the share of the difference of a voxel from m that is due to the spread of the
            material.
        partial: [K - 1], d.
        least, most: probability of partial voxels between two materials: inside one material, and where both meet.
    """

    shares: F32
    likelihoods: F32
    levels: F32
    kept: F32
    partial: F32
    first: float
    scale: float
    least: float
    most: float


@njit(inline="always", fastmath=True)
def _row(y, first, scale, rows):
    """The row of a value, and the fraction of the way to the next row."""
    at = min(max((y - _f(first)) * _f(scale), _f(0)), _f(rows - 1.001))
    n = int(at)
    return n, at - _f(n)


@njit(inline="always", fastmath=True)
def _interpolated(table, n, t, m):
    return table[n, m] + t * (table[n + 1, m] - table[n, m])


@njit(inline="always", fastmath=True)
def _blur(blur, p0, p1, p2, p3, p4, out):
    for k in range(out.size):
        out[k] = blur[2] * (p0[k] + p4[k]) + blur[1] * (p1[k] + p3[k]) + blur[0] * p2[k]


@njit(inline="always", fastmath=True)
def _mean(y, f, share, shares, likelihoods, levels, kept, partial, first, scale, least, most):
    """z of a value y whose neighbours have the shares f [K]; writes the posterior of each material to `share` [K]."""
    count = levels.size
    n, t = _row(y, first, scale, shares.shape[0])
    single, mass, moment = _f(1), _f(0), _f(0)
    for m in range(count - 1):
        q = _f(least) + _f(most - least) * min(_f(4) * f[m] * f[m + 1], _f(1))
        single -= q
        mass += q * partial[m]
    moment = mass * y
    single = max(single, _f(LEAST_OF_MATERIALS))
    for m in range(count):
        share[m] = (single * f[m] + _f(LEAST_OF_EACH)) * _interpolated(likelihoods, n, t, m)
        mass += share[m]
        moment += share[m] * (levels[m] + kept[m] * (y - levels[m]))
    for m in range(count):
        share[m] /= mass
    return moment / mass


@njit(**OPTIONS)
def _posterior(
    x: F32, shares: F32, likelihoods: F32, levels: F32, kept: F32, partial: F32, first: float, scale: float,
    least: float, most: float, n_planes: int, n_lines: int, blur: F32, out: F32, probabilities: F32,
) -> None:  # fmt: skip
    na, nb, nc = x.shape
    rows, count = shares.shape
    blocks_in_plane = -(-nb // n_lines)
    for block in prange(-(-na // n_planes) * blocks_in_plane):
        a0, b0 = block // blocks_in_plane * n_planes, block % blocks_in_plane * n_lines
        a1, b1 = min(a0 + n_planes, na), min(b0 + n_lines, nb)
        voxel_shares = np.empty((count, a1 - a0 + 4, b1 - b0 + 4, nc), np.float32)
        for i in range(a0 - 2, a1 + 2):
            for j in range(b0 - 2, b1 + 2):
                line = x[min(max(i, 0), na - 1), min(max(j, 0), nb - 1)]
                for k in range(nc):
                    n, t = _row(line[k], first, scale, rows)
                    for m in range(count):
                        voxel_shares[m, i - a0 + 2, j - b0 + 2, k] = _interpolated(shares, n, t, m)
        f, g = np.empty((count, b1 - b0 + 4, nc), np.float32), np.empty((count, nc), np.float32)
        neighbour_shares, share = np.empty(count, np.float32), np.empty(count, np.float32)
        for i in range(a1 - a0):
            for m in range(count):
                for j in range(b1 - b0 + 4):
                    p = voxel_shares[m]
                    _blur(blur, p[i, j], p[i + 1, j], p[i + 2, j], p[i + 3, j], p[i + 4, j], f[m, j])
            for j in range(b1 - b0):
                for m in range(count):
                    p = f[m]
                    _blur(blur, p[j], p[j + 1], p[j + 2], p[j + 3], p[j + 4], g[m])
                for k in range(nc):
                    low, before, after, high = max(k - 2, 0), max(k - 1, 0), min(k + 1, nc - 1), min(k + 2, nc - 1)
                    for m in range(count):
                        q = g[m]
                        sides = blur[2] * (q[low] + q[high]) + blur[1] * (q[before] + q[after])
                        neighbour_shares[m] = sides + blur[0] * q[k]
                    out[a0 + i, b0 + j, k] = _mean(
                        x[a0 + i, b0 + j, k], neighbour_shares, share, shares, likelihoods, levels, kept, partial,
                        first, scale, least, most,
                    )  # fmt: skip
                    for m in range(probabilities.shape[0]):
                        probabilities[m, a0 + i, b0 + j, k] = share[m]


def posterior_mean(x: F32, table: MaterialTable, out: F32, probabilities: F32 | None = None) -> None:
    """Replace `out` [a, b, c] by the posterior mean of each voxel of x, another array.

    Args:
        probabilities: [K, a, b, c], replaced by the posterior probability of each material; the rest up to one is the
            probability of a partial voxel. None: the caller does not need them.
    """
    n_lines = max(_SHORTEST, min(x.shape[1], round((_BLOCK / x.shape[2]) ** 0.5)))
    n_planes = max(_SHORTEST, min(x.shape[0], _BLOCK // (x.shape[2] * n_lines)))
    probabilities_out = np.empty((0, *x.shape), np.float32) if probabilities is None else probabilities
    _posterior(x, *table, n_planes, n_lines, np.array(BLUR, np.float32), out, probabilities_out)
