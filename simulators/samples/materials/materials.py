"""Materials: composition, density and attenuation at any X-ray energy.

Cross sections, edges and level widths are those of xraylib (Schoonjans et al., Spectrochim. Acta B 66, 776, 2011): the
total mass attenuation, photoelectric and both kinds of scattering, from 0.1 to 800 keV. This module is imported only
if a scene names a material.

The K edge of a transition metal in an oxide has its white line in place of the tables' bare step. Tables of free atoms
have a step; a solid has a rise as wide as the core-hole level (Campbell & Papp, At. Data Nucl. Data Tables 77, 1, 2001,
included in xraylib: Mn 1.11, Co 1.28, Ni 1.39 eV) and, in an oxide, a line of bound final states above it. The usual
form of both is

    f(E) = 1/2 + arctan((E - E_step) / (Γ/2)) / π + h / (1 + ((E - E_line) / (γ/2))²)        (Teo, EXAFS, 1986, ch. 2)

The attenuation is that of the other electrons plus f times the jump. Power laws continue both through the edge.
Oxidation moves E_step and E_line up. Between 60 and 150 eV from the edge this form is blended into the table,
which holds beyond. The jump of the edge is the table's.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import xraylib
from numpy.typing import ArrayLike, NDArray

from simulators.frame.mapping import SceneError, build, located
from simulators.samples.materials.spectrum import Attenuation

Reals = NDArray[np.float64]
MassAttenuation = Callable[[Reals], Reals]  # Mass attenuation in cm²/g at energies in keV, as tabulated

NEAR, FAR = 60.0, 150.0
MOST_SHIFT = 20.0  # eV; largest shift of an edge, so that it stays in the range in which the form replaces the table
# eV from the edge at which a table is read, because closer to it an interpolating spline may still be rising
CLEAR = 1.0


@dataclass(frozen=True)
class KEdge:
    """Shape of an element's K edge in a layered oxide.

    Attributes:
        white_line: energy in keV of the white line of the fully charged oxide.
        shift: energy in eV by which the edge is lower in the discharged oxide.
        below: energy in eV by which the middle of the arctangent is below the white line.
        height: height of the white line, in units of the jump.
        width: full width at half maximum of the white line in eV.
    """

    white_line: float
    shift: float
    below: float = 5.0
    height: float = 0.6
    width: float = 5.0


K_EDGES: Mapping[int, KEdge] = MappingProxyType(
    {25: KEdge(6.5610, shift=0.0), 27: KEdge(7.7290, shift=1.0), 28: KEdge(8.3485, shift=2.0)}
)
"""By atomic number. The Ni line of the charged state is the peak in the battery thesis that this instrument follows
(figure 2.1: 8348.5 eV). The thesis gives this peak for LiCoO2, but the peak is next to the K edge of nickel, 640 eV
above the edge of cobalt. The lines of Co and Mn are at the energies in spectra of LiCoO2 and of Mn(IV) oxides. Nickel
carries most of the charge and cobalt hardly moves (Nonaka et al., J. Power Sources 162, 1329, 2006). Shifts, heights
and widths have the right order of magnitude, but belong to no particular sample. Every monochromator has an offset of
about an eV."""


def near_edge(
    energies: Reals, table: MassAttenuation, edge: float, level_width: float, shape: KEdge, charge: float
) -> Reals:
    """Mass attenuation in cm²/g with the near-edge structure, float64 [energy].

    Args:
        energies: keV.
        table: table of the element. edge: energy in keV at which the table has its step. level_width: Γ in eV, full
            width of the K level. shape: shape of the edge. charge: state of charge, 0 (fully lithiated) to 1.
    """
    tabulated = table(energies)
    away = (energies - edge) * 1e3
    close = np.abs(away) < FAR
    if not close.any():
        return tabulated
    rest = _power_law(table, edge, -CLEAR, -FAR)(energies[close])
    jump = _power_law(table, edge, CLEAR, FAR)(energies[close]) - rest
    line = shape.white_line - (1 - charge) * shape.shift * 1e-3
    f = profile((energies[close] - line) * 1e3, level_width, shape)
    t = np.clip((np.abs(away[close]) - NEAR) / (FAR - NEAR), 0, 1)
    weight = np.cos(np.pi / 2 * t) ** 2
    out = tabulated.copy()
    out[close] += weight * (rest + f * jump - tabulated[close])
    return out


def profile(from_line: Reals, level_width: float, shape: KEdge) -> Reals:
    """f of the module's docstring: 0 far below the edge, 1 far above; `from_line` is E - E_line in eV."""
    step = 0.5 + np.arctan((from_line + shape.below) / (level_width / 2)) / np.pi
    return step + shape.height / (1 + (from_line / (shape.width / 2)) ** 2)


