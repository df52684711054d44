"""Total variation of a volume and of its difference from another one, with weights for each voxel (numba, threaded).

    R(x) = Σ_i a_i |D x|_i + b_i |D (x - m)|_i,    D as in `recon.kernels.cpu.tv`

Volumes are [y, x, z]; the dual fields p and q are [3, y, x, z] and stay within |p|_i <= a_i, |q|_i <= b_i. The kernels
process each plane [x, z] as one row of numbers, because for rows of sixteen voxels, the start of a loop takes longer
than the loop. So the fields must be zero where there is no difference: in the last plane, row and voxel.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from recon.kernels.cpu.activation import F32, OPTIONS
from recon.kernels.cpu.tv import Weights

_f = np.float32
_TINY = _f(1e-30)
_LONGEST = 1e15  # largest pace: squares of the dual fields stay within float32


@njit(fastmath=True, error_model="numpy", cache=True)
def _rise(p0, p1, p2, here, below, right, after, bound, s0, s1, s2):
    """p + the differences of one piece of a plane, shortened to `bound`."""
    for k in range(p0.size):
        q0 = p0[k] + s0 * (below[k] - here[k])
        q1 = p1[k] + s1 * (right[k] - here[k])
        q2 = p2[k] + s2[k] * (after[k] - here[k])
        shrink = bound[k] / max(max(bound[k], np.sqrt(q0 * q0 + q1 * q1 + q2 * q2)), _TINY)
        p0[k], p1[k], p2[k] = q0 * shrink, q1 * shrink, q2 * shrink


@njit(**OPTIONS)
def _ascend(x: F32, bound: F32, nz: int, step_size: float, weights: Weights, p: F32) -> None:
    ny, n = x.shape
    t0, t1 = _f(step_size * weights[0]), _f(step_size * weights[1])
    along = np.full(n, _f(step_size * weights[2]))
    along[nz - 1 :: nz] = _f(0)
    for j in prange(ny):
        here, below, b = x[j], x[min(j + 1, ny - 1)], bound[j]
        p0, p1, p2, last, end = p[0, j], p[1, j], p[2, j], n - nz, n - 1
        if last > 0:
            _rise(p0[:last], p1[:last], p2[:last], here[:last], below[:last], here[nz:], here[1 : last + 1], b[:last],
                  t0, t1, along[:last])  # fmt: skip
        row = here[last:end]
        _rise(p0[last:end], p1[last:end], p2[last:end], row, below[last:end], row, here[last + 1 :], b[last:end],
              t0, t1, along[last:end])  # fmt: skip
        row = here[end:]
        _rise(p0[end:], p1[end:], p2[end:], row, below[end:], row, row, b[end:], t0, t1, along[end:])


@njit(fastmath=True, error_model="numpy", cache=True)
def _fall(z, p0, p1, p2, before0, before1, before2, t0, t1, t2, x, add):
    """A piece of a plane of z - threshold Dᵀ p; with `add`, of x - threshold Dᵀ p."""
    for k in range(x.size):
        pull = t0 * (p0[k] - before0[k]) + t1 * (p1[k] - before1[k]) + t2 * (p2[k] - before2[k])
        x[k] = (x[k] if add else z[k]) + pull


@njit(**OPTIONS)
def _primal(z: F32, p: F32, q: F32, m: F32, nz: int, threshold: float, weights: Weights, floor: float, zero: F32,
            x: F32, beside: F32) -> None:  # fmt: skip
    ny, n = z.shape
    t0, t1, t2 = _f(threshold * weights[0]), _f(threshold * weights[1]), _f(threshold * weights[2])
    least = _f(floor)
    for j in prange(ny):
        for add in range(2):
            own = q if add else p
            p0, p1, p2, before = own[0, j], own[1, j], own[2, j], own[0, max(j - 1, 0)] if j else zero
            for part in range(3):  # the first number, the rest of the first row, the other rows
                start, end = (0, 1) if part == 0 else ((1, nz) if part == 1 else (nz, n))
                back1 = p1[: n - nz] if part == 2 else zero[start:end]
                back2 = p2[start - 1 : end - 1] if part else zero[:1]
                if end > start:
                    _fall(z[j, start:end], p0[start:end], p1[start:end], p2[start:end], before[start:end], back1,
                          back2, t0, t1, t2, x[j, start:end], add)  # fmt: skip
        out, other, difference = x[j], m[j], beside[j]
        for k in range(n):
            value = max(out[k], least)
            out[k], difference[k] = value, value - other[k]


def primal(
    z: F32, fields: tuple[F32, F32], m: F32, threshold: float, weights: Weights, nonnegative: bool, out: tuple[F32, F32]
) -> None:
    """x = P(z - threshold Dᵀ (p + q)) and x - m, into `out`; P clips negative values or none.

    Args:
        fields: p and q.
        out: x and x - m; neither may be `z`.
    """
    planes, flat = (len(z), -1), (3, len(z), -1)
    p, q = (field.reshape(flat) for field in fields)
    x, beside = (each.reshape(planes) for each in out)
    zero = np.zeros(x.shape[1], np.float32)
    floor = 0.0 if nonnegative else -3.0e38
    _primal(z.reshape(planes), p, q, m.reshape(planes), z.shape[2], threshold, weights, floor, zero, x, beside)


def ascend(x: F32, bound: F32, step_size: float, weights: Weights, p: F32) -> None:
    """p <- p + step_size D x, in place, each vector shortened to the length bound_i."""
    planes = (len(x), -1)
    _ascend(x.reshape(planes), bound.reshape(planes), x.shape[2], step_size, weights, p.reshape(3, len(x), -1))


def pace_of(threshold: float, weights: Weights) -> float:
    """The longest step of `ascend` that converges for two fields, times 0.9: |D|² <= 4 Σ w², and there are two."""
    return min(0.9 / (8 * sum(w * w for w in weights)) / threshold, _LONGEST)
