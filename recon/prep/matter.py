"""Attenuation, phase shift and absorption edges of materials, for the phase and beam-hardening corrections.

Cross sections are from xraylib, 0.1 to 800 keV (Schoonjans et al., Spectrochim. Acta B 66, 776, 2011). The simulator
uses the same tables, compositions and densities, but its own formulas, so that no correction is tested with the
formulas that made its data.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import numpy as np
import xraylib
from numpy.typing import ArrayLike

from recon.base.arrays import F64
from recon.base.units import HC

_LEAST_KEV, _MOST_KEV = 0.1, 800.0
_DECREMENT = 0.0004151791  # keV² cm³/mol: classical electron radius x (hc)² x Avogadro's number / 2 pi
_ELECTRON_KEV = 510.99895
_JOULE_PER_KEV = 1.602176634e-16
_NODES = 513  # number of energies in a tube spectrum
# lowest energy of a tube spectrum; energies with a smaller share of the photons are left out
_SOFTEST_KEV, _NOTHING = 1.0, 1e-7
_LP30 = {"LiPF6": 151.9, "C3H4O3": 574.05, "C3H6O3": 574.05}  # g/l: 1 mol/l in equal masses of two carbonates

KNOWN: Mapping[str, tuple[float, Mapping[str, float]]] = MappingProxyType(
    {
        "LiCoO2": (5.05011, {"LiCoO2": 1}),
        "graphite": (2.26, {"C": 1}),
        "Al": (2.699, {"Al": 1}),
        "Cu": (8.96, {"Cu": 1}),
        "Si": (2.33, {"Si": 1}),
        "Ni": (8.902, {"Ni": 1}),
        "steel": (7.85, {"Fe": 0.995, "Mn": 0.004, "C": 0.001}),
        "stainless_steel": (8.0, {"Fe": 0.71, "Cr": 0.19, "Ni": 0.1}),
        "electrolyte": (1.30, _LP30),
        "polypropylene": (0.90, {"C3H6": 1}),
        "polyethylene": (0.93, {"C2H4": 1}),
        "water": (1.0, {"H2O": 1}),
        "air": (1.205e-3, {"C": 0.000124, "N": 0.755267, "O": 0.231781, "Ar": 0.012827}),
        "PVDF": (1.78, {"C2H2F2": 1}),
        # Polypropylene with 41 % of pores, which are filled with electrolyte.
        "separator": (1.064, {"C3H6": 590 * 0.90, **{salt: 0.41 * mass for salt, mass in _LP30.items()}}),
    }
)
"""Density in g/cm³ and mass fractions; see simulators.samples.materials.materials for the sources."""


_SHELLS = {"K": xraylib.K_SHELL, "L1": xraylib.L1_SHELL, "L2": xraylib.L2_SHELL, "L3": xraylib.L3_SHELL}
HEAVIEST = 92  # atomic number of the heaviest element, uranium


@dataclass(frozen=True)
class TabulatedEdge:
    """An absorption edge of a free atom, with its `energy` in keV. In compounds the edge is a few electronvolts
    higher."""

    element: str
    shell: str
    energy: float

    @property
    def named(self) -> str:
        """Name of the edge with its energy."""
        return f"{self.element} {self.shell} {self.energy:.4f} keV"


def edges_of(elements: Iterable[int]) -> list[TabulatedEdge]:
    """K and L edges of elements (atomic numbers), in ascending order."""
    edges = []
    for z in elements:
        for shell, number in _SHELLS.items():
            try:
                energy = float(xraylib.EdgeEnergy(z, number))
            except ValueError:  # the element has no such shell
                continue
            edges.append(TabulatedEdge(xraylib.AtomicNumberToSymbol(z), shell, energy))
    return sorted(edges, key=lambda edge: edge.energy)


def delta_beta(name: str, energy_kev: float) -> float:
    """Ratio of delta to beta of the refractive index 1 - delta + i beta. The ratio does not depend on the density.

    delta is computed from the electron density and the dispersion f' (Als-Nielsen & McMorrow 2011, Elements of Modern
    X-ray Physics, equation 3.2); beta = mu wavelength / 4 pi.

    Args:
        name: name of a known material, or a chemical formula.

    Raises:
        ValueError: the name or formula is unknown, or the energy is outside the tables.
    """
    beta = 0.1 * float(mass_attenuation(name, energy_kev)) * HC / energy_kev / (4 * math.pi)
    electrons = sum(
        share * (z + xraylib.Fi(z, energy_kev)) / xraylib.AtomicWeight(z) for z, share in _fractions(name).items()
    )
    return float(_DECREMENT * electrons / energy_kev**2 / beta)


def mass_attenuation(name: str, energies: ArrayLike) -> F64:
    """Mass attenuation in cm²/g at energies in keV, float64 of the same shape; errors as in `delta_beta`."""
    e = np.asarray(energies, np.float64)
    if not ((e >= _LEAST_KEV) & (e <= _MOST_KEV)).all():
        raise ValueError(
            f"attenuation is tabulated from {_LEAST_KEV} to {_MOST_KEV:g} keV, got {e.min():g} to {e.max():g} keV"
        )
    total = np.zeros(e.size)
    for z, share in _fractions(name).items():
        total += share * np.array([xraylib.CS_Total(z, float(energy)) for energy in e.flat])
    return total.reshape(e.shape)


def absorbed_dose(name: str, energy_kev: float, photons_per_mm2: float) -> float:
    """Entrance dose in gray of photons of one energy: fluence x energy x mass energy absorption.

    The energies of photoelectrons and of Compton electrons count as absorbed. Fluorescence also counts as absorbed,
    which makes the dose up to a quarter too high just above an edge. Inside the sample the dose is lower, because the
    material in front attenuates the beam. xraylib's own coefficient (CS_Energy) is not used, because for water at 20
    keV it is 30 % below NIST's.

    Raises:
        ValueError: as for `delta_beta`, or the energy is outside 1 to 200 keV.
    """
    if not 1.0 <= energy_kev <= 200.0:
        raise ValueError(f"doses are tabulated from 1 to 200 keV, got {energy_kev:g} keV")
    electron_share = energy_kev / (
        _ELECTRON_KEV + 2.1 * energy_kev
    )  # mean share of a Compton electron, to 2 % (Klein-Nishina)
    absorbed = sum(  # cm²/g
        share * (xraylib.CS_Photo(z, energy_kev) + electron_share * xraylib.CS_Compt(z, energy_kev))
        for z, share in _fractions(name).items()
    )
    return float(photons_per_mm2 * 1e2 * energy_kev * _JOULE_PER_KEV * absorbed * 1e3)


def tube_spectrum(kv: float, filters: Mapping[str, float]) -> tuple[F64, F64]:
    """Spectrum of an X-ray tube: bremsstrahlung of a thick target (Kramers, Phil. Mag. 46, 836, 1923).

    Args:
        filters: thickness in mm of each filter (known materials) in front of the sample.

    Returns:
        Energies in keV, float64 [energy], and their relative numbers of photons (not normalised).

    Raises:
        ValueError: the voltage is outside 5 to 800 kV, the density of a filter is unknown, or no photons pass the
            filters.
    """
    if not 5 <= kv <= 800:
        raise ValueError(f"the tube voltage must be 5 to 800 kV, got {kv} kV")
    nodes, node_weights = _gauss_rule()
    energies = _SOFTEST_KEV + (kv - _SOFTEST_KEV) * (nodes + 1) / 2
    depth = np.zeros(_NODES)
    for name, mm in filters.items():
        if name not in KNOWN:
            raise ValueError(f"the density of the filter {name!r} is unknown; use one of {', '.join(KNOWN)}")
        depth += 0.1 * mm * KNOWN[name][0] * mass_attenuation(name, energies)
    weights = node_weights * (kv - energies) / energies * np.exp(-depth)
    if not weights.any():
        raise ValueError(f"no X-rays of the tube at {kv:g} kV pass its filters {dict(filters)} (thickness in mm)")
    significant = weights > _NOTHING * weights.sum()
    return energies[significant], weights[significant]


@cache  # takes half a second
def _gauss_rule() -> tuple[F64, F64]:
    """Nodes and weights of Gauss quadrature from -1 to 1."""
    return np.polynomial.legendre.leggauss(_NODES)


def _fractions(name: str) -> dict[int, float]:
    """Mass fraction of each element, by atomic number."""
    nmc = re.fullmatch(r"NMC(\d)(\d)(\d)", name)
    # a layered oxide, named by the shares of its metals, such as NMC622
    if nmc is not None and any(map(int, nmc.groups())):
        total = sum(map(int, nmc.groups()))
        metals = [f"{symbol}{int(n) / total:.9f}" for symbol, n in zip(("Ni", "Mn", "Co"), nmc.groups(), strict=True)]
        name = f"Li{''.join(metal for metal in metals if float(metal[2:]) > 0)}O2"
    parts = KNOWN[name][1] if name in KNOWN else {name: 1.0}
    shares: dict[int, float] = {}
    for formula, mass in parts.items():
        try:
            parsed = xraylib.CompoundParser(formula)
        except ValueError as error:
            raise ValueError(
                f"{name!r} is not a known material and not a chemical formula; give a formula such as Al2O3, or one "
                f"of {', '.join(sorted(KNOWN))}"
            ) from error
        for z, share in zip(parsed["Elements"], parsed["massFractions"], strict=True):
            shares[z] = shares.get(z, 0.0) + mass / sum(parts.values()) * share
    return shares
