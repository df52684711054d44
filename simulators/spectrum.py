"""Spectrum: a beam's energies and their weights, only as many as its samples need, and the depth that all of them see.

A detector adds up the light of all energies, so what it sees of a sample is the effective depth
-log(sum_e w_e exp(-sum_m mu_m(e) L_m)): the thicknesses L_m are paid for once, whatever the number of energies.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from simulators.bands import share_rows
from simulators.beam import Beam, Tube

Reals = NDArray[np.float64]
Attenuation = Callable[[ArrayLike], Reals]
"""Linear attenuation in 1/mm at energies in keV."""

NODES = (3, 5, 9, 17, 33, 65, 129, 257, 513)
ENOUGH = 1e-5
"""Of the open beam: far below the noise of a pixel that holds 7000 electrons."""
_FWHM = math.sqrt(8 * math.log(2))
_LEAST_KEV = 1.0
_NOTHING = 1e-7  # of the light: what a filter lets through of the lowest energies
DARK = 1e-25
"""Of the open beam: from here on each ray is summed for itself, so that any depth is told as it is."""
ROUNDING = 1e-14
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
    from simulators.fewer_energies import fewer

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


def effective_depth(thickness: Reals, attenuation: Reals, weights: Reals) -> Reals:
    """-log(sum_e w_e exp(-sum_m attenuation[e, m] thickness[m])), float64 [row, col].

    Args:
        thickness: mm, float64 [constituent, row, col].
        attenuation: 1/mm, float64 [energy, constituent].
        weights: float64 [energy], of sum 1.
    """
    out = np.empty(thickness.shape[1:])
    chords, rows = np.ascontiguousarray(thickness), np.ascontiguousarray(attenuation)

    def work(first: int, end: int) -> None:
        _effective_depth(first, end, chords, rows, weights, out)

    share_rows(work, (thickness.shape[1], thickness.shape[2]))
    return out


@njit(cache=True, nogil=True)
def _effective_depth(row: int, end: int, thickness: Reals, attenuation: Reals, weights: Reals, out: Reals) -> None:
    """Of the rows from `row` to before `end`; air left and right of the sample costs nothing."""
    cols = out.shape[1]
    spare = np.empty((2, cols))
    for j in range(row, end):
        out[j] = 0.0
        first, last = cols, 0
        for m in range(thickness.shape[0]):
            i = 0
            while i < first and thickness[m, j, i] == 0.0:
                i += 1
            first, i = min(first, i), cols
            while i > last and thickness[m, j, i - 1] == 0.0:
                i -= 1
            last = max(last, i)
        if first >= last:
            continue
        depth, seen = spare[0, : last - first], spare[1, : last - first]
        seen[:] = 0.0
        for e in range(weights.size):
            _put_depths(depth, thickness, j, first, attenuation[e])
            _add_light(seen, depth, weights[e])
        for i in range(seen.size):
            if abs(seen[i] - 1.0) < ROUNDING:
                continue  # no matter: exactly nothing
            out[j, first + i] = (
                -math.log(seen[i]) if seen[i] > DARK else _deep(thickness[:, j, first + i], attenuation, weights)
            )


@njit(cache=True, nogil=True, fastmath={"contract"})
def _put_depths(depth: Reals, thickness: Reals, j: int, first: int, attenuation: Reals) -> None:
    """Depth of one energy in the columns from `first` on."""
    for m in range(attenuation.size):
        mu, chord = attenuation[m], thickness[m, j, first : first + depth.size]
        if m == 0:
            for i in range(depth.size):
                depth[i] = mu * chord[i]
        else:
            for i in range(depth.size):
                depth[i] += mu * chord[i]


@njit(cache=True, nogil=True, fastmath={"contract"})
def _add_light(seen: Reals, depth: Reals, weight: float) -> None:
    """Add weight x exp(-depth), to 1e-13 of itself: Taylor's series of a 256th, squared eight times, which the compiler
    does for several columns at once, as it cannot do the library's exp. What is deeper than 80 counts as 80."""
    for i in range(seen.size):
        r = -(depth[i] if depth[i] < 80.0 else 80.0) * (1.0 / 256.0)
        p = 1.0 + r * (1.0 / 12.0)
        p = 1.0 + r * (1.0 / 11.0) * p
        p = 1.0 + r * (1.0 / 10.0) * p
        p = 1.0 + r * (1.0 / 9.0) * p
        p = 1.0 + r * (1.0 / 8.0) * p
        p = 1.0 + r * (1.0 / 7.0) * p
        p = 1.0 + r * (1.0 / 6.0) * p
        p = 1.0 + r * (1.0 / 5.0) * p
        p = 1.0 + r * (1.0 / 4.0) * p
        p = 1.0 + r * (1.0 / 3.0) * p
        p = 1.0 + r * (1.0 / 2.0) * p
        p = 1.0 + r * p
        p *= p
        p *= p
        p *= p
        p *= p
        p *= p
        p *= p
        p *= p
        seen[i] += weight * (p * p)


@njit(cache=True, nogil=True)
def _deep(thickness: Reals, attenuation: Reals, weights: Reals) -> float:
    """The effective depth of one ray with the hardest energy taken out of the sum, so that none is too deep for exp."""
    least = np.inf
    for e in range(weights.size):
        least = min(least, _dot(attenuation[e], thickness))
    seen = 0.0
    for e in range(weights.size):
        seen += weights[e] * math.exp(least - _dot(attenuation[e], thickness))
    return least - math.log(seen)


@njit(cache=True, nogil=True)
def _dot(attenuation: Reals, thickness: Reals) -> float:
    depth = 0.0
    for m in range(attenuation.size):
        depth += attenuation[m] * thickness[m]
    return depth
