"""Raw parameters to physical ones and gradients back, once a step, fused over Gaussians (numba, threaded).

    scale = exp(log_scale)        density = unit * softplus(raw)        R = R(quaternion / |quaternion|)

Everything downstream works on means, scales, rotations (row-major 3x3) and densities; its gradients come back through
`activation_backward`.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

F32 = NDArray[np.float32]
OPTIONS = {"parallel": True, "fastmath": True, "boundscheck": False, "error_model": "numpy", "cache": True}
_f = np.float32
# A quaternion shorter than this has no direction worth a gradient; it acts as the identity.
_SHORTEST = np.float32(1e-12)


@njit(**OPTIONS)
def activate(
    log_scales: F32, quaternions: F32, raw: F32, unit: float, scales: F32, rotations: F32, densities: F32
) -> None:
    """Fill scales [n, 3], rotations [n, 9] and densities [n]."""
    for i in prange(raw.shape[0]):
        for k in range(3):
            scales[i, k] = np.exp(log_scales[i, k])
        r = raw[i]
        # log(1 + e^r) without overflow on one side or lost digits on the other.
        densities[i] = _f(unit) * (max(r, _f(0)) + np.log1p(np.exp(-abs(r))))
        w, x, y, z = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
        norm = np.sqrt(w * w + x * x + y * y + z * z)
        if norm > _SHORTEST:
            w, x, y, z = w / norm, x / norm, y / norm, z / norm
        else:
            w, x, y, z = _f(1), _f(0), _f(0), _f(0)
        two = _f(2)
        rotations[i, 0] = _f(1) - two * (y * y + z * z)
        rotations[i, 1] = two * (x * y - w * z)
        rotations[i, 2] = two * (x * z + w * y)
        rotations[i, 3] = two * (x * y + w * z)
        rotations[i, 4] = _f(1) - two * (x * x + z * z)
        rotations[i, 5] = two * (y * z - w * x)
        rotations[i, 6] = two * (x * z - w * y)
        rotations[i, 7] = two * (y * z + w * x)
        rotations[i, 8] = _f(1) - two * (x * x + y * y)


@njit(**OPTIONS)
def activation_backward(
    quaternions: F32, raw: F32, unit: float, d_rotations: F32, d_densities: F32, d_quaternions: F32, d_raw: F32
) -> None:
    """From gradients on rotations [n, 9] and densities [n] to gradients on quaternions [n, 4] and raw densities [n]."""
    for i in prange(raw.shape[0]):
        r = raw[i]
        e = np.exp(-abs(r))
        slope = _f(1) / (_f(1) + e) if r >= 0 else e / (_f(1) + e)
        d_raw[i] = d_densities[i] * _f(unit) * slope
        w, x, y, z = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
        norm = np.sqrt(w * w + x * x + y * y + z * z)
        if norm <= _SHORTEST:
            d_quaternions[i, :] = _f(0)
            continue
        w, x, y, z = w / norm, x / norm, y / norm, z / norm
        g = d_rotations[i]
        two, four = _f(2), _f(4)
        gw = two * (-z * g[1] + y * g[2] + z * g[3] - x * g[5] - y * g[6] + x * g[7])
        gx = two * (y * g[1] + z * g[2] + y * g[3] - w * g[5] + z * g[6] + w * g[7]) - four * x * (g[4] + g[8])
        gy = two * (x * g[1] + w * g[2] + x * g[3] + z * g[5] - w * g[6] + z * g[7]) - four * y * (g[0] + g[8])
        gz = two * (-w * g[1] + x * g[2] + w * g[3] + y * g[5] + x * g[6] + y * g[7]) - four * z * (g[0] + g[4])
        # Only the part across the unit quaternion turns anything; the rest would change its length.
        along = gw * w + gx * x + gy * y + gz * z
        d_quaternions[i, 0] = (gw - along * w) / norm
        d_quaternions[i, 1] = (gx - along * x) / norm
        d_quaternions[i, 2] = (gy - along * y) / norm
        d_quaternions[i, 3] = (gz - along * z) / norm
