"""Palette: materials by name with their densities, and a scene's changes and additions to them."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from simulators.frame.mapping import SceneError, build, located
from simulators.samples.materials.materials import Material, by_mass, by_volume, layered_oxide, of_formula
from simulators.samples.materials.spectrum import Attenuation


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
        "graphite": lambda: of_formula("graphite", "C", 2.26),  # the crystal's (CRC Handbook)
        "Al": lambda: of_formula("Al", "Al", 2.699),  # elements: NIST, X-ray mass attenuation coefficients, table 1
        "Cu": lambda: of_formula("Cu", "Cu", 8.96),
        "Si": lambda: of_formula("Si", "Si", 2.33),
        "Ni": lambda: of_formula("Ni", "Ni", 8.902),
        "steel": lambda: by_mass("steel", 7.85, {"Fe": 0.995, "Mn": 0.004, "C": 0.001}),  # of cans: low carbon
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
    """Properties of a material that a scene gives; see Material."""

    formula: str | None = None
    density: float | None = None
    state_of_charge: float | None = None
    edge_shift_ev: float | None = None


@dataclass(frozen=True)
class Palette:
    """The materials that a scene can name: the known ones and its own.

    Attributes:
        own: by name; they take precedence.
    """

    own: Mapping[str, Material] = field(default_factory=lambda: MappingProxyType({}))

    def __call__(self, name: str) -> Material:
        """Raises ValueError where no material has this name."""
        material = self.own.get(name) or known(name)
        if material is None:
            raise ValueError(
                f"material {name!r} is unknown; known: {', '.join([*self.own, *_KNOWN])}, NMC and three digits; or add "
                f"materials: {{{name}: {{formula: ..., density: ...}}}} in the phantom (g/cm3)"
            )
        return material

    def filters(self, name: str) -> Attenuation:
        """The attenuation of a material, for `spectrum.light`. Raises ValueError as above."""
        return self(name).attenuation


def palette_of(where: str, entry: Any) -> Palette:
    """The materials of a scene: the known ones, changed and added to by its key `materials`.

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
    given = build(_Properties, where, settings)
    base = known(name)
    density = given.density if given.density is not None else base.density if base else None
    if density is None or (base is None and given.formula is None):
        raise SceneError(f"{where}: {name!r} is not a known material; give formula and density (g/cm3)")
    with located(where):
        if base is None or given.formula is not None:
            base = of_formula(name, str(given.formula), density)
        return replace(base, density=density, state_of_charge=given.state_of_charge, edge_shift_ev=given.edge_shift_ev)
