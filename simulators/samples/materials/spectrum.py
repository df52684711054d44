"""Spectrum: energies and weights of a beam, reduced to the few energies that its sample needs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simulators.light import Beam, Tube

Reals = NDArray[np.float64]
Attenuation = Callable[[ArrayLike], Reals]  # linear attenuation in 1/mm at energies in keV

NODES = (3, 5, 9, 17, 33, 65, 129, 257, 513)
TOLERANCE = 1e-5  # share of the open beam in the intensity, much smaller than the noise of a pixel with 7000 electrons
_FWHM = math.sqrt(8 * math.log(2))
_LEAST_KEV = 1.0
_NOTHING = 1e-7  # share of the intensity; smaller weights, at energies that a filter absorbs, are dropped
_FEW = 9
_A_FEW = 4
_REACH = 4.5  # standard deviations; 7e-6 of a line lie beyond


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Energies of a beam and their weights.

    Attributes:
        energies: keV, float64 [energy].
        weights: shares of the photons detected in the open beam, float64 [energy]; they sum to 1.
    """

    energies: Reals
    weights: Reals

    @classmethod
    def of(cls, energies: ArrayLike, weights: ArrayLike) -> Spectrum:
        """A spectrum from weights with any sum; energies without weight are dropped."""
        e, w = np.asarray(energies, dtype=np.float64), np.asarray(weights, dtype=np.float64)
        return cls(e[w > 0], w[w > 0] / w.sum())

    def mean(self, attenuation: Attenuation) -> float:
        """Effective attenuation of a thin layer in 1/mm: the mean over the detected photons."""
        return float(self.weights @ attenuation(self.energies))

    def transmission(self, attenuation: Attenuation, thickness: ArrayLike) -> Reals:
        """Transmitted share of the intensity through `thickness` mm; same shape as `thickness`."""
        through = np.exp(-np.multiply.outer(np.asarray(thickness, dtype=np.float64), attenuation(self.energies)))
        return np.asarray(through @ self.weights)


def light(
    beam: Beam, materials: Iterable[Attenuation], thickness: float, filters: Callable[[str], Attenuation]
) -> Spectrum:
    """The spectrum of a beam, with as many energies as these materials need.

    Nodes of a line or a tube are doubled until the transmission of up to `thickness` mm of each material changes by
    less than 1e-5. There are up to 513 nodes: if a line contains a step, half of a node's weight is uncertain, which is
    0.4 % of the intensity. A few of these, or of a table's energies, are kept: they have the same transmission to about
    1e-5.

    Args:
        filters: the attenuation of a material by its name, for a tube.

    Raises:
        ValueError: the beam does not state its energies, or its filters stop all light.
    """
    if not beam.has_energy:
        raise ValueError("materials need the beam's energy: give it energy_kev, spectrum or tube")
    attenuations = list(materials)
    if beam.spectrum is not None:
        spectrum = Spectrum.of(*zip(*beam.spectrum, strict=True))
    elif beam.bandwidth is None and beam.tube is None:
        spectrum = _nodes(beam, 1, filters)
    else:
        spectrum = _converged(beam, attenuations, thickness, filters)
    if spectrum.energies.size <= _A_FEW or not attenuations:
        return spectrum
    attenuation = np.stack([material(spectrum.energies) for material in attenuations], axis=1)
    chosen, weights = fewer(attenuation, spectrum.weights, thickness, TOLERANCE / 5)
    return Spectrum(spectrum.energies[chosen], weights)


def _converged(
    beam: Beam, attenuations: Sequence[Attenuation], thickness: float, filters: Callable[[str], Attenuation]
) -> Spectrum:
    ladder = thickness * 4.0 ** np.arange(-6, 1)
    before = _nodes(beam, NODES[0], filters)
    for n in NODES[1:]:
        now = _nodes(beam, n, filters)
        changes = [np.abs(now.transmission(m, ladder) - before.transmission(m, ladder)).max() for m in attenuations]
        if max(changes, default=0.0) <= TOLERANCE:
            return before
        before = now
    return before


def _nodes(beam: Beam, n: int, filters: Callable[[str], Attenuation]) -> Spectrum:
    """The spectrum with n nodes per line."""
    if beam.tube is not None:
        return _tube(beam.tube, n, filters)
    assert beam.energy_kev is not None  # the beam states its energies
    energies, weights = np.array([beam.energy_kev]), np.ones(1)
    if beam.bandwidth is not None:
        x, w = _gaussian(n)
        energies, weights = beam.energy_kev * (1 + beam.bandwidth / _FWHM * x), w
    harmonics = beam.harmonics or {}
    lines = {1: 1 - sum(harmonics.values()), **harmonics}
    return Spectrum.of(
        np.concatenate([multiple * energies for multiple in lines]),
        np.concatenate([share * weights for share in lines.values()]),
    )


