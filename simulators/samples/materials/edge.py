"""Edge: the K edge of a transition metal in an oxide, with its white line, in place of the tables' bare step.

Tables of free atoms have a step; a solid has a rise as wide as the core-hole level (Campbell & Papp, At. Data Nucl.
Data Tables 77, 1, 2001, included in xraylib: Mn 1.11, Co 1.28, Ni 1.39 eV) and, in an oxide, a line of bound final
states above it. The usual form of both is

    f(E) = 1/2 + arctan((E - E_step) / (Γ/2)) / π + h / (1 + ((E - E_line) / (γ/2))²)        (Teo, EXAFS, 1986, ch. 2)

The attenuation is that of the other electrons plus f times the jump. Power laws continue both through the edge.
Oxidation moves E_step and E_line up. Between 60 and 150 eV from the edge this form is blended into the table,
which holds beyond. The jump of the edge is the table's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]
MassAttenuation = Callable[[Reals], Reals]  # Mass attenuation in cm²/g at energies in keV, as tabulated

NEAR, FAR = 60.0, 150.0
MOST_SHIFT = 20.0  # eV: an edge may move so far, so that it stays in the range where the form replaces the table
CLEAR = 1.0  # eV from the edge at which a table is read: closer, an interpolating spline may still be rising


@dataclass(frozen=True)
class KEdge:
    """Shape of an element's K edge in a layered oxide.

    Attributes:
        white_line: keV, of the fully charged oxide.
        shift: eV by which the edge lies lower in the discharged oxide.
        below: eV from the arctangent's middle up to the white line.
        height: of the white line, in jumps.
        width: of the white line, eV, full at half its height.
    """

    white_line: float
    shift: float
    below: float = 5.0
    height: float = 0.6
    width: float = 5.0


K_EDGES: Mapping[int, KEdge] = MappingProxyType(
    {25: KEdge(6.5610, shift=0.0), 27: KEdge(7.7290, shift=1.0), 28: KEdge(8.3485, shift=2.0)}
)
"""By atomic number. The Ni line of the charged state is the peak in the battery thesis that this instrument
follows (figure 2.1: 8348.5 eV). It is given for LiCoO2 there, but lies next to the K edge of nickel, 640 eV above that
of cobalt. Co and Mn lie where spectra of LiCoO2 and of Mn(IV) oxides do. Nickel carries most of the charge and cobalt
hardly moves (Nonaka et al., J. Power Sources 162, 1329, 2006). Shifts, heights and widths have the right
order of magnitude, but belong to no particular sample. Every monochromator has an offset of about an eV."""


def near_edge(
    energies: Reals, table: MassAttenuation, edge: float, level_width: float, shape: KEdge, charge: float
) -> Reals:
    """Mass attenuation in cm²/g with the near-edge structure, float64 [energy].

    Args:
        energies: keV.
        table: of the element.
        edge: keV, where the table has its step.
        level_width: eV, Γ: full width of the K level.
        shape: of the edge.
        charge: state of charge, 0 (fully lithiated) to 1.
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
    """A E^b through the table at two distances (eV) from the edge."""
    x = np.array([edge + near * 1e-3, edge + far * 1e-3])
    y = table(x)
    slope = np.log(y[1] / y[0]) / np.log(x[1] / x[0])
    return lambda energies: y[0] * (energies / x[0]) ** slope
