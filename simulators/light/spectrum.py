"""Spectrum: a beam's energies and their weights, only as many as its sample needs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simulators.light.beam import Beam, Tube

Reals = NDArray[np.float64]
Attenuation = Callable[[ArrayLike], Reals]
"""Linear attenuation in 1/mm at energies in keV."""

NODES = (3, 5, 9, 17, 33, 65, 129, 257, 513)
ENOUGH = 1e-5
"""Of the open beam: far below the noise of a pixel that holds 7000 electrons."""
_FWHM = math.sqrt(8 * math.log(2))
_LEAST_KEV = 1.0
_NOTHING = 1e-7  # of the light: what a filter lets through of the lowest energies
_FEW = 9
_A_FEW = 4
_REACH = 4.5  # standard deviations; 7e-6 of a line are beyond


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Light of some energies.

    Attributes:
        energies: keV, float64 [energy].
        weights: shares of the photons detected in the open beam, float64 [energy]; they sum to 1.
    """

    energies: Reals
    weights: Reals

    @classmethod
    def of(cls, energies: ArrayLike, weights: ArrayLike) -> Spectrum:
        """Of weights of any sum; energies without weight are left out."""
        e, w = np.asarray(energies, dtype=np.float64), np.asarray(weights, dtype=np.float64)
        return cls(e[w > 0], w[w > 0] / w.sum())

    def mean(self, attenuation: Attenuation) -> float:
        """Attenuation in 1/mm that a thin layer shows: the mean over the photons that are detected."""
        return float(self.weights @ attenuation(self.energies))

    def transmission(self, attenuation: Attenuation, thickness: ArrayLike) -> Reals:
        """Share of the light that comes through `thickness` mm, of its shape."""
        through = np.exp(-np.multiply.outer(np.asarray(thickness, dtype=np.float64), attenuation(self.energies)))
        return np.asarray(through @ self.weights)


def light(
    beam: Beam, materials: Iterable[Attenuation], thickness: float, filters: Callable[[str], Attenuation]
) -> Spectrum:
    """The spectrum of a beam, with as many energies as these materials need.

    The nodes of a line or a tube are doubled until up to `thickness` mm of each material let through the same light to
    1e-5 of the open beam (513 are the end of it: a bare step within a line leaves half a node's weight open, 0.4 % of
    the light). Of these, or of a table's, are then kept the few that let through the same light, to about 1e-5 again.

    Args:
        filters: the attenuation of a material by its name, for a tube.

    Raises:
        ValueError: the beam does not say its energies, or nothing comes through its filters.
    """
    if not beam.has_energy:
        raise ValueError("materials need the beam's energy: give it energy_kev, spectrum or tube")
    judges = list(materials)
    if beam.spectrum is not None:
        found = Spectrum.of(*zip(*beam.spectrum, strict=True))
    elif beam.bandwidth is None and beam.tube is None:
        found = _nodes(beam, 1, filters)
    else:
        found = _converged(beam, judges, thickness, filters)
    if found.energies.size <= _A_FEW or not judges:
        return found
    from simulators.light.fewer_energies import fewer

    attenuation = np.stack([material(found.energies) for material in judges], axis=1)
    kept, weights = fewer(attenuation, found.weights, thickness, ENOUGH / 5)
    return Spectrum(found.energies[kept], weights)


def _converged(
    beam: Beam, judges: Sequence[Attenuation], thickness: float, filters: Callable[[str], Attenuation]
) -> Spectrum:
    ladder = thickness * 4.0 ** np.arange(-6, 1)
    before = _nodes(beam, NODES[0], filters)
    for n in NODES[1:]:
        now = _nodes(beam, n, filters)
        changes = [np.abs(now.transmission(m, ladder) - before.transmission(m, ladder)).max() for m in judges]
        if max(changes, default=0.0) <= ENOUGH:
            return before
        before = now
    return before


def _nodes(beam: Beam, n: int, filters: Callable[[str], Attenuation]) -> Spectrum:
    """The spectrum on n nodes a line."""
    if beam.tube is not None:
        return _tube(beam.tube, n, filters)
    assert beam.energy_kev is not None  # the beam says its energies
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
    """Nodes and weights for a normal distribution: Gauss's where few do, evenly spaced ones where an edge asks for
    many; those converge as fast for what is smooth and spend none on the far ends."""
    if n <= _FEW:
        x, w = np.polynomial.hermite_e.hermegauss(n)
    else:
        x = np.linspace(-_REACH, _REACH, n)
        w = np.exp(-(x**2) / 2)
    return x, w / w.sum()


def _tube(tube: Tube, n: int, filters: Callable[[str], Attenuation]) -> Spectrum:
    x, w = np.polynomial.legendre.leggauss(n)
    energies = _LEAST_KEV + (tube.kv - _LEAST_KEV) * (x + 1) / 2
    weights = w * (tube.kv - energies) / energies
    open_beam = weights.sum()
    for name, mm in (tube.filters or {}).items():
        weights = weights * np.exp(-mm * filters(name)(energies))
    if not weights.sum() > 1e-30 * open_beam:
        raise ValueError(
            f"nothing of the tube's {tube.kv:g} kV comes through its filters {dict(tube.filters or {})} mm"
        )
    return Spectrum.of(energies, np.where(weights > _NOTHING * weights.sum(), weights, 0.0))
