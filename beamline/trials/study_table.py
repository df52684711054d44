"""What a study found: a value for each row and method, as text, CSV and JSON, with the means of repeated draws."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from textwrap import fill

import numpy as np

from beamline.core.files import write_whole
from beamline.core.machine import machine_line
from beamline.core.shipped import version
from beamline.projections.scan_statistics import Light
from beamline.trials.report import finite
from beamline.trials.trial import Status
from beamline.trials.view_choices import Study, StudyRow

_WIDTH = 120  # characters

DIGITS = {"psnr_fbp": 2, "ssim_fbp": 4, "psnr_truth": 2, "ssim_truth": 4, "snr": 2, "cnr": 2}
HEADINGS = {
    "psnr_fbp": "PSNR", "ssim_fbp": "SSIM", "psnr_truth": "PSNR truth", "ssim_truth": "SSIM truth", "snr": "SNR",
    "cnr": "CNR",
}  # fmt: skip
"""Figures by name and as tables head them; PSNR, SNR and CNR in dB."""


@dataclass(frozen=True)
class Cell:
    """One row of a study by one method.

    Attributes:
        status: only "done" comes with figures; "not run" with a message: the row was left out.
        figures: by the names of HEADINGS.
        seconds, cpu_seconds: of the reconstruction.
        seconds_asked, reached: as in `Trial` and `Outcome`.
    """

    row: StudyRow
    method: str
    status: Status = "not run"
    figures: Mapping[str, float] = field(default_factory=dict)
    seconds: float = math.nan
    cpu_seconds: float = math.nan
    message: str = ""
    seconds_asked: float | None = None
    reached: str = ""

    @property
    def label(self) -> str:
        return f"{self.row.label}: {self.method}"

    @property
    def said(self) -> str:
        """What stands in place of figures."""
        return f"{'left out' if self.row.groups is None else self.status}: {self.message}".rstrip(": ")


@dataclass(frozen=True)
class StudyTable:
    """All cells of a study.

    Attributes:
        cells: in the order of the rows, each by all methods.
        scan: facts for people, by name.
        notes: sentences on what the figures mean.
        stopped: it was interrupted before all rows were done.
        light: of a view; None: the dose is counted in frames.
    """

    study: Study
    cells: tuple[Cell, ...]
    scan: Mapping[str, str]
    machine: Mapping[str, str | int]
    command: str
    notes: Sequence[str] = ()
    stopped: bool = False
    light: Light | None = None

    def with_cell(self, index: int, cell: Cell) -> StudyTable:
        return replace(self, cells=(*self.cells[:index], cell, *self.cells[index + 1 :]))

    @property
    def done(self) -> tuple[Cell, ...]:
        return tuple(cell for cell in self.cells if cell.status == "done")

    @property
    def n_done(self) -> int:
        return len(self.done)

    @property
    def timed(self) -> bool:
        """Rows end when their time is over."""
        return any(cell.seconds_asked is not None for cell in self.cells)

    @property
    def names(self) -> list[str]:
        """Figures that any cell has."""
        return [name for name in HEADINGS if any(name in cell.figures for cell in self.cells)]

    @property
    def draws(self) -> list[str]:
        """Sentences: mean and range of the figures over the draws of one choice."""
        out = []
        families = dict.fromkeys((c.row.family, c.method) for c in self.done if c.row.family)
        for family, method in families:
            cells = [c for c in self.done if (c.row.family, c.method) == (family, method)]
            parts = []
            for name in self.names:
                values = [cell.figures[name] for cell in cells]
                low, high = formatted(name, min(values)), formatted(name, max(values))
                parts.append(f"{HEADINGS[name]} {formatted(name, float(np.mean(values)))} ({low} to {high})")
            out.append(f"{method}, {family}, mean of {len(cells)}: {', '.join(parts)}.")
        return out


def formatted(name: str, value: float) -> str:
    """A figure with its digits; "equal" for the PSNR of two equal volumes."""
    if math.isfinite(value):
        return f"{value:.{DIGITS[name]}f}"
    return "equal" if name.startswith("psnr") and value > 0 else "undefined"


def text(table: StudyTable) -> str:
    """The table for people."""
    width = max(len(cell.row.label) for cell in table.cells) + 2
    kind = max(len(cell.method) for cell in table.cells) + 2
    timed = table.timed
    head = f"{'':<{width}}{'':<{kind}}" + f"{'s asked':>9}{'s':>8}" * timed + f"{'CPU s':>8}"
    head += "".join(f"{HEADINGS[name]:>12}" for name in table.names) + "  reached" * timed
    lines = [table.study.question, machine_line(dict(table.machine)), "", head]
    for cell in table.cells:
        begin = f"{cell.row.label:<{width}}{cell.method:<{kind}}"
        if cell.status == "done":
            figures = (formatted(name, cell.figures[name]) for name in table.names)
            asked = "–" if cell.seconds_asked is None else f"{cell.seconds_asked:g}"
            times = f"{asked:>9}{cell.seconds:>8.1f}" * timed + f"{cell.cpu_seconds:>8.1f}"
            lines.append(begin + times + "".join(f"{figure:>12}" for figure in figures) + f"  {cell.reached}" * timed)
        else:
            lines.append(begin + cell.said)
    return "\n".join(
        [*lines, "", *(fill(line, _WIDTH, subsequent_indent="  ") for line in (*table.draws, *table.notes))]
    )


def write_table(folder: Path, table: StudyTable) -> None:
    """Write study.csv and study.json, each completely, in place of earlier ones."""
    record = {
        "format": "splatline study 1",
        "version": version(),
        "study": table.study.name,
        "command": table.command,
        "machine": dict(table.machine),
        "scan": dict(table.scan),
        "notes": list(table.notes),
        "rows": [_record(cell, table.light) for cell in table.cells],
    }
    record_text = json.dumps(finite(record), indent=1, ensure_ascii=False, allow_nan=False)
    write_whole(folder / "study.json", record_text, replace=True)
    out = io.StringIO()
    writer = csv.DictWriter(out, list(_record(table.cells[0], table.light)), lineterminator="\n")
    writer.writeheader()
    writer.writerows(finite(_record(cell, table.light)) for cell in table.cells)
    write_whole(folder / "study.csv", out.getvalue(), replace=True)


def _record(cell: Cell, light: Light | None) -> dict[str, str | float | None]:
    return {
        "row": cell.row.label, "method": cell.method, "views": cell.row.n_views, "window": cell.row.window,
        "frames": cell.row.frames, **({} if light is None else light.of(cell.row.frames)),
        "status": cell.status, "seconds_asked": cell.seconds_asked, "seconds": cell.seconds,
        "cpu_seconds": cell.cpu_seconds, "reached": cell.reached,
        **{name: cell.figures.get(name) for name in HEADINGS},
        "message": cell.message,
    }  # fmt: skip
