"""A table of trials as text and as a page, and what follows from it in sentences."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from textwrap import fill

import numpy as np

from beamline.core.files import write_whole
from beamline.core.machine import machine_line
from beamline.features.trials.pictures import QUALITY, pictures
from beamline.features.trials.trial import HELD_OUT, LEAST_GAIN, Outcome, TrialTable
from beamline.report.html import Picture, render
from beamline.report.metrics import METRICS
from beamline.report.sheets import SliceSheet

_MARKS = {"front": "*", "best": "*", "alike": "~"}
_LEGENDS = {
    "front": "*: on the front of time and quality.",
    "best": "*: the least residual.",
    "alike": "~: no more than that, but for chance.",
}
_NEAR = 1.0  # dB below the best figure: a tenth more error
_WIDTH = 120  # characters


def columns(table: TrialTable) -> list[str]:
    """Headings of the table."""
    return ["s", "CPU s", "MB", *(METRICS[name].short for name in figures_of(table))]


def figures_of(table: TrialTable) -> list[str]:
    """Names of the figures that any row has, in their usual order."""
    return [name for name in METRICS if name in table.metrics]


def cells(table: TrialTable, outcome: Outcome) -> list[str]:
    """The values of a row under `columns`, as text."""
    memory = "–" if outcome.peak_bytes is None else f"{outcome.peak_bytes / 1e6:.0f}"
    figures = [
        _figure(name, outcome.metrics[name], 2 * table.asks_best) if name in outcome.metrics else "–"
        for name in figures_of(table)
    ]
    return [_seconds(outcome.seconds), _seconds(outcome.cpu_seconds), memory, *figures]


def _figure(name: str, value: float, finer: int = 0) -> str:
    """A figure with its digits, and so many more; "equal" for the PSNR of two equal volumes."""
    if math.isfinite(value):
        return f"{value:.{METRICS[name].digits + finer}f}"
    return "equal" if name.startswith("psnr") and value > 0 else "undefined"


def _seconds(seconds: float) -> str:
    """Three significant digits; whole seconds from a hundred on."""
    if not math.isfinite(seconds):
        return "n/a"
    return f"{seconds:.0f}" if seconds >= 100 else f"{seconds:.3g}"


def _status(outcome: Outcome) -> str:
    return f"{'left out' if outcome.trial.left_out else outcome.status}: {outcome.message}".rstrip(": ")


def text(table: TrialTable) -> str:
    """The table for people; a mark before a row is its verdict."""
    head, verdicts = columns(table), [table.verdict(outcome) for outcome in table.outcomes]
    width = max(len(outcome.trial.label) for outcome in table.outcomes)
    wide = [max(8, len(name) + 2) for name in head]

    def row(mark: str, label: str, words: Sequence[str]) -> str:
        return f"{mark} {label:<{width}}{''.join(f'{w:>{n}}' for w, n in zip(words, wide, strict=True))}"

    lines = [table.question] if table.question else []
    lines += [machine_line(dict(table.machine)), "", row(" ", "trial", head)]
    for outcome, verdict in zip(table.outcomes, verdicts, strict=True):
        if outcome.status == "done":
            lines.append(row(_MARKS.get(verdict, " "), outcome.trial.label, cells(table, outcome)))
        else:
            lines.append(f"  {outcome.trial.label}  {_status(outcome)}")
    shown = [METRICS[name] for name in figures_of(table)]
    legends = [f"{each.short}: {each.label}{', dB' if each.unit else ''}" for each in shown]
    notes = ["; ".join(legends) + "."] if legends else []
    notes += [legend for verdict, legend in _LEGENDS.items() if verdict in verdicts]
    notes += [*sentences(table), *(f"{o.trial.label}: {o.message}." for o in table.compared if o.message)]
    return "\n".join([*lines, "", *(fill(line, _WIDTH, subsequent_indent="  ") for line in notes)])


def write_page(folder: Path, table: TrialTable, slices: SliceSheet) -> None:
    """Write the pictures that have data, and the page."""
    drawn = dict(pictures(table, slices))
    for name, picture in drawn.items():
        write_whole(folder / name, picture.png, replace=True)
    write_whole(folder / table.page, to_html(table, list(drawn.values())), replace=True)


def to_html(table: TrialTable, drawn: Sequence[Picture]) -> str:
    """The table and its pictures as an HTML page."""
    verdicts = [table.verdict(outcome) for outcome in table.outcomes]
    counts = f"{len(table.compared)} of {len(table.outcomes)} trials on {machine_line(dict(table.machine))}."
    return render(
        "trials.html",
        title=table.title,
        summary=f"{table.question} {counts}".strip(),
        sentences=sentences(table),
        pictures=drawn,
        columns=columns(table),
        rows=[
            {
                "label": outcome.trial.label,
                "marked": bool(verdict),
                "cells": cells(table, outcome) if outcome.status == "done" else [],
                "reason": _status(outcome),
            }
            for outcome, verdict in zip(table.outcomes, verdicts, strict=True)
        ],
        bold=any(verdicts),
        scan=table.scan,
        command=table.command,
    )


def sentences(table: TrialTable) -> list[str]:
    """What follows from the table, and what its figures mean."""
    if table.asks_costs:
        return _conclusions(table)
    return [*_draws(table), *table.notes]


def _conclusions(table: TrialTable) -> list[str]:
    """The trial that is best for its time, and the time of each further dB along the front."""
    by, front = table.by, table.front
    if not front:
        return ["No trial has both a time and a quality."]
    best = front[-1]
    pick = next(outcome for outcome in front if outcome.quality(by) >= best.quality(by) - _NEAR)
    out = [f"Best for its time: {pick.trial.label}: {pick.quality(by):.2f} dB in {_seconds(pick.seconds)} s."]
    out += [f"Quality: {QUALITY[by]}. Fastest: {front[0].trial.label}, {front[0].quality(by):.2f} dB."]
    for before, after in pairwise(front):
        rise, cost = after.quality(by) - before.quality(by), after.seconds - before.seconds
        chance = f" ± {table.chance(after, before):.2f}" * (by == HELD_OUT)
        price = f"{_seconds(cost)} s more ({_seconds(cost / rise)} s a dB)"
        out.append(f"+{rise:.2f}{chance} dB for {price}: {after.trial.label}.")
    highest = max((o for o in table.compared if math.isfinite(o.quality(by))), key=lambda o: o.quality(by))
    if (gain := highest.quality(by) - best.quality(by)) >= LEAST_GAIN:
        chance = f"+{gain:.2f} dB by {highest.trial.label}, is within chance (± {table.chance(highest, best):.2f} dB)."
        out.append(f"There it ends: the best figure, {chance}")
    return out


def _draws(table: TrialTable) -> Iterator[str]:
    """Mean and range of the figures over the draws of one choice."""
    families: dict[tuple[str, str], list[Outcome]] = {}
    for outcome in table.compared:
        if outcome.trial.choice is not None and outcome.trial.choice.family:
            families.setdefault((outcome.trial.method, outcome.trial.choice.family), []).append(outcome)
    for (method, family), rows in families.items():
        parts = []
        for name in figures_of(table):
            values = [row.metrics[name] for row in rows if name in row.metrics]
            mean, low, high = (_figure(name, float(of(values))) for of in (np.mean, min, max))
            parts.append(f"{METRICS[name].short} {mean} ({low} to {high})")
        yield f"{method}, {family}, mean of {len(rows)}: {', '.join(parts)}."
