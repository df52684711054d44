"""Results of `beamline xafs`: curves and edges as text, table and picture, with the nearest tabulated edges.

Tabulated edges are those of free atoms in xraylib (Schoonjans et al., Spectrochim. Acta B 66, 776, 2011). Edges of
compounds are a few electronvolts higher: the white line of a nickel oxide, 8348.5 eV, is 16 eV above the K edge of
nickel.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps

from beamline.core.files import write_together, write_whole
from beamline.core.text import csv_text
from beamline.report.figures import WIDTH, finish, new_figure, png
from recon.prep.matter import HEAVIEST, edges_of
from splatline_spectral.contrast import AbsorptionEdge, XafsCurve


@dataclass(frozen=True, eq=False)
class XafsResult:
    """A curve and its edge. `title`: what was scanned. `elements`: elements of the material; empty: not known."""

    title: str
    curve: XafsCurve
    edge: AbsorptionEdge
    elements: tuple[int, ...] = ()

    def data(self) -> dict[str, Any]:
        """The values for programs. Energies are in keV."""
        curve, edge, cnr = self.curve, self.edge, self.curve.contrast_to_noise
        return {
            "what": self.title, "n_energies": curve.energies.size, "n_left_out": curve.left_out.size,
            "edge_kev": edge.energy, "why_not": edge.reason or None, "white_line_kev": edge.white_line,
            "best_kev": curve.energies[curve.best], "best_from_kev": curve.nearly_best[0],
            "best_to_kev": curve.nearly_best[1], "contrast_to_noise": None if cnr is None else cnr[curve.best],
            "absorption": curve.absorption[curve.best], "unit": curve.unit, "noise": edge.noise,
        }  # fmt: skip


def lines(results: Sequence[XafsResult]) -> list[str]:
    """Lines for the terminal: each curve, and the distance of its edge from that of the first curve."""
    return [line for result in results for line in _lines(result, results[0].edge.energy)]


def _lines(result: XafsResult, first: float | None) -> Iterator[str]:
    curve, edge = result.curve, result.edge
    yield f"{result.title}: {curve.energies.size} energies, {curve.energies[0]:.4f} to {curve.energies[-1]:.4f} keV"
    if curve.left_out.size:
        span = f"{curve.left_out[0]:.4f} to {curve.left_out[-1]:.4f} keV"
        yield f"left out    {curve.left_out.size} energies, {span}: too dark, too bright or without values"
    if edge.energy is None:
        yield f"no edge     {edge.reason}"
    else:
        apart = "" if first in (None, edge.energy) else f", {(edge.energy - (first or 0)) * 1e3:+.2f} eV from the first"
        yield f"edge        {edge.energy:.4f} keV, the steepest rise of the absorption{apart}"
        top = "no maximum above the edge within the range" if edge.white_line is None else f"{edge.white_line:.4f} keV"
        yield f"white line  {top}"
        yield f"in tables   {nearest_edges(edge.energy, result.elements)}"
    cnr, (low, high) = curve.contrast_to_noise, curve.nearly_best
    what = (
        "absorption"
        if cnr is None
        else f"contrast-to-noise ratio of a pixel at the measured thickness, {cnr[curve.best]:.3g}"
    )
    best = f"{curve.energies[curve.best]:.4f} keV: highest {what}"
    yield f"best        {best} (at least 95 % of the highest value from {low:.4f} to {high:.4f} keV)"


def nearest_edges(energy: float, elements: Sequence[int] = ()) -> str:
    """The nearest tabulated edge of these elements; without elements, the nearest K edge and L3 edge of any element."""
    edges = sorted(edges_of(elements or range(1, HEAVIEST + 1)), key=lambda edge: abs(edge.energy - energy))
    nearest = edges[:1] if elements else [next(e for e in edges if e.shell == shell) for shell in ("K", "L3")]
    return "; ".join(
        f"{edge.named}, {abs(1e3 * (edge.energy - energy)):.4g} eV {'above' if edge.energy > energy else 'below'}"
        for edge in nearest
    )


def table(results: Sequence[XafsResult]) -> str:
    """CSV: a row for each energy of each curve; contrast, noise and their ratio are empty if they are not known."""
    rows = [["state", "energy_kev", "absorption", "unit", "contrast", "noise", "contrast_to_noise"]]
    for result in results:
        curve = result.curve
        nothing = np.full(curve.energies.size, np.nan)
        columns = (curve.contrast, curve.noise, curve.contrast_to_noise)
        known = np.stack([nothing if column is None else column for column in columns], 1)
        for energy, absorption, more in zip(curve.energies, curve.absorption, known, strict=True):
            cells = ["" if np.isnan(value) else f"{value:.9g}" for value in more]
            rows.append([result.title, f"{energy:.9g}", f"{absorption:.9g}", curve.unit, *cells])
    return csv_text(rows)


def picture(results: Sequence[XafsResult]) -> bytes:
    """PNG: all curves over energy, each with its edge (dashed) and white line (dotted) in its colour, and below their
    contrast-to-noise, if it is known."""
    figure = new_figure((WIDTH, 5.4))
    top, below = np.ravel(np.asarray(figure.subplots(2, 1, sharex=True)))
    for result, shade in zip(results, np.linspace(0, 0.9, len(results)), strict=True):
        curve, edge, cnr = result.curve, result.edge, result.curve.contrast_to_noise
        colour = colormaps["viridis"](shade)
        where = "no edge" if edge.energy is None else f"edge {edge.energy:.4f} keV"
        style = {"color": colour, "lw": 1.2, "marker": ".", "ms": 3}
        top.plot(curve.energies, curve.absorption, label=f"{result.title}: {where}", **style)
        if cnr is not None:
            below.plot(curve.energies, cnr, **style)
        for energy, dashes in ((edge.energy, "--"), (edge.white_line, ":")):
            if energy is not None:
                top.axvline(energy, color=colour, lw=1.0, ls=dashes)
    units = " or ".join(dict.fromkeys(result.curve.unit for result in results))
    finish(top, "energy (keV)", f"absorption ({units})", "edges dashed, white lines dotted", grid=True)
    finish(below, "energy (keV)", "contrast-to-noise of a pixel", grid=True)
    return png(figure)


def write_results(results: Sequence[XafsResult], target: Path) -> None:
    """Write the picture (PNG), and the table (CSV) next to it.

    Raises:
        DataError: one of them exists, or the disk does not take it; then neither is written.
    """
    contents = (target, picture(results)), (target.with_suffix(".csv"), table(results).encode())
    write_together((path, partial(write_whole, content=content)) for path, content in contents)
