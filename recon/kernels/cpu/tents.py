"""Sums of a volume's lines in coarse cells of the slice plane, and their transpose (numba, threaded).

    (Tᵀ x)[a, b] = Σ w(y, a) w(x, b) x[y, x],    T c = the linear interpolation of c between the centres of cells

w is a tent (a triangular weight) about the centre of a cell, with the width of two cells. Voxels in the outer half of
an outer cell belong only to this cell, so that the weights of a voxel add up to one. Lines along z are not changed.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.kernels.cpu.activation import F32, OPTIONS


def cells_of(n: int, width: int) -> int:
    """Number of cells of `width` voxels along n voxels."""
    return -(-n // width)


def tents(n: int, width: int) -> tuple[NDArray[np.int64], F32]:
    """For each voxel [n], the first of the two cells whose tents reach it, and the weight of the second."""
    last = cells_of(n, width) - 1
    place = np.clip((np.arange(n) + 0.5) / width - 0.5, 0, last)
    first = np.minimum(place.astype(np.int64), max(last - 1, 0))
    return first, (place - first).astype(np.float32)


@njit(**OPTIONS)
def _sums(x, first_y, share_y, first_x, share_x, begin_y, out):
    nx, nz = x.shape[1:]
    for a in prange(out.shape[0]):
        cells = out[a]
        cells[:] = 0
        for y in range(begin_y[a], begin_y[a + 2]):
            weight = share_y[y] if first_y[y] < a else 1 - share_y[y]
            for i in range(nx):
                b, q = first_x[i], share_x[i]
                line, here = x[y, i], cells[b]
                p = weight * (1 - q)
                for k in range(nz):
                    here[k] += p * line[k]
                if q > 0:
                    after, r = cells[b + 1], weight * q
                    for k in range(nz):
                        after[k] += r * line[k]


@njit(**OPTIONS)
def _add(x, factor, cells, first_y, share_y, first_x, share_x):
    ny, nx, nz = x.shape
    for y in prange(ny):
        a, s = first_y[y], share_y[y]
        above, below = cells[a], cells[min(a + 1, cells.shape[0] - 1)]
        for i in range(nx):
            b, q = first_x[i], share_x[i]
            c = min(b + 1, cells.shape[1] - 1)
            w00, w01 = factor * (1 - s) * (1 - q), factor * (1 - s) * q
            w10, w11 = factor * s * (1 - q), factor * s * q
            line = x[y, i]
            c00, c01, c10, c11 = above[b], above[c], below[b], below[c]
            for k in range(nz):
                line[k] += w00 * c00[k] + w01 * c01[k] + w10 * c10[k] + w11 * c11[k]


def tent_sums(x: F32, width: int) -> F32:
    """Tᵀ x: a volume [y, x, z] to cells [a, b, z] of `width` voxels."""
    ny, nx, nz = x.shape
    (first_y, share_y), (first_x, share_x) = tents(ny, width), tents(nx, width)
    rows = cells_of(ny, width)
    # Voxels that lie in the tents of cells a - 1 and a begin at begin[a]; voxels in the tent of a end at begin[a + 2].
    begin = np.searchsorted(first_y, np.arange(-1, rows + 1)).astype(np.int64)
    out = np.empty((rows, cells_of(nx, width), nz), np.float32)
    _sums(x, first_y, share_y, first_x, share_x, begin, out)
    return out


def add_tents(x: F32, factor: float, cells: F32, width: int) -> None:
    """x += factor T c: cells [a, b, z] of `width` voxels into a volume [y, x, z]."""
    _add(x, np.float32(factor), cells, *tents(x.shape[0], width), *tents(x.shape[1], width))


def spectrum_of_tents(cycles: NDArray[np.float64], n: int, width: int) -> NDArray[np.float64]:
    """Transfer function of T Tᵀ / width for a wave along one axis, without aliases; `cycles` along n voxels <= n / 2.

    A tent is a sum over `width` voxels, applied twice, so that T and Tᵀ each contribute the square of Dirichlet's
    kernel.
    """
    return np.asarray((np.sinc(cycles * width / n) / np.sinc(cycles / n)) ** 4)


def least_width(n: int, most: int) -> int:
    """Width of a cell in voxels, so that n voxels have at most `most` cells."""
    return max(1, math.ceil(n / most))
