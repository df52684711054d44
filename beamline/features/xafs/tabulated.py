"""Tabulated edges: which element and shell an energy belongs to, and whether a material has an edge in a range.

Energies are those of free atoms in xraylib (Schoonjans et al., Spectrochim. Acta B 66, 776, 2011). Compounds lie a few
electronvolts higher: the white line of a nickel oxide, 8348.5 eV, is 16 eV above the K edge of nickel.
"""

from __future__ import annotations

from collections.abc import Sequence

from recon.prep.matter import HEAVIEST, TabulatedEdge, edges_of


def _beside(edge: TabulatedEdge, energy: float) -> str:
    """The edge, and how far it is from an energy in keV."""
    apart = 1e3 * (edge.energy - energy)
    return f"{edge.named}, {abs(apart):.4g} eV {'above' if apart > 0 else 'below'}"


def nearest_edges(energy: float, elements: Sequence[int] = ()) -> list[TabulatedEdge]:
    """The nearest edge of these elements; of no elements, the nearest K edge and the nearest L3 edge of all."""

    def nearest(edges: Sequence[TabulatedEdge]) -> list[TabulatedEdge]:
        return sorted(edges, key=lambda edge: abs(edge.energy - energy))[:1]

    if elements:
        return nearest(edges_of(elements))
    edges = edges_of(range(1, HEAVIEST + 1))
    return [edge for shell in ("K", "L3") for edge in nearest([each for each in edges if each.shell == shell])]


def edge_sentence(material: str, elements: Sequence[int], low: float, high: float, edge: float | None) -> str:
    """Which tabulated edge an edge that was found belongs to; or, without one, where the material has its own.

    Args:
        material: its name; empty where it is not known. elements: of the material; none: all.
        low, high: range of energies, keV. edge: keV; None: none was found.
    """
    if edge is not None:
        return f"{'; '.join(_beside(each, edge) for each in nearest_edges(edge, elements))}"
    if not elements:
        return ""
    if own := _within(edges_of(elements), low, high):
        return f"{material} has {', '.join(each.named for each in own)} in this range"
    nearest = nearest_edges((low + high) / 2, elements)
    if not nearest:
        return f"{material} has no edge at all"
    where = _beside(nearest[0], low if nearest[0].energy < low else high)
    sentence = f"{material} has no edge from {low:.4f} to {high:.4f} keV: its nearest is {where} the range"
    others = [each.named for each in _within(edges_of(range(1, HEAVIEST + 1)), low, high) if each.shell == "K"]
    return f"{sentence}. In the range lies {', '.join(others)}, of an element that it lacks" if others else sentence


def _within(edges: Sequence[TabulatedEdge], low: float, high: float) -> list[TabulatedEdge]:
    return [each for each in edges if low <= each.energy <= high]
