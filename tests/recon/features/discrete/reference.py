"""Reference implementation of the posterior mean with discrete levels, in float64: integrals over the true density."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

F64 = NDArray[np.float64]


def shares_of_neighbours(shares: F64, blur: tuple[float, float, float]) -> F64:
    """[material, ...] shares, blurred along each axis; the outer voxels are repeated beyond the volume."""
    taps = [blur[2], blur[1], blur[0], blur[1], blur[2]]
    for axis in range(1, shares.ndim):
        shares = correlate1d(shares, taps, axis, mode="nearest")
    return shares


def posterior_by_integrals(
    y: float, f: F64, levels: F64, noise: float, spread: float, partial: tuple[float, float]
) -> tuple[float, F64]:
    """E[t | y] and the probability of each material, from sums over a fine grid of true densities t."""
    t = np.linspace(y - 12 * noise - 12 * spread, y + 12 * noise + 12 * spread, 40001)
    step = t[1] - t[0]

    def normal(z: F64, width: float) -> F64:
        return np.asarray(np.exp(-0.5 * (z / width) ** 2) / (np.sqrt(2 * np.pi) * width))

    between = partial[0] + (partial[1] - partial[0]) * np.minimum(4 * f[:-1] * f[1:], 1)
    own = max(1 - between.sum(), 0.05) * f + 0.01
    seen = normal(y - t, noise)
    of_materials = [p * normal(t - m, spread) * seen for p, m in zip(own, levels, strict=True)]
    flat = (between / np.diff(levels)).sum() * seen
    mass = sum(of_materials) + flat
    whole = mass.sum() * step
    return float((t * mass).sum() * step / whole), np.array([each.sum() * step / whole for each in of_materials])
