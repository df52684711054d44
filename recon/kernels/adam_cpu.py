"""Adam for one parameter array in a single threaded pass (Kingma & Ba 2015, algorithm 1)."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from recon.kernels.activation import F32, OPTIONS

_f = np.float32
BETA1, BETA2 = 0.9, 0.999


@njit(**OPTIONS)
def _adam(parameter: F32, gradient: F32, first: F32, second: F32, rate: float, scale2: float, eps: float) -> None:
    b1, b2 = _f(BETA1), _f(BETA2)
    r, s2, e = _f(rate), _f(scale2), _f(eps)
    for i in prange(parameter.shape[0]):
        for k in range(parameter.shape[1]):
            g = gradient[i, k]
            m = b1 * first[i, k] + (_f(1) - b1) * g
            v = b2 * second[i, k] + (_f(1) - b2) * g * g
            first[i, k], second[i, k] = m, v
            parameter[i, k] -= r * m / (np.sqrt(v * s2) + e)


def adam(parameter: F32, gradient: F32, first: F32, second: F32, rate: float, step: int, eps: float = 1e-15) -> None:
    """Update `parameter` [n, k] and its moments in place; `step` counts from 1."""
    scale1, scale2 = 1 / (1 - BETA1**step), 1 / (1 - BETA2**step)
    _adam(parameter, gradient, first, second, rate * scale1, scale2, eps)
