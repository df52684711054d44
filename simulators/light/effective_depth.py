"""Effective depth: the optical depth measured by a detector that integrates over all energies.

It is -log(sum_e w_e exp(-sum_m mu_m(e) L_m)); the thicknesses L_m are computed once for any number of energies.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from simulators.pixels.bands import share_rows

Reals = NDArray[np.float64]

ROUNDING = 1e-14
"""A smaller depth counts as no matter."""


def effective_depth(thickness: Reals, attenuation: Reals, weights: Reals) -> Reals:
    """-log(sum_e w_e exp(-sum_m attenuation[e, m] thickness[m])), float64 [row, col].

    Args:
        thickness: mm, float64 [constituent, row, col].
        attenuation: 1/mm, float64 [energy, constituent].
        weights: float64 [energy], of sum 1.
    """
    out = np.zeros(thickness.shape[1:])

    def work(first: int, end: int) -> None:
        chords = thickness[:, first:end]
        hit = (chords != 0.0).any(axis=0)  # air is exactly 0
        matter = chords[:, hit]
        least = functools.reduce(np.minimum, (_through(matter, mu) for mu in attenuation))
        light = np.zeros_like(least)  # with the hardest energy factored out, against underflow
        for weight, mu in zip(weights, attenuation, strict=True):
            light += weight * np.exp(least - _through(matter, mu))
        depth = least - np.log(light)
        out[first:end][hit] = np.where(np.abs(depth) < ROUNDING, 0.0, depth)

    share_rows(work, (thickness.shape[1], thickness.shape[2]))
    return out


def _through(matter: Reals, attenuation: Reals) -> Reals:
    """Optical depth at one energy; not by BLAS, whose sums depend on where a ray lies in the array."""
    return functools.reduce(np.add, (mu * thickness for mu, thickness in zip(attenuation, matter, strict=True)))