def _power_law(table: MassAttenuation, edge: float, near: float, far: float) -> MassAttenuation:
    """The power law A E^b through the table at two distances (eV) from the edge."""
    x = np.array([edge + near * 1e-3, edge + far * 1e-3])
    y = table(x)
    slope = np.log(y[1] / y[0]) / np.log(x[1] / x[0])
    return lambda energies: y[0] * (energies / x[0]) ** slope


LEAST_KEV, MOST_KEV = 0.1, 800.0
AVOGADRO = 0.602214076  # 1e24 / mol


@dataclass(frozen=True)
class Material:
    """Composition and density of a material.

    Attributes:
        name: name in scenes and labels.
        density: density in g/cm³.
        fractions: (atomic number, share of the mass) of each element.
        state_of_charge: for a cathode material, 0 (fully lithiated) to 1. The attenuation then has the near-edge
            structure of `edge`; None: the attenuation is that of the tables. Composition and density stay those of the
            discharged state: lithium contributes about a thousandth of an oxide's attenuation.
        edge_shift_ev: eV from the edge of state 0 to that of state 1, the same for Mn, Co and Ni, -20 ... 20; None:
            the value in `edge`.
    """

    name: str
    density: float
    fractions: tuple[tuple[int, float], ...]
    state_of_charge: float | None = None
    edge_shift_ev: float | None = None

    def __post_init__(self) -> None:
        if not 0 < self.density < 100:
            raise ValueError(f"{self.name}: density must lie between 0 and 100 g/cm3, got {self.density}")
        if self.state_of_charge is None:
            if self.edge_shift_ev is not None:
                raise ValueError(f"{self.name}: edge_shift_ev needs a state_of_charge")
            return
        if not 0 <= self.state_of_charge <= 1:
            raise ValueError(f"{self.name}: state_of_charge must lie in 0 ... 1, got {self.state_of_charge}")
        if self.edge_shift_ev is not None and not abs(self.edge_shift_ev) <= MOST_SHIFT:
            raise ValueError(f"{self.name}: edge_shift_ev must lie in -20 ... 20 eV, got {self.edge_shift_ev}")
        if not K_EDGES.keys() & dict(self.fractions).keys():
            symbols = ", ".join(xraylib.AtomicNumberToSymbol(z) for z in K_EDGES)
            raise ValueError(
                f"{self.name}: state_of_charge is for an oxide with {symbols}; this material has none of them"
            )

    def attenuation(self, energies: ArrayLike) -> Reals:
        """Linear attenuation in 1/mm at `energies` in keV, float64, with the shape of `energies`.

        Raises:
            ValueError: an energy is outside the tables.
        """
        e = np.asarray(energies, dtype=np.float64)
        if not ((e >= LEAST_KEV) & (e <= MOST_KEV)).all():
            raise ValueError(
                f"attenuation is tabulated from {LEAST_KEV} to {MOST_KEV:g} keV; got {e.min():g} ... {e.max():g} keV"
            )
        flat = e.ravel()
        cm2_per_g = sum((share * self._element(z, flat) for z, share in self.fractions), start=np.zeros_like(flat))
        return (0.1 * self.density * cm2_per_g).reshape(e.shape)

    def _element(self, z: int, energies: Reals) -> Reals:
        """Mass attenuation of an element in cm²/g."""

        def table(energies: Reals) -> Reals:
            return np.array([xraylib.CS_Total(z, float(energy)) for energy in energies])

        if self.state_of_charge is None or z not in K_EDGES:
            return table(energies)
        shape = K_EDGES[z] if self.edge_shift_ev is None else replace(K_EDGES[z], shift=self.edge_shift_ev)
        edge, width = xraylib.EdgeEnergy(z, xraylib.K_SHELL), xraylib.AtomicLevelWidth(z, xraylib.K_SHELL) * 1e3
        return near_edge(energies, table, edge, width, shape, self.state_of_charge)


