"""Fewer energies: reduces a spectrum to a few of its energies with the same transmission for any sample.

exp(-mu(E) t) of different energies are nearly linearly dependent, so that a sum over many of them equals a sum over a
few to any practical accuracy. The energies and weights are found by non-negative least squares (Lawson & Hanson,
Solving Least Squares Problems, 1974, ch. 23). It runs on rays through each material, each pair and all of them. First
comes a set of about a hundred with exactly the same transmission, then as few of these as the tolerance allows.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

Reals = NDArray[np.float64]

STEPS = 40
"""Number of thicknesses, from the full one down to a 8000th of it."""
SHARES = (0.125, 0.5, 0.875)
"""Shares of the first of each pair of materials. Halves alone do not suffice: for one sample in 1000, with an edge
in each of two materials, the error is ten times the tolerance."""


def fewer(attenuation: Reals, weights: Reals, thickness: float, tolerance: float) -> tuple[NDArray[np.intp], Reals]:
    """Indices of the kept energies, and their weights, of sum 1.

    Args:
        attenuation: 1/mm, float64 [energy, material].
        weights: float64 [energy], of sum 1.
        thickness: mm, the longest path through matter.
        tolerance: largest change of the transmitted light, as a share of the open beam.
    """
    n_materials = attenuation.shape[1]
    ways = [np.eye(n_materials)]
    for pair in combinations(range(n_materials), 2):
        ways += [share * ways[0][[pair[0]]] + (1 - share) * ways[0][[pair[1]]] for share in SHARES]
    ways.append(np.full((1, n_materials), 1 / n_materials))
    lengths = np.append(thickness * 2.0 ** (-np.arange(STEPS) / 3), 0.0)
    rays = (lengths[:, None, None] * np.concatenate(ways)).reshape(-1, n_materials)
    through = np.exp(-rays @ attenuation.T)
    light = through @ weights
    exact, _ = nnls(through, light)
    enough = np.flatnonzero(exact)
    through = through[:, enough]
    chosen: list[int] = []
    found = np.zeros(0)
    missing = light
    while len(chosen) < enough.size:
        pull = through.T @ missing
        pull[chosen] = -np.inf
        chosen.append(int(np.argmax(pull)))
        found, _ = nnls(through[:, chosen], light)
        found /= found.sum()
        missing = light - through[:, chosen] @ found
        if np.abs(missing).max() <= tolerance:
            break
    else:
        return np.arange(weights.size), weights
    kept = enough[chosen][found > 0]
    order = np.argsort(kept)
    return kept[order], found[found > 0][order]
