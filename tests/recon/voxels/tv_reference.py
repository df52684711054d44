"""Total variation in plain numpy and float64: the reference implementation for the kernels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Weights = tuple[float, float, float]


def differences(x: F64, weights: Weights) -> F64:
    """D x: [3, a, b, c], forward differences times the axis' weight, zero at the end of each axis."""
    out = np.zeros((3, *x.shape))
    for axis in range(3):
        inner = tuple(slice(0, -1) if a == axis else slice(None) for a in range(3))
        out[(axis, *inner)] = weights[axis] * np.diff(x, axis=axis)
    return out


def transposed_differences(p: F64, weights: Weights) -> F64:
    """Dᵀ p."""
    out = np.zeros(p.shape[1:])
    for axis in range(3):
        flow = np.moveaxis(weights[axis] * p[axis], axis, 0)[:-1]
        view = np.moveaxis(out, axis, 0)
        view[:-1] -= flow
        view[1:] += flow
    return out


def total_variation(x: F64, weights: Weights, smoothing: float = 0.0) -> float:
    """Σ sqrt(|D x|² + smoothing²)."""
    return float(np.sqrt((differences(x, weights) ** 2).sum(0) + smoothing**2).sum())
