"""activate: raw parameters to physical ones, and the gradients back, in one pass over Gaussians (numba, threaded).

    scale = exp(log_scale)        density = unit * softplus(raw)        R = R(quaternion / |quaternion|)

The other kernels work on means, scales, rotations (row-major 3x3) and densities. `activation_backward` converts their
gradients to those of the raw parameters.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.kernels.cpu import lanes

F32 = NDArray[np.float32]
OPTIONS = {"parallel": True, "fastmath": True, "boundscheck": False, "error_model": "numpy", "cache": True}
_f = np.float32
# A quaternion shorter than this (squared length) counts as the identity and gets no gradient.
_SHORTEST = np.float32(1e-24)
_LONGEST = np.float32(1e30)  # squared
_TASK = 1024  # Gaussians


@njit(inline="always", fastmath=True)
def _softplus(r):
    """log(1 + e^r) for each lane, without overflow for large r and without cancellation for small r.

    log(1 + t) = 2 artanh(t / (2 + t)) for t = e^-|r|; the series of artanh is truncated at a relative error of 1e-8.
    """
    size = r * lanes.sign(r)
    t = lanes.exp(lanes.zero() - size)
    z = t / (t + _f(2))
    w = z * z
    series = w * _f(1 / 13) + _f(1 / 11)
    series = w * (w * (w * (w * series + _f(1 / 9)) + _f(1 / 7)) + _f(1 / 5)) + _f(1 / 3)
    return (r + size) * _f(0.5) + z * (w * series + _f(1)) * _f(2)


@njit(inline="always", fastmath=True)
def _sigmoid(r):
    """Derivative of softplus, 1 / (1 + e^-r) = e^min(r, 0) / (1 + e^-|r|), accurate also for very negative r."""
    size = r * lanes.sign(r)
    return lanes.exp((r - size) * _f(0.5)) / (lanes.exp(lanes.zero() - size) + _f(1))


@njit(inline="always", fastmath=True)
def _rescaled(quaternions, i):
    """Quaternion i scaled to the range of float32, its squared length, and the factor (0 if it is too short)."""
    w, x, y, z = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
    length2, factor = w * w + x * x + y * y + z * z, _f(1)
    if not length2 < _LONGEST:
        factor = _f(1) / max(max(abs(w), abs(x)), max(abs(y), abs(z)))
        w, x, y, z = w * factor, x * factor, y * factor, z * factor
        length2 = w * w + x * x + y * y + z * z
    return w, x, y, z, length2, factor if length2 > _SHORTEST else _f(0)


@njit(**OPTIONS)
def activate(
    log_scales: F32, quaternions: F32, raw: F32, unit: float, scales: F32, rotations: F32, densities: F32
) -> None:
    """Fill scales [n, 3], rotations [n, 9] and densities [n], accurate to a few float32 steps.

    Logs are clamped to +-87.
    """
    n, one, two = raw.shape[0], _f(1), _f(2)
    logs, widths = log_scales.reshape(1, 3 * n), scales.reshape(1, 3 * n)
    raws, dense = raw.reshape(1, n), densities.reshape(1, n)
    for task in prange((n + _TASK - 1) // _TASK):
        begin, end = task * _TASK, min(n, (task + 1) * _TASK)
        for j in range(3 * begin, 3 * end, lanes.WIDTH):
            count = min(lanes.WIDTH, 3 * end - j)
            lanes.store_first(widths, 0, j, lanes.exp(lanes.load_first(logs, 0, j, count)), count)
        for j in range(begin, end, lanes.WIDTH):
            count = min(lanes.WIDTH, end - j)
            density = _softplus(lanes.load_first(raws, 0, j, count)) * _f(unit)
            lanes.store_first(dense, 0, j, density, count)
        for i in range(begin, end):
            w, x, y, z, length2, factor = _rescaled(quaternions, i)
            scale = two / length2 if factor > 0 else _f(0)
            xs, ys, zs = x * scale, y * scale, z * scale
            rotations[i, 0] = one - (y * ys + z * zs)
            rotations[i, 1] = x * ys - w * zs
            rotations[i, 2] = x * zs + w * ys
            rotations[i, 3] = x * ys + w * zs
            rotations[i, 4] = one - (x * xs + z * zs)
            rotations[i, 5] = y * zs - w * xs
            rotations[i, 6] = x * zs - w * ys
            rotations[i, 7] = y * zs + w * xs
            rotations[i, 8] = one - (x * xs + y * ys)


@njit(**OPTIONS)
def activation_backward(
    quaternions: F32, raw: F32, unit: float, d_rotations: F32, d_densities: F32, d_quaternions: F32, d_raw: F32
) -> None:
    """Gradients of quaternions [n, 4] and raw densities [n], computed from the gradients of rotations [n, 9] and
    densities [n]."""
    n, two, four = raw.shape[0], _f(2), _f(4)
    raws, d_dense, out = raw.reshape(1, n), d_densities.reshape(1, n), d_raw.reshape(1, n)
    for task in prange((n + _TASK - 1) // _TASK):
        begin, end = task * _TASK, min(n, (task + 1) * _TASK)
        for j in range(begin, end, lanes.WIDTH):
            count = min(lanes.WIDTH, end - j)
            slope = _sigmoid(lanes.load_first(raws, 0, j, count)) * _f(unit)
            lanes.store_first(out, 0, j, lanes.load_first(d_dense, 0, j, count) * slope, count)
        for i in range(begin, end):
            w, x, y, z, length2, factor = _rescaled(quaternions, i)
            inverse = _f(1) / np.sqrt(length2) if factor > 0 else _f(0)
            w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
            inverse *= factor
            g = d_rotations[i]
            gw = two * (-z * g[1] + y * g[2] + z * g[3] - x * g[5] - y * g[6] + x * g[7])
            gx = two * (y * g[1] + z * g[2] + y * g[3] - w * g[5] + z * g[6] + w * g[7]) - four * x * (g[4] + g[8])
            gy = two * (x * g[1] + w * g[2] + x * g[3] + z * g[5] - w * g[6] + z * g[7]) - four * y * (g[0] + g[8])
            gz = two * (-w * g[1] + x * g[2] + w * g[3] + y * g[5] + x * g[6] + y * g[7]) - four * z * (g[0] + g[4])
            # Only the part orthogonal to the unit quaternion rotates; the part along the quaternion would change its
            # length.
            along = gw * w + gx * x + gy * y + gz * z
            d_quaternions[i, 0] = (gw - along * w) * inverse
            d_quaternions[i, 1] = (gx - along * x) * inverse
            d_quaternions[i, 2] = (gy - along * y) * inverse
            d_quaternions[i, 3] = (gz - along * z) * inverse
