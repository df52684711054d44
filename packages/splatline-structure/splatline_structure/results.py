"""Results of `beamline structure`: numbers as text, JSON and CSV; a table of particles; labels; the report page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from beamline.core.files import write_whole
from beamline.core.text import csv_text
from beamline.report.html import Picture, render
from beamline.storage.hdf5 import created
from beamline.storage.volumes.base import Pixels
from beamline.storage.volumes.files import write_volume
from beamline.storage.writers.recon_file import new_plot
from recon import Grid, Volume
from splatline_structure.intervals import CAUSES, Interval, MeasuredStructure
from splatline_structure.numbers import unit_of
from splatline_structure.particles import Particles

COLUMNS = "number", "unit", "value", "low", "high", "decides", "moves", *CAUSES


def cells(name: str, interval: Interval) -> list[str]:
    """A row of `COLUMNS`; "not determined" in place of a number that is not."""
    figures = [f"{getattr(interval, each):.4g}".replace("nan", "") for each in ("moves", *CAUSES)]
    if interval.why_not:
        return [name, unit_of(name), "not determined", "", "", interval.why_not, *figures]
    ends = [f"{each:.4g}" for each in (interval.value, interval.low, interval.high)]
    return [name, unit_of(name), *ends, interval.words, *figures]


def lines_of(intervals: Mapping[str, Interval]) -> list[str]:
    """The table for the terminal."""
    return [
        f"{name:<14}{value:>15} {unit:<5}" + (f"{low} to {high}".ljust(20) if low else "") + f"  {words}"
        for name, unit, value, low, high, words, *_ in (cells(name, each) for name, each in intervals.items())
    ]


def numbers_table(intervals: Mapping[str, Interval], box: str, box_of_all: str) -> str:
    """All numbers as CSV, each with the box of voxels in which it was measured."""
    rows = [[*cells(name, each), box_of_all if name.endswith("_all") else box] for name, each in intervals.items()]
    return csv_text([[*COLUMNS, "box"], *rows])


def particles_table(particles: Particles, grid: Grid) -> str:
    """CSV with a row for each particle, the largest first; positions are along the axes of the volume."""
    first = 1e3 * np.array(grid.first)
    head = "label", "volume_um3", "diameter_um", "sphericity", "z_um", "y_um", "x_um", "cut", "contacts", "neighbours"
    rows: list[Sequence[object]] = [head]
    for i in np.argsort(-particles.volume, kind="stable").tolist():
        sizes = particles.volume[i], particles.diameter[i], particles.sphericity[i], *(particles.centroid[i] + first)
        touched = particles.neighbours[i]
        shown = [f"{each:.6g}" for each in sizes]
        rows.append([particles.label[i], *shown, int(particles.cut[i]), len(touched), " ".join(map(str, touched))])
    return csv_text(rows)


def facts_of(measured: MeasuredStructure, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The structure without its arrays, for JSON; numbers that are not determined are null."""
    particles = measured.structure.particles
    return {
        **settings, "levels": measured.materials.levels.tolist(), "spread": measured.materials.spread.tolist(),
        "thresholds_off": measured.off, "undecided": measured.undecided, "parts": len(measured.parts),
        "particles": int(particles.label.size), "cut": int(particles.cut.sum()), "numbers": {
            name: {**asdict(each), "value": None if each.why_not else each.value, "unit": unit_of(name),
                   "decides": each.decides}
            for name, each in measured.intervals.items()
        },
        "along_z": measured.structure.along_z.tolist(), "radial": measured.structure.radial[0].tolist(),
        "radii_um": measured.structure.radial[1].tolist(),
    }  # fmt: skip


def write_labels(path: Path, labels: np.ndarray, record: Any, grid: Grid) -> None:
    """Write the labels of the voxels, as integers, in the format of the suffix."""
    if path.suffix.lower() in (".h5", ".hdf5"):
        with created(path) as file:
            data, chunks = new_plot(file, "labels", grid, "mm"), (1, *labels.shape[1:])
            data.create_dataset("labels", data=labels, chunks=chunks, compression="gzip", compression_opts=1)
        return
    most = int(labels.max())
    bits = 8 if most < 256 else 16
    pixels = Pixels(bits, (0.0, float(2**bits - 1))) if most < 65536 else Pixels()
    volume = Volume(labels.astype(np.float32), grid)
    write_volume(path, replace(record, volume=volume, title="labels", parameters={}, metrics={}, model={}), pixels)


def page(
    title: str,
    summary: str,
    sentences: Sequence[str],
    pictures: Sequence[Picture],
    table: Mapping[str, Interval],
    settings: Mapping[str, Any],
) -> str:
    """The report page."""
    return render(
        "trials.html", title=title, summary=summary, sentences=sentences, pictures=pictures, bold=False,
        heading="Numbers", columns=COLUMNS[1:],
        rows=[{"label": name, "cells": cells(name, each)[1:], "marked": False} for name, each in table.items()],
        scan={name: str(each) for name, each in settings.items()},
        command=str(settings.get("command", "")),
    )  # fmt: skip


def write_all(
    folder: Path, texts: Mapping[str, str], labels: Mapping[str, np.ndarray], record: Any, grid: Grid
) -> None:
    """Write the files of a new folder."""
    folder.mkdir()
    for name, text in texts.items():
        write_whole(folder / name, text)
    for name, voxels in labels.items():
        write_labels(folder / name, voxels, record, grid)
