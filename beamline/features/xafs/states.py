"""States: several curves, of states of charge or of regions, with their edges in one picture and one table."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from beamline.features.xafs.results import XafsResult
from beamline.report.figures import one_panel, png

_COLOURS = "viridis"
_MOST_LABELS = 12  # in a legend; more colours nobody tells apart


def lines(states: Sequence[XafsResult]) -> list[str]:
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


def data(states: Sequence[XafsResult]) -> dict[str, Any]:
    """Values for programs."""
    return {"states": [state.data() for state in states]}


def table(states: Sequence[XafsResult]) -> str:
    """CSV: each state's name, an energy and the absorption there, state after state."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["state", "energy_kev", f"absorption ({_unit(states)})"])
    for state in states:
        for energy, absorption in zip(state.curve.energies, state.curve.absorption, strict=True):
            writer.writerow([state.title, f"{energy:.9g}", f"{absorption:.9g}"])
    return out.getvalue()


def picture(states: Sequence[XafsResult]) -> bytes:
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
    axes.set(xlabel="energy (keV)", ylabel=f"absorption ({_unit(states)})")
    axes.set_title("edges dashed, white lines dotted", fontsize=9)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return png(figure)


def _unit(states: Sequence[XafsResult]) -> str:
    return " or ".join(dict.fromkeys(state.curve.unit for state in states))
