"""Layout: how a table of trials becomes text, CSV, JSON and a page, whatever it compares."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from textwrap import fill
from typing import Any

from pydantic_core import to_jsonable_python

from beamline.core.events import Event, TrialDone
from beamline.core.files import write_whole
from beamline.core.installed import version
from beamline.core.machine import machine_line
from beamline.core.sinks import Warn
from beamline.core.text import csv_text
from beamline.features.trials.launch import TrialData
from beamline.features.trials.trial import MEMORY, TIME, Outcome, Trial, TrialTable
from beamline.report.html import Picture, render
from beamline.report.metrics import METRICS
from beamline.report.sheets import SliceSheet

_WIDTH = 120  # characters


@dataclass(frozen=True)
class Figure:
    """How a table names a metric of trials.

    Attributes:
        metric: its name in `Outcome.metrics`.
        short: heading in the text; `heading`: on the page, empty: the same one.
        legend: what it is; `{}` in it and in `heading` is the unit of length.
        digits_of: the metric that has as many digits; empty: `metric`.
    """

    metric: str
    short: str
    heading: str = ""
    legend: str = ""
    digits_of: str = ""

    def of(self, outcome: Outcome) -> float | None:
        """The figure; None where it is not known."""
        return outcome.metrics.get(self.metric)

    def words(self, value: float) -> str:
        """With its digits; "equal" for the PSNR of two equal volumes."""
        name = self.digits_of or self.metric
        if name == "resolution":
            return f"{value:.3g}" if math.isfinite(value) else "none"
        if math.isfinite(value):
            return f"{value:.{METRICS[name].digits}f}"
        return "equal" if name == "psnr" and value > 0 else "undefined"


@dataclass(frozen=True)
class TableColumn:
    """How a value is shown on the page and in the text.

    Attributes:
        short: heading in the text, `width` characters wide; 0: the last column, as wide as it needs.
        words: a value that is known, of a trial that is done, as text.
    """

    heading: str
    short: str
    width: int = 8
    words: Callable[[Any], str] = str

    def cell(self, value: Any) -> str:
        """The value as text."""
        return "–" if value is None else self.words(value)


@dataclass(frozen=True)
class TableLayout:
    """What a table compares, and how it is written.

    Attributes:
        name: in events and messages, and of the files NAME.csv and NAME.json.
        page: file name of the page.
        unit: what its rows are.
        title: of the page.
        figures: what rows are compared by, by name in CSV, JSON and events.
        sentences: what follows from the table, and what its figures mean.
        pictures: those that have data, by file name.
        question: that the table answers; empty: none in words.
        facts: what JSON has beside the scan, the machine, the command and the rows.
        front: time and memory are shown, and the rows on the front of time and quality stand out.
    """

    name: str
    page: str
    unit: str
    title: str
    figures: Mapping[str, Figure]
    sentences: Callable[[TrialTable], Sequence[str]]
    pictures: Callable[[TrialTable, SliceSheet], Iterable[tuple[str, Picture]]]
    question: str = ""
    facts: Mapping[str, str] | None = None
    front: bool = False

    def marked(self, table: TrialTable) -> list[Outcome]:
        """The rows that stand out."""
        return table.front(TIME) if self.front else []


@dataclass(frozen=True, eq=False)
class Planned:
    """What a comparison will do.

    Attributes:
        data: that all trials share.
        table: before any trial is done.
        started: the event that says so.
        references: trials whose volumes others are compared with, in addition to the truth: each with those of its
            method. Without a truth the first one has the dense and the empty regions.
    """

    data: TrialData
    table: TrialTable
    layout: TableLayout
    started: Event
    references: tuple[Trial, ...] = ()


Plan = Callable[[Warn], Planned]
"""Reads and corrects the views of a scan, and says which trials to run. ConfigError, DataError: nothing was written."""


def known(table: TrialTable, figures: Mapping[str, Figure]) -> dict[str, Figure]:
    """The figures that any row has."""
    metrics = {name for outcome in table.outcomes for name in outcome.metrics}
    return {name: each for name, each in figures.items() if each.metric in metrics}


def columns(table: TrialTable, layout: TableLayout) -> dict[str, TableColumn]:
    """What is shown of every row, by name as in `values_of`."""
    trials = [outcome.trial for outcome in table.outcomes]
    facts, timed = dict.fromkeys(chain(*(each.facts for each in trials))), any(each.seconds_asked for each in trials)
    shown = {
        **{name: TableColumn(name, name, 11, "{:.4g}".format) for name in facts},
        "seconds_asked": TableColumn("s asked" * (timed and not layout.front), "s asked", words="{:g}".format),
        "seconds": TableColumn("s" * (timed or layout.front), "s", words=time_text),
        "cpu_seconds": TableColumn("CPU s", "CPU s", words=time_text),
        "peak_bytes": TableColumn("MB" * layout.front, "MB", 6, lambda n: f"{n / 1e6:.0f}"),
        **{name: TableColumn((each.heading or each.short).format(table.length_unit), each.short,
                             max(9, len(each.short) + 2), each.words)
           for name, each in known(table, layout.figures).items()},
        "reached": TableColumn("reached" * timed, "reached", 0),
    }  # fmt: skip
    return {name: column for name, column in shown.items() if column.heading}


def values_of(table: TrialTable, layout: TableLayout, outcome: Outcome) -> dict[str, Any]:
    """All that is known of a row, by name; None where it is not known of this one, but of another."""
    trial, light = outcome.trial, table.light
    every = [each.trial for each in table.outcomes]
    return {
        "row": (trial.choice or trial).label,
        **{name: getattr(trial, name) for name in ("group", "method", "views", "binning", "frames")},
        "window": 1 if trial.choice is None else trial.choice.window,
        **{name: trial.settings.get(name) for each in every for name in each.settings},
        **({} if light is None else light.of(trial.frames)),
        **{name: trial.facts.get(name) for each in every for name in each.facts},
        "status": outcome.status,
        "seconds_asked": trial.seconds_asked,
        **{name: getattr(outcome, name) for name in ("seconds", "cpu_seconds", "reached", "peak_bytes")},
        "gaussians_end": outcome.gaussians,
        **{name: each.of(outcome) for name, each in known(table, layout.figures).items()},
        "quality_db": outcome.quality(table.by),
        "message": outcome.message,
    }


def cells(table: TrialTable, layout: TableLayout, outcome: Outcome) -> list[str]:
    """What is shown of a row, as text."""
    values = values_of(table, layout, outcome)
    return [column.cell(values[name]) for name, column in columns(table, layout).items()]


def time_text(seconds: float) -> str:
    """s to three significant digits in at most seven characters; whole ones from a hundred on."""
    if not math.isfinite(seconds):
        return "n/a"
    if 0 < seconds < 1e-3:
        return f"{seconds:.2e}".replace("e-0", "e-")
    digits = 2 - math.floor(math.log10(seconds)) if seconds > 0 else 0
    return f"{seconds:.{max(0, digits)}f}"


def status_text(outcome: Outcome) -> str:
    """Status and message of a trial without figures."""
    return f"{'left out' if outcome.trial.left_out else outcome.status}: {outcome.message}".rstrip(": ")


def text(table: TrialTable, layout: TableLayout) -> str:
    """The table for people; * marks the rows that stand out."""
    shown = columns(table, layout).values()
    width, marked = max(len(outcome.trial.label) for outcome in table.outcomes), layout.marked(table)

    def row(mark: str, label: str, cells: Sequence[str]) -> str:
        widened = (f"{c:>{each.width}}" if each.width else f"  {c}" for c, each in zip(cells, shown, strict=True))
        return f"{mark} {label:<{width}}{''.join(widened)}".rstrip()

    lines = [*([layout.question] if layout.question else []), machine_line(dict(table.machine)), ""]
    lines.append(row(" ", "trial", [each.short for each in shown]))
    for outcome in table.outcomes:
        if outcome.status == "done":
            mark = "*" if outcome in marked else " "
            lines.append(row(mark, outcome.trial.label, cells(table, layout, outcome)))
        else:
            lines.append(f"  {outcome.trial.label}  {status_text(outcome)}")
    legends = [f"{each.short}: {each.legend}" for each in known(table, layout.figures).values() if each.legend]
    notes = ["; ".join(legends).format(table.length_unit) + "."] if legends else []
    notes += ["*: on the front of time and quality."] if layout.front else []
    notes += [*layout.sentences(table), *(f"{o.trial.label}: {o.message}." for o in table.compared if o.message)]
    return "\n".join([*lines, "", *(fill(line, _WIDTH, subsequent_indent="  ") for line in notes)])


def write_table(folder: Path, table: TrialTable, layout: TableLayout) -> None:
    """Write NAME.csv and NAME.json, each completely, in place of earlier ones."""
    record = {
        "format": f"splatline {layout.name} 1",
        "version": version(),
        "command": table.command,
        "machine": dict(table.machine),
        "scan": dict(table.scan),
        **(layout.facts or {}),
        "quality": table.by,
        "length_unit": table.length_unit,
        "notes": list(table.notes),
        "rows": records(table, layout),
        "trials": [outcome.as_record() for outcome in table.outcomes],
        **{f"front_{cost.name}": [o.trial.label for o in table.front(cost)] for cost in (TIME, MEMORY)},
    }
    words = json.dumps(to_jsonable_python(record, inf_nan_mode="null"), indent=1, ensure_ascii=False)
    write_whole(folder / f"{layout.name}.json", words, replace=True)
    write_whole(folder / f"{layout.name}.csv", to_csv(table, layout), replace=True)


def records(table: TrialTable, layout: TableLayout) -> list[dict[str, Any]]:
    """The values of each row by the names of its columns; None where they are not known."""
    values = [values_of(table, layout, outcome) for outcome in table.outcomes]
    return list(to_jsonable_python(values, inf_nan_mode="null"))


def to_csv(table: TrialTable, layout: TableLayout) -> str:
    """One line for each trial; a value that is not known is empty."""
    rows = records(table, layout)
    return csv_text([list(rows[0]) if rows else [], *(row.values() for row in rows)])


def write_page(folder: Path, table: TrialTable, layout: TableLayout, slices: SliceSheet) -> None:
    """Write the pictures that have data, and the page."""
    pictures = list(layout.pictures(table, slices))
    for name, picture in pictures:
        write_whole(folder / name, picture.png, replace=True)
    write_whole(folder / layout.page, to_html(table, layout, [picture for _, picture in pictures]), replace=True)


def to_html(table: TrialTable, layout: TableLayout, pictures: Sequence[Picture]) -> str:
    """The table and its pictures as an HTML page."""
    marked = layout.marked(table)
    counts = f"{len(table.compared)} of {len(table.outcomes)} trials on {machine_line(dict(table.machine))}."
    return render(
        "trials.html",
        title=layout.title,
        summary=f"{layout.question} {counts}".strip(),
        sentences=layout.sentences(table),
        pictures=pictures,
        columns=[each.heading for each in columns(table, layout).values()],
        rows=[
            {
                "label": outcome.trial.label,
                "marked": outcome in marked,
                "cells": cells(table, layout, outcome) if outcome.status == "done" else [],
                "reason": status_text(outcome),
            }
            for outcome in table.outcomes
        ],
        bold=bool(marked),
        scan=table.scan,
        command=table.command,
    )


def event_of(table: TrialTable, layout: TableLayout, n: int, of: int, outcome: Outcome) -> TrialDone:
    """A trial that has ended, the n-th of so many; `gaussians` are those at its start, as in its settings."""
    figures = outcome.trial.as_record() | {"cpu_seconds": outcome.cpu_seconds, "gaussians_end": outcome.gaussians}
    figures |= {name: each.of(outcome) for name, each in layout.figures.items() if each.metric in outcome.metrics}
    label, quality = figures.pop("label"), outcome.quality(table.by)
    return TrialDone(
        n, of, label, outcome.status, outcome.seconds, outcome.message, quality, outcome.peak_bytes, figures
    )
