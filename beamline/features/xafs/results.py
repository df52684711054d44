"""Results: an energy scan's result as sentences, as a table and as a picture, and the tabulated edges near it.

Tabulated edges are those of free atoms in xraylib (Schoonjans et al., Spectrochim. Acta B 66, 776, 2011). Compounds lie
a few electronvolts higher: the white line of a nickel oxide, 8348.5 eV, is 16 eV above the K edge of nickel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from beamline.core.files import refuse_existing, write_together, write_whole
from beamline.core.text import csv_text
from beamline.features.xafs.contrast import AbsorptionEdge, XafsCurve
from beamline.report.figures import WIDTH, finish, new_figure, one_panel, png
from recon.prep.matter import HEAVIEST, TabulatedEdge, edges_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False)
class XafsResult:
    """The curve of an energy scan and its edge.

    Attributes:
        title: what was scanned.
        material, elements: its name and atomic numbers, of a scene; empty: not known, as of a measured file.
    """

    title: str
    curve: XafsCurve
    edge: AbsorptionEdge
    material: str = ""
    elements: tuple[int, ...] = ()

    @property
    def tabulated(self) -> str:
        """Which edge of the tables it is, or where the material has its own; empty: nothing is known of it."""
        low, high = (float(end) for end in self.curve.energies[[0, -1]])
        return edge_sentence(self.material, self.elements, low, high, self.edge.energy)

    @property
    def criterion(self) -> str:
        """The quantity that is largest at the best energy."""
        return "absorption" if self.curve.contrast_to_noise is None else "contrast-to-noise"

    def data(self) -> dict[str, Any]:
        """Values for programs; energies in keV."""
        curve, edge = self.curve, self.edge
        first, last = curve.nearly_best
        cnr = curve.contrast_to_noise
        return {
            "what": self.title,
            "n_energies": curve.energies.size,
            "n_left_out": curve.left_out.size,
            "from_kev": curve.energies[0],
            "to_kev": curve.energies[-1],
            "edge_seen": edge.found,
            "why_not": edge.reason or None,
            "edge_kev": edge.energy,
            "tabulated": self.tabulated or None,
            "white_line_kev": edge.white_line,
            "best_kev": curve.energies[curve.best],
            "best_by": self.criterion,
            "best_from_kev": first,
            "best_to_kev": last,
            "contrast_to_noise": None if cnr is None else cnr[curve.best],
            "absorption": curve.absorption[curve.best],
            "unit": curve.unit,
            "noise": edge.noise,
        }


def lines(result: XafsResult) -> list[str]:
    """Sentences for people."""
    curve, edge = result.curve, result.edge
    text = [f"{result.title}: {curve.energies.size} energies, {curve.energies[0]:.4f} to {curve.energies[-1]:.4f} keV"]
    if curve.left_out.size:
        text.append(f"left out    {left_out(curve)}")
    if edge.energy is None:
        text.append(f"no edge     {edge.reason}")
    else:
        text.append(f"edge        {edge.energy:.4f} keV, where the absorption rises most steeply")
        text.append(
            "white line  none above the edge within the range"
            if edge.white_line is None
            else f"white line  {edge.white_line:.4f} keV, the top of the absorption"
        )
    text += [f"{'in tables':<12}{result.tabulated}"] if result.tabulated else []
    first, last = curve.nearly_best
    cnr = curve.contrast_to_noise
    height = "" if cnr is None else f" of {cnr[curve.best]:.3g} a pixel at this thickness"
    text.append(
        f"best        {curve.energies[curve.best]:.4f} keV: highest {result.criterion}{height} "
        f"(95 % of it from {first:.4f} to {last:.4f} keV)"
    )
    return text


def left_out(curve: XafsCurve) -> str:
    """The energies that are left out, as a sentence."""
    e = curve.left_out
    where = f"{e[0]:.4f} keV" if e.size == 1 else f"{e.size} energies between {e[0]:.4f} and {e[-1]:.4f} keV"
    return f"{where}: too dark, too bright for the sensor, or without values"


def table(curve: XafsCurve) -> str:
    """CSV: energy, absorption and, where they are known, contrast, noise and contrast-to-noise."""
    columns: dict[str, Any] = {"energy_kev": curve.energies, f"absorption ({curve.unit})": curve.absorption}
    if curve.contrast is not None and curve.noise is not None:
        columns |= {"contrast": curve.contrast, "noise": curve.noise}
    if (cnr := curve.contrast_to_noise) is not None:
        columns["contrast_to_noise"] = cnr
    rows = ([f"{value:.9g}" for value in row] for row in zip(*columns.values(), strict=True))
    return csv_text([columns, *rows])


def picture(result: XafsResult) -> bytes:
    """PNG: the absorption over energy with edge, white line and best energy, and the contrast-to-noise below."""
    curve, edge, cnr = result.curve, result.edge, result.curve.contrast_to_noise
    figure = new_figure((WIDTH, 3.4 if cnr is None else 5.4))
    panels: list[Axes] = list(np.ravel(np.asarray(figure.subplots(1 if cnr is None else 2, 1, sharex=True))))
    top = panels[0]
    top.plot(curve.energies, curve.absorption, color="0.25", lw=1.2, marker=".", ms=3)
    if cnr is not None:
        panels[1].plot(curve.energies, cnr, color="tab:green", lw=1.2, marker=".", ms=3)
    for energy in curve.left_out:
        top.axvline(energy, color="0.85", lw=1.0, zorder=0)
    marks = (
        (edge.energy, "edge", "tab:blue"),
        (edge.white_line, "white line", "tab:orange"),
        (float(curve.energies[curve.best]), "best", "tab:green"),
    )
    for axes in panels:
        for energy, name, colour in marks:
            if energy is not None:
                axes.axvline(energy, color=colour, lw=1.1, ls="--", label=f"{name} {energy:.4f} keV" * (axes is top))
    finish(panels[-1], "energy (keV)", "contrast-to-noise a pixel", grid=True)
    found = "" if edge.found else ", no edge found"
    finish(top, "energy (keV)", f"absorption ({curve.unit})", f"{result.title}{found}", grid=True)
    return png(figure)


def table_beside(target: Path) -> Path:
    """Path of the table that belongs to a picture."""
    return target.with_suffix(".csv")


def refuse_existing_results(target: Path) -> None:
    """Raises DataError if the picture or the table exists already, or if their folder does not exist."""
    for path in (target, table_beside(target)):
        refuse_existing(path)


def write_results(
    results: Sequence[XafsResult], target: Path, *, several: bool = False
) -> tuple[list[str], dict[str, Any]]:
    """Write the picture and the table beside it of a curve, or of several; errors as those of `write_both`.

    Returns:
        Sentences for people, and values for programs.
    """
    if several:
        write_both(picture_of_several(results), table_of_several(results), target)
        return lines_of_several(results), {"states": [result.data() for result in results]}
    (result,) = results
    write_both(picture(result), table(result.curve), target)
    return lines(result), result.data()


def write_both(drawn: bytes, text: str, target: Path) -> None:
    """A picture, PNG, and the table beside it.

    Raises:
        DataError: one of them exists, or the disk refuses; then neither is there.
    """
    contents = (target, drawn), (table_beside(target), text)
    write_together((path, partial(write_whole, content=content)) for path, content in contents)


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


_COLOURS = "viridis"
_MOST_LABELS = 12  # in a legend; more colours nobody tells apart


def lines_of_several(states: Sequence[XafsResult]) -> list[str]:
    """A line for each state: its edge, its white line, and how far the edge is from that of the first."""
    width = max(len(state.title) for state in states)
    first, text = states[0].edge.energy, list[str]()
    for state in states:
        edge = state.edge
        if edge.energy is None:
            why = "; ".join(part for part in (edge.reason, state.tabulated) if part)
            text.append(f"{state.title:<{width}}  no edge: {why}")
            continue
        top = "no white line" if edge.white_line is None else f"white line {edge.white_line:.4f} keV"
        apart = "" if first is None or state is states[0] else f", {(edge.energy - first) * 1e3:+.2f} eV from the first"
        text.append(f"{state.title:<{width}}  edge {edge.energy:.4f} keV, {top}{apart}")
    if first is not None and states[0].tabulated:
        text.append(f"{'in tables':<{width}}  {states[0].tabulated}")
    return text


def table_of_several(states: Sequence[XafsResult]) -> str:
    """CSV: each state's name, an energy and the absorption there, state after state."""
    rows = (
        [state.title, f"{energy:.9g}", f"{absorption:.9g}"]
        for state in states
        for energy, absorption in zip(state.curve.energies, state.curve.absorption, strict=True)
    )
    return csv_text([["state", "energy_kev", f"absorption ({_unit(states)})"], *rows])


def picture_of_several(states: Sequence[XafsResult]) -> bytes:
    """PNG: all curves over energy, and the edge (dashed) and the white line (dotted) of each in its colour."""
    from matplotlib import colormaps

    figure, axes = one_panel(4.6)
    shades = np.linspace(0, 0.9, len(states))
    named = set(np.linspace(0, len(states) - 1, _MOST_LABELS).round().astype(int))
    for n, (state, shade) in enumerate(zip(states, shades, strict=True)):
        colour, edge = colormaps[_COLOURS](shade), state.edge
        where = "no edge" if edge.energy is None else f"edge {edge.energy:.4f} keV"
        label = f"{state.title}: {where}" if n in named else None
        axes.plot(state.curve.energies, state.curve.absorption, color=colour, lw=1.2, marker=".", ms=3, label=label)
        for energy, style in ((edge.energy, "--"), (edge.white_line, ":")):
            if energy is not None:
                axes.axvline(energy, color=colour, lw=1.0, ls=style)
    finish(axes, "energy (keV)", f"absorption ({_unit(states)})", "edges dashed, white lines dotted", grid=True)
    return png(figure)


def _unit(states: Sequence[XafsResult]) -> str:
    return " or ".join(dict.fromkeys(state.curve.unit for state in states))
