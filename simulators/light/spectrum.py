"""Spectrum: a beam's energies and weights, as few as its sample needs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simulators.light.beam import Beam, Tube

Reals = NDArray[np.float64]
Attenuation = Callable[[ArrayLike], Reals]
"""Linear attenuation in 1/mm at energies in keV."""

NODES = (3, 5, 9, 17, 33, 65, 129, 257, 513)
ENOUGH = 1e-5
"""Tolerance, as a share of the open beam: far below the noise of a pixel with 7000 electrons."""
_FWHM = math.sqrt(8 * math.log(2))
_LEAST_KEV = 1.0
_NOTHING = 1e-7  # share of the light: smaller weights, of energies that a filter stops, are dropped
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
        """From weights of any sum; energies without weight are dropped."""
        e, w = np.asarray(energies, dtype=np.float64), np.asarray(weights, dtype=np.float64)
        return cls(e[w > 0], w[w > 0] / w.sum())

    def mean(self, attenuation: Attenuation) -> float:
        """Effective attenuation of a thin layer in 1/mm: the mean over the detected photons."""
        return float(self.weights @ attenuation(self.energies))

    def transmission(self, attenuation: Attenuation, thickness: ArrayLike) -> Reals:
        """Transmitted share of the light through `thickness` mm; same shape as `thickness`."""
        through = np.exp(-np.multiply.outer(np.asarray(thickness, dtype=np.float64), attenuation(self.energies)))
        return np.asarray(through @ self.weights)


def light(
    beam: Beam, materials: Iterable[Attenuation], thickness: float, filters: Callable[[str], Attenuation]
) -> Spectrum:
    """The spectrum of a beam, with as many energies as these materials need.

    Nodes of a line or a tube are doubled until the transmission of up to `thickness` mm of each material changes by
    less than 1e-5. There are up to 513 nodes: with a bare step within a line half a node's weight is uncertain, 0.4 %
    of the light. A few of these, or of a table's energies, are kept: they have the same transmission to about 1e-5.

    Args:
        filters: the attenuation of a material by its name, for a tube.

    Raises:
        ValueError: the beam does not state its energies, or its filters stop all light.
    """
    if not beam.has_energy:
        raise ValueError("materials need the beam's energy: give it energy_kev, spectrum or tube")
    attenuations = list(materials)
    if beam.spectrum is not None:
        found = Spectrum.of(*zip(*beam.spectrum, strict=True))
    elif beam.bandwidth is None and beam.tube is None:
        found = _nodes(beam, 1, filters)
    else:
        found = _converged(beam, attenuations, thickness, filters)
    if found.energies.size <= _A_FEW or not attenuations:
        return found
    from simulators.light.fewer_energies import fewer

    attenuation = np.stack([material(found.energies) for material in attenuations], axis=1)
    kept, weights = fewer(attenuation, found.weights, thickness, ENOUGH / 5)
    return Spectrum(found.energies[kept], weights)


def _converged(
    beam: Beam, attenuations: Sequence[Attenuation], thickness: float, filters: Callable[[str], Attenuation]
) -> Spectrum:
    ladder = thickness * 4.0 ** np.arange(-6, 1)
    before = _nodes(beam, NODES[0], filters)
    for n in NODES[1:]:
        now = _nodes(beam, n, filters)
        changes = [np.abs(now.transmission(m, ladder) - before.transmission(m, ladder)).max() for m in attenuations]
        if max(changes, default=0.0) <= ENOUGH:
            return before
        before = now
    return before


def _nodes(beam: Beam, n: int, filters: Callable[[str], Attenuation]) -> Spectrum:
    """The spectrum with n nodes a line."""
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
    """Nodes and weights for a normal distribution: a Gauss rule for few nodes, evenly spaced ones where an edge needs
    many: these converge as fast for smooth integrands and have no nodes in the far tails."""
    if n <= _FEW:
        x, w = np.polynomial.hermite_e.hermegauss(n)
    else:
        x = np.linspace(-_REACH, _REACH, n)
        w = np.exp(-(x**2) / 2)
    return x, w / w.sum()


@cache  # half a second for many
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
        raise ValueError(f"no light of the tube's {tube.kv:g} kV passes its filters {dict(tube.filters or {})} mm")
    return Spectrum.of(energies, np.where(weights > _NOTHING * weights.sum(), weights, 0.0))