def _gaussian(n: int) -> tuple[Reals, Reals]:
    """Nodes and weights for a normal distribution: a Gauss rule for few nodes, evenly spaced nodes if an edge needs
    many. Evenly spaced nodes converge as fast for smooth integrands, and have no nodes in the far tails."""
    if n <= _FEW:
        x, w = np.polynomial.hermite_e.hermegauss(n)
    else:
        x = np.linspace(-_REACH, _REACH, n)
        w = np.exp(-(x**2) / 2)
    return x, w / w.sum()


@cache  # takes half a second for many nodes
def _gauss_rule(n: int) -> tuple[Reals, Reals]:
    """Nodes in -1 ... 1 and their weights."""
    return np.polynomial.legendre.leggauss(n)


def _tube(tube: Tube, n: int, filters: Callable[[str], Attenuation]) -> Spectrum:
    x, w = _gauss_rule(n)
    energies = _LEAST_KEV + (tube.kv - _LEAST_KEV) * (x + 1) / 2
    weights = w * (tube.kv - energies) / energies
    open_beam = weights.sum()
    for name, mm in (tube.filters or {}).items():
        weights = weights * np.exp(-mm * filters(name)(energies))
    if not weights.sum() > 1e-30 * open_beam:
        raise ValueError(f"no photons of the tube's {tube.kv:g} kV pass its filters {dict(tube.filters or {})} mm")
    return Spectrum.of(energies, np.where(weights > _NOTHING * weights.sum(), weights, 0.0))


STEPS = 40  # number of thicknesses, from the full thickness down to one 8000th
SHARES = (0.125, 0.5, 0.875)
"""Shares of the first material of each pair. Half of each alone is not enough: for one sample in 1000, with an edge in
each of two materials, the error is ten times the tolerance."""


def fewer(attenuation: Reals, weights: Reals, thickness: float, tolerance: float) -> tuple[NDArray[np.intp], Reals]:
    """Few energies with the same transmission for any sample: their indices and their weights, with sum 1.

    exp(-mu(E) t) of different energies are nearly linearly dependent. The energies are found by non-negative least
    squares (Lawson & Hanson, Solving Least Squares Problems, 1974, ch. 23). It runs on rays through each material, each
    pair and all of them. First comes a set of about a hundred with exactly the same transmission, then as few of these
    as the tolerance allows.

    Args:
        attenuation: 1/mm, float64 [energy, material].
        weights: float64 [energy], of sum 1.
        thickness: longest path through the sample in mm.
        tolerance: largest change of the transmitted intensity, as a share of the open beam.

    Returns:
        All energies are returned if fewer energies are not enough, or if none are found.
    """
    from scipy.optimize import nnls  # half a second

    n_materials = attenuation.shape[1]
    ways = [np.eye(n_materials)]
    for pair in combinations(range(n_materials), 2):
        ways += [share * ways[0][[pair[0]]] + (1 - share) * ways[0][[pair[1]]] for share in SHARES]
    ways.append(np.full((1, n_materials), 1 / n_materials))
    lengths = np.append(thickness * 2.0 ** (-np.arange(STEPS) / 3), 0.0)
    rays = (lengths[:, None, None] * np.concatenate(ways)).reshape(-1, n_materials)
    through = np.exp(-rays @ attenuation.T)
    signal = through @ weights
    try:
        exact, _ = nnls(through, signal)
    except RuntimeError:  # too nearly dependent (as around an edge), so the search does not converge
        return np.arange(weights.size), weights
    enough = np.flatnonzero(exact)
    through = through[:, enough]
    chosen: list[int] = []
    shares = np.zeros(0)
    missing = signal
    while len(chosen) < enough.size:
        pull = through.T @ missing
        pull[chosen] = -np.inf
        chosen.append(int(np.argmax(pull)))
        shares, _ = nnls(through[:, chosen], signal)
        shares /= shares.sum()
        missing = signal - through[:, chosen] @ shares
        if np.abs(missing).max() <= tolerance:
            break
    else:
        return np.arange(weights.size), weights
    chosen_energies = enough[chosen][shares > 0]
    order = np.argsort(chosen_energies)
    return chosen_energies[order], shares[shares > 0][order]
