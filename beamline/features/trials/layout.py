"""Layout: how a table of trials becomes text, CSV, JSON and a page, whatever it compares."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any

from beamline.core.events import Event, TrialDone
from beamline.core.files import write_whole
from beamline.core.installed import version
from beamline.core.machine import machine_line
from beamline.core.sinks import Warn
from beamline.core.text import csv_text
from beamline.features.trials.launch import TrialData
from beamline.features.trials.table import TrialTable
from beamline.features.trials.trial import Outcome, Trial
from beamline.report.html import Picture, render
from beamline.report.metrics import METRICS
from beamline.report.sheets import SliceSheet

_WIDTH = 120  # characters


@dataclass(frozen=True)
class TableColumn:
    """A column of a table.

    Attributes:
        name: in CSV and JSON; empty: it is not there.
        value: plain, or None where it is not known.
        heading: on the page; empty: neither there nor in the text.
        short: in the text, `width` characters wide; 0: the last column, as wide as it needs.
        words: a value that is known, of a trial that is done, as text.
        metric: it is a figure of merit, which events tell, too.
    """

    name: str
    value: Callable[[Outcome], Any]
    heading: str = ""
    short: str = ""
    width: int = 8
    words: Callable[[Any], str] = str
    metric: bool = False

    def shown(self, outcome: Outcome) -> str:
        """The value as text."""
        known = self.value(outcome)
        return "–" if known is None else self.words(known)


def in_digits(metric: str, value: float) -> str:
    """A figure with the digits of its metric; "equal" for the PSNR of two equal volumes."""
    if math.isfinite(value):
        return f"{value:.{METRICS[metric].digits}f}"
    return "equal" if metric == "psnr" and value > 0 else "undefined"


@dataclass(frozen=True)
class TableLayout:
    """What a table compares, and how it is written.

    Attributes:
        name: in events and messages, and of the files NAME.csv and NAME.json.
        page: file name of the page.
        unit: what its rows are.
        title: of the page.
        labels: the first cells of a row.
        columns: all others.
        sentences: what follows from the table, and what its figures mean.
        record: what JSON has beside the scan, the machine and the command.
        pictures: those that have data, by file name.
        question: that the table answers; empty: none in words.
        marked: numbers of the rows that stand out, see `TrialTable.outcomes`.
        legend: sentences that explain short headings and the mark *.
    """

    name: str
    page: str
    unit: str
    title: str
    labels: Callable[[Outcome], tuple[str, ...]]
    columns: Callable[[TrialTable], Sequence[TableColumn]]
    sentences: Callable[[TrialTable], Sequence[str]]
    record: Callable[[TrialTable], Mapping[str, Any]]
    pictures: Callable[[TrialTable, SliceSheet], Sequence[tuple[str, Picture]]]
    question: str = ""
    marked: Callable[[TrialTable], Collection[int]] = lambda table: ()
    legend: Callable[[TrialTable], Sequence[str]] = lambda table: ()


@dataclass(frozen=True, eq=False)
class Planned:
    """What a comparison will do.

    Attributes:
        data: that all trials share.
        table: before any trial is done.
        started: the event that says so.
        references: trials whose volumes others are compared with, in addition to the truth: each with those of its
            method. The first one has the dense and the empty regions.
    """

    data: TrialData
    table: TrialTable
    layout: TableLayout
    started: Event
    references: tuple[Trial, ...] = ()


Plan = Callable[[Warn], Planned]
"""Reads and corrects the views of a scan, and says which trials to run. ConfigError, DataError: nothing was written."""


def status_text(outcome: Outcome) -> str:
    """Status and message of a trial without figures."""
    return f"{'left out' if outcome.trial.left_out else outcome.status}: {outcome.message}".rstrip(": ")


def text(table: TrialTable, layout: TableLayout) -> str:
    """The table for people; * marks the rows that stand out."""
    columns = [column for column in layout.columns(table) if column.heading]
    columns = [c for c in columns if c.width] + [c for c in columns if not c.width]
    labels, marked = [layout.labels(outcome) for outcome in table.outcomes], layout.marked(table)
    widths = [max(map(len, column)) for column in zip(*labels, strict=True)]
    head = ["trial", *[""] * (len(widths) - 1)]
    lines = [*([layout.question] if layout.question else []), machine_line(dict(table.machine)), ""]

    def row(mark: str, names: Sequence[str], cells: Sequence[str]) -> str:
        begin = "  ".join(f"{name:<{width}}" for name, width in zip(names, widths, strict=True))
        widened = (
            f"{c:>{column.width}}" if column.width else f"  {c}" for c, column in zip(cells, columns, strict=True)
        )
        return f"{mark} {begin}{''.join(widened)}"

    lines.append(row(" ", head, [column.short for column in columns]))
    for n, outcome in enumerate(table.outcomes):
        done = outcome.status == "done"
        cells = [column.shown(outcome) if done else "" for column in columns]
        line = row("*" if n in marked else " ", labels[n], cells).rstrip()
        lines.append(line if done else f"{line}  {status_text(outcome)}")
    notes = [*layout.legend(table), *layout.sentences(table)]
    notes += [f"{o.trial.label}: {o.message}." for o in table.compared if o.message]
    return "\n".join([*lines, "", *(fill(line, _WIDTH, subsequent_indent="  ") for line in notes)])


def write_table(folder: Path, table: TrialTable, layout: TableLayout) -> None:
    """Write NAME.csv and NAME.json, each completely, in place of earlier ones."""
    record = {
        "format": f"splatline {layout.name} 1",
        "version": version(),
        "command": table.command,
        "machine": dict(table.machine),
        "scan": dict(table.scan),
        **layout.record(table),
    }
    words = json.dumps(finite(record), indent=1, ensure_ascii=False, allow_nan=False)
    write_whole(folder / f"{layout.name}.json", words, replace=True)
    write_whole(folder / f"{layout.name}.csv", to_csv(table, layout), replace=True)


def records(table: TrialTable, layout: TableLayout) -> list[dict[str, Any]]:
    """The values of each row by the names of its columns; None where they are not known."""
    columns = [column for column in layout.columns(table) if column.name]
    return [finite({column.name: column.value(outcome) for column in columns}) for outcome in table.outcomes]


def to_csv(table: TrialTable, layout: TableLayout) -> str:
    """One line for each trial; a value that is not known is empty."""
    rows = records(table, layout)
    return csv_text([list(rows[0]) if rows else [], *(row.values() for row in rows)])


def write_page(folder: Path, table: TrialTable, layout: TableLayout, slices: SliceSheet) -> None:
    """Write the pictures that have data, and the page."""
    pictures = layout.pictures(table, slices)
    for name, picture in pictures:
        write_whole(folder / name, picture.png, replace=True)
    write_whole(folder / layout.page, to_html(table, layout, [picture for _, picture in pictures]), replace=True)


def to_html(table: TrialTable, layout: TableLayout, pictures: Sequence[Picture]) -> str:
    """The table and its pictures as an HTML page."""
    columns, marked = [column for column in layout.columns(table) if column.heading], layout.marked(table)
    counts = f"{table.n_done} of {len(table.outcomes)} trials on {machine_line(dict(table.machine))}."
    return render(
        "trials.html",
        title=layout.title,
        summary=f"{layout.question} {counts}".strip(),
        sentences=layout.sentences(table),
        pictures=pictures,
        columns=[column.heading for column in columns],
        rows=[
            {
                "labels": layout.labels(outcome),
                "marked": n in marked,
                "cells": [column.shown(outcome) for column in columns] if outcome.status == "done" else [],
                "reason": status_text(outcome),
            }
            for n, outcome in enumerate(table.outcomes)
        ],
        bold=bool(marked),
        scan=table.scan,
        command=table.command,
    )


def event_of(table: TrialTable, layout: TableLayout, n: int, of: int, outcome: Outcome) -> TrialDone:
    """A trial that has ended, the n-th of so many; `gaussians` are those at its start, as in its settings."""
    figures = outcome.trial.as_record() | {"cpu_seconds": outcome.cpu_seconds, "gaussians_end": outcome.gaussians}
    measured = {c.name: c.value(outcome) for c in layout.columns(table) if c.metric}
    figures |= {name: value for name, value in measured.items() if value is not None}
    label, quality = figures.pop("label"), outcome.quality(table.by)
    return TrialDone(
        n, of, label, outcome.status, outcome.seconds, outcome.message, quality, outcome.peak_bytes, figures
    )


def finite(value: Any) -> Any:
    """Plain values for JSON and CSV; numbers that are not finite become None."""
    if isinstance(value, Mapping):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