def of_formula(name: str, formula: str, density: float) -> Material:
    """A material by chemical formula ("LiNi0.6Mn0.2Co0.2O2") and density in g/cm³.

    Raises:
        ValueError: the formula or the density is not valid.
    """
    return Material(name, density, _fractions(formula))


def by_mass(name: str, density: float, parts: Mapping[str, float]) -> Material:
    """A mixture of formulas by their shares of the mass; the shares may have any sum."""
    total: dict[int, float] = {}
    for formula, mass in parts.items():
        for z, share in _fractions(formula):
            total[z] = total.get(z, 0.0) + mass / sum(parts.values()) * share
    return Material(name, density, tuple(sorted(total.items())))


def by_volume(name: str, first: Material, second: Material, share: float) -> Material:
    """A mixture of two materials: the fraction `share` of the volume is `first`, the remaining volume is `second`."""
    masses = (share * first.density, (1 - share) * second.density)
    total: dict[int, float] = {}
    for mass, material in zip(masses, (first, second), strict=True):
        for z, fraction in material.fractions:
            total[z] = total.get(z, 0.0) + mass / sum(masses) * fraction
    return Material(name, sum(masses), tuple(sorted(total.items())))


def layered_oxide(name: str, formula: str, a: float, c: float) -> Material:
    """A layered oxide (space group R-3m, three formula units a hexagonal cell): the crystal's density, by a and c in
    Å."""
    atoms = xraylib.CompoundParser(formula)
    mass = sum(n * xraylib.AtomicWeight(z) for z, n in zip(atoms["Elements"], atoms["nAtoms"], strict=True))
    return of_formula(name, formula, 3 * mass / (AVOGADRO * 3**0.5 / 2 * a**2 * c))


def _fractions(formula: str) -> tuple[tuple[int, float], ...]:
    parsed = xraylib.CompoundParser(formula)
    return tuple(zip(parsed["Elements"], parsed["massFractions"], strict=True))


def _nmc(name: str) -> Material | None:
    """LiNi_xMn_yCo_zO2 by the digits of its name: NMC622, NMC811, NMC111."""
    match = re.fullmatch(r"NMC(\d)(\d)(\d)", name)
    if match is None or (total := sum(map(int, match.groups()))) == 0:
        return None
    shares = [f"{symbol}{int(n) / total:.9f}" for symbol, n in zip(("Ni", "Mn", "Co"), match.groups(), strict=True)]
    # Cells of NMC111 to NMC811 differ from it by less than 1 % in volume (Noh et al., J. Power Sources 233, 121, 2013).
    return layered_oxide(name, f"Li{''.join(share for share in shares if float(share[2:]) > 0)}O2", 2.868, 14.22)


def _electrolyte() -> Material:
    """1 mol/l LiPF6 in ethylene and dimethyl carbonate, equal masses; 1.30 g/cm³ as sold (LP30)."""
    salt = 151.9  # g/l
    return by_mass("electrolyte", 1.30, {"LiPF6": salt, "C3H4O3": (1300 - salt) / 2, "C3H6O3": (1300 - salt) / 2})


