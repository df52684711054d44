"""Displaced volumes by cubic splines: values and derivatives at displaced places (numba, threaded).

    (W x)(r) = Σ_n c_n β(r + first + u(r) - n),    β the cubic B-spline, c the coefficients of x

Volumes are [y, x, z], displacements u [3, y, x, z] in voxels. Places beyond the outermost voxels take the value at the
edge. (Unser, Aldroubi & Eden 1991, IEEE Trans. Pattern Anal. Mach. Intell. 13, 277.)
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.kernels.cpu.activation import F32, OPTIONS

_f = np.float32
_SIXTH = _f(1 / 6)


@njit(inline="always")
def _taps(position, size, index, share, slope):
    """Numbers, shares and derivatives of the shares of the four coefficients around a place (of one coefficient if size
    is 1)."""
    for e in range(4):
        index[e], share[e], slope[e] = 0, _f(0), _f(0)
    if size == 1:
        share[0] = _f(1)
        return
    clipped = min(max(position, _f(0)), _f(size - 1))
    low = min(math.floor(clipped), size - 2)
    t = clipped - _f(low)
    s = _f(1) - t
    for e in range(4):
        n = abs(low - 1 + e)
        index[e] = n if n < size else 2 * (size - 1) - n
    share[0], share[3] = s * s * s * _SIXTH, t * t * t * _SIXTH
    share[1] = (_f(4) - _f(6) * t * t + _f(3) * t * t * t) * _SIXTH
    share[2] = (_f(4) - _f(6) * s * s + _f(3) * s * s * s) * _SIXTH
    if clipped == position:
        slope[0], slope[3] = -_f(0.5) * s * s, _f(0.5) * t * t
        slope[1], slope[2] = (_f(1.5) * t - _f(2)) * t, (_f(2) - _f(1.5) * s) * s


@njit(**OPTIONS)
def _pull(c: F32, u: F32, first: NDArray[np.int64], out: F32, slopes: F32) -> None:
    _, ny, nx, nz = u.shape
    with_slopes = slopes.size > 0
    for j in prange(ny):
        index, share, slope = np.zeros((3, 4), np.int64), np.zeros((3, 4), np.float32), np.zeros((3, 4), np.float32)
        for i in range(nx):
            for k in range(nz):
                _taps(_f(j + first[0]) + u[0, j, i, k], c.shape[0], index[0], share[0], slope[0])
                _taps(_f(i + first[1]) + u[1, j, i, k], c.shape[1], index[1], share[1], slope[1])
                _taps(_f(k + first[2]) + u[2, j, i, k], c.shape[2], index[2], share[2], slope[2])
                value, gy, gx, gz = _f(0), _f(0), _f(0), _f(0)
                for p in range(4):
                    for q in range(4):
                        row = c[index[0, p], index[1, q]]
                        value_z, slope_z = _f(0), _f(0)
                        for r in range(4):
                            value_z += share[2, r] * row[index[2, r]]
                            slope_z += slope[2, r] * row[index[2, r]]
                        value += share[0, p] * share[1, q] * value_z
                        gy += slope[0, p] * share[1, q] * value_z
                        gx += share[0, p] * slope[1, q] * value_z
                        gz += share[0, p] * share[1, q] * slope_z
                out[j, i, k] = value
                if with_slopes:
                    slopes[0, j, i, k], slopes[1, j, i, k], slopes[2, j, i, k] = gy, gx, gz


def pull(c: F32, u: F32, first: tuple[int, int, int], out: F32, slopes: F32 | None = None) -> None:
    """W x, into `out` [y, x, z], and its derivatives with respect to u, into `slopes` [3, y, x, z] if it is given.

    Args:
        c: coefficients [y, x, z] of any shape, see `coefficients`.
        first: the voxel of c at which voxel 0 of `out` lies without a displacement.
    """
    no_slopes = np.empty((3, 0, 0, 0), np.float32)
    _pull(c, u, np.asarray(first, np.int64), out, no_slopes if slopes is None else slopes)


def coefficients(x: F32) -> F32:
    """The coefficients of the cubic spline through the voxels of x [y, x, z], mirrored at its edges."""
    from scipy.ndimage import spline_filter1d  # imported here, because this module is loaded before it is needed

    c = x.astype(np.float32)
    for axis in range(3):
        if c.shape[axis] > 1:
            c = spline_filter1d(c, 3, axis, np.float32, mode="mirror")
    return np.ascontiguousarray(c)
