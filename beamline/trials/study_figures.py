"""Pictures and page of a study: the same slice of every row by each method, and the figures of all rows."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from beamline.core.files import REPORT, write_whole
from beamline.core.machine import machine_line
from beamline.projections.scan_statistics import dose_scale
from beamline.report.figures import DPI, WIDTH, png
from beamline.report.html import Picture, render
from beamline.report.slice_sheet import SliceSheet
from beamline.trials.study_table import HEADINGS, StudyTable, formatted
from beamline.trials.varied import colour_of
from recon.methods import by_name


def figures_of_rows(table: StudyTable) -> bytes:
    """Every figure of all rows, a line a method."""
    names, rows = table.names, list(dict.fromkeys(cell.row.label for cell in table.done))
    down = -(-len(names) // 2)
    height = 2.0 * down + 2.2
    figure = Figure(figsize=(WIDTH, height), dpi=DPI)
    panels = np.ravel(figure.subplots(down, 2, squeeze=False, sharex=True))
    figure.subplots_adjust(0.08, 2.1 / height, 0.99, 1 - 0.1 / height, wspace=0.2, hspace=0.12)
    for axes, name in zip(panels, names, strict=False):
        for method in dict.fromkeys(cell.method for cell in table.done):
            cells = [c for c in table.done if c.method == method and math.isfinite(c.figures[name])]
            places = [rows.index(cell.row.label) for cell in cells]
            values = [cell.figures[name] for cell in cells]
            axes.plot(places, values, marker="o", ms=4, lw=0.8, color=colour_of(method), label=method)
        axes.set_ylabel(HEADINGS[name] + ("" if name.startswith("ssim") else " (dB)"), fontsize=8)
        axes.set_xticks(range(len(rows)), rows, rotation=90, fontsize=6.5)
        axes.tick_params(axis="y", labelsize=7)
        axes.grid(alpha=0.3)
    panels[0].legend(fontsize=8)
    return png(figure)


def against_cost(table: StudyTable) -> bytes:
    """The first figure of all rows against dose and against time, a colour a method."""
    name = "psnr_truth" if "psnr_truth" in table.names else table.names[0]
    figure = Figure(figsize=(WIDTH, 3.6), dpi=DPI, layout="constrained")
    by_dose, by_time = figure.subplots(1, 2, sharey=True)
    a_frame, dose = dose_scale(table.light)
    for method in dict.fromkeys(cell.method for cell in table.done):
        cells = [c for c in table.done if c.method == method and math.isfinite(c.figures[name])]
        values = [cell.figures[name] for cell in cells]
        doses = [c.row.frames * a_frame for c in cells]
        for axes, cost in ((by_dose, doses), (by_time, [c.cpu_seconds for c in cells])):
            axes.plot(cost, values, "o", ms=4, color=colour_of(method), label=method)
    by_dose.set(xlabel=dose, ylabel=f"{HEADINGS[name]} (dB)", xscale="log")
    by_time.set(xlabel="processor time (s)", xscale="log")
    for axes in (by_dose, by_time):
        axes.grid(alpha=0.3)
    by_dose.legend(fontsize=8)
    return png(figure)


def write_page(folder: Path, table: StudyTable, slices: SliceSheet) -> None:
    """Write the pictures and report.html."""
    pictures = []
    if table.done:
        caption = "What each figure is of is said below the table. A smoother volume has more SNR and CNR."
        pictures.append(("figures.png", Picture("Figures of all rows", caption, figures_of_rows(table))))
        caption = "Each frame of the scan has the same dose; one that several views share is counted once."
        pictures.append(("cost.png", Picture("Quality against dose and time", caption, against_cost(table))))
    for method in dict.fromkeys(cell.method for cell in table.done):
        caption = f"One slice of every volume by {method}, in one grey window; of repeated draws the first."
        picture = Picture(f"{by_name(method).label}, slice by slice", caption, slices.png(slices.labels(method)))
        pictures.append((f"slices_{method}.png", picture))
    for name, picture in pictures:
        write_whole(folder / name, picture.png, replace=True)
    timed = table.timed
    rows = [
        {
            "label": cell.row.label,
            "method": cell.method,
            "cells": [
                *([f"{cell.seconds:.1f}", cell.reached] if timed else []),
                f"{cell.cpu_seconds:.1f}",
                *(formatted(n, cell.figures[n]) for n in table.names),
            ]
            if cell.status == "done"
            else [],
            "reason": cell.said,
        }
        for cell in table.cells
    ]
    page = render(
        "study.html",
        title=table.study.title,
        summary=f"{table.study.question} {len(table.done)} of {len(table.cells)} rows on "
        f"{machine_line(dict(table.machine))}.",
        columns=[*(["s", "reached"] if timed else []), "CPU s", *(HEADINGS[name] for name in table.names)],
        rows=rows,
        sentences=[*table.draws, *table.notes],
        pictures=[picture for _, picture in pictures],
        scan=table.scan,
        command=table.command,
    )
    write_whole(folder / REPORT, page, replace=True)