_KNOWN: Mapping[str, Callable[[], Material]] = MappingProxyType(
    {
        # Cell of Orman & Wiseman, Acta Cryst. C 40, 12, 1984.
        "LiCoO2": lambda: layered_oxide("LiCoO2", "LiCoO2", 2.8166, 14.052),
        "graphite": lambda: of_formula("graphite", "C", 2.26),  # density of the crystal (CRC Handbook)
        "Al": lambda: of_formula("Al", "Al", 2.699),  # elements: NIST, X-ray mass attenuation coefficients, table 1
        "Cu": lambda: of_formula("Cu", "Cu", 8.96),
        "Si": lambda: of_formula("Si", "Si", 2.33),
        "Ni": lambda: of_formula("Ni", "Ni", 8.902),
        # steel of cans: low-carbon steel
        "steel": lambda: by_mass("steel", 7.85, {"Fe": 0.995, "Mn": 0.004, "C": 0.001}),
        "stainless_steel": lambda: by_mass("stainless_steel", 8.0, {"Fe": 0.71, "Cr": 0.19, "Ni": 0.1}),  # AISI 304
        "electrolyte": _electrolyte,
        "polypropylene": lambda: of_formula("polypropylene", "C3H6", 0.90),  # NIST, table 2, as are the next three
        "polyethylene": lambda: of_formula("polyethylene", "C2H4", 0.93),
        "water": lambda: of_formula("water", "H2O", 1.0),
        "air": lambda: by_mass("air", 1.205e-3, {"C": 0.000124, "N": 0.755267, "O": 0.231781, "Ar": 0.012827}),
        "PVDF": lambda: of_formula("PVDF", "C2H2F2", 1.78),  # binder; Brandrup, Polymer Handbook
        # A film of polypropylene with 41 % of pores (Celgard 2400), full of electrolyte.
        "separator": lambda: by_volume("separator", _KNOWN["polypropylene"](), _electrolyte(), 0.59),
    }
)


@dataclass(frozen=True)
class _Properties:
    """Properties of a material that a scene states; see Material."""

    formula: str | None = None
    density: float | None = None
    state_of_charge: float | None = None
    edge_shift_ev: float | None = None


@dataclass(frozen=True)
class Palette:
    """The materials that a scene can name: the known ones and its own.

    Attributes:
        own: materials of the scene by name; they take precedence over the known materials.
    """

    own: Mapping[str, Material] = field(default_factory=lambda: MappingProxyType({}))

    def __call__(self, name: str) -> Material:
        """Raises ValueError if no material has this name."""
        material = self.own.get(name) or known(name)
        if material is None:
            raise ValueError(
                f"material {name!r} is unknown; known: {', '.join([*self.own, *_KNOWN])}, NMC and three digits; or add "
                f"materials: {{{name}: {{formula: ..., density: ...}}}} in the phantom (g/cm3)"
            )
        return material

    def filters(self, name: str) -> Attenuation:
        """The attenuation of a material as a filter, for `spectrum.light`. Raises ValueError for an unknown
        material."""
        return self(name).attenuation


def palette_of(where: str, entry: Any) -> Palette:
    """The materials of a scene: the known ones, and those that its key `materials` changes or adds.

        materials:
          NMC811: {state_of_charge: 0.5}
          coating: {formula: Al2O3, density: 3.95}

    Raises:
        SceneError: an entry is wrong.
    """
    entry = {} if entry is None else entry
    if not isinstance(entry, Mapping):
        raise SceneError(f"{where} must be a mapping from names to the properties of materials; got {entry!r}")
    return Palette({str(name): _own(f"{where}.{name}", str(name), settings) for name, settings in entry.items()})


def known(name: str) -> Material | None:
    """A known material by its name; None if the name is unknown."""
    return _KNOWN[name]() if name in _KNOWN else _nmc(name)


def _own(where: str, name: str, settings: Any) -> Material:
    properties = build(_Properties, where, settings)
    base = known(name)
    density = properties.density if properties.density is not None else base.density if base else None
    if density is None or (base is None and properties.formula is None):
        raise SceneError(f"{where}: {name!r} is not a known material; give formula and density (g/cm3)")
    with located(where):
        if base is None or properties.formula is not None:
            base = of_formula(name, str(properties.formula), density)
        return replace(
            base, density=density, state_of_charge=properties.state_of_charge, edge_shift_ev=properties.edge_shift_ev
        )
