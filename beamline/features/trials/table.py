"""The results of trials as text, pictures and a page, with sentences that state the conclusions."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from textwrap import fill

import numpy as np

from beamline.core.files import write_whole
from beamline.core.machine import machine_line
from beamline.features.trials.trial import HELD_OUT, LEAST_GAIN, Outcome, TrialTable
from beamline.report.figures import WIDTH, new_figure, png
from beamline.report.html import Picture, render
from beamline.report.metrics import METRICS
from beamline.report.sheets import SliceSheet
from recon.methods import by_name

_QUALITY = {
    "psnr": "PSNR (dB)",
    "psnr_all": "PSNR against all projections (dB)",
    HELD_OUT: "−20 log₁₀ of the held-out residual (dB)",
}
"""Label of the quality by each metric."""
_COSTS: dict[str, Callable[[Outcome], float]] = {
    "time (s)": lambda outcome: outcome.seconds,
    "memory (MB)": lambda outcome: math.nan if outcome.peak_bytes is None else outcome.peak_bytes / 1e6,
    "dose (frames)": lambda outcome: outcome.trial.frames,  # frames that several projections share are counted once
}  # quantities that a picture shows, by the label of their axis
_SHOWN_DB = 12.0  # dB below the best trial; trials that are worse are drawn at the lower edge
_COLOURS = {"best": "tab:red", "alike": "tab:orange"}  # colours of frames, by verdict
_MARKS = {"front": "*", "best": "*", "alike": "~"}
_LEGENDS = {
    "front": "*: on the Pareto front, that is, no faster trial is as good.",
    "best": "*: the smallest residual.",
    "alike": "~: not significantly larger than the smallest residual.",
}
_ALIKE_DB = 1.0  # dB below the best value; this is a tenth more error
_WIDTH = 120  # characters


def columns(table: TrialTable) -> list[str]:
    """Headings of the table."""
    return ["s", "CPU s", "MB", *(METRICS[name].short for name in figures_of(table))]


def figures_of(table: TrialTable) -> list[str]:
    """Names of the figures of merit that at least one row has, in the usual order."""
    return [name for name in METRICS if name in table.metrics]


def cells(table: TrialTable, outcome: Outcome) -> list[str]:
    """The values of a row for `columns`, as text."""
    memory = "–" if outcome.peak_bytes is None else f"{outcome.peak_bytes / 1e6:.0f}"
    figures = [
        _figure(name, outcome.metrics[name], 2 * table.asks_best) if name in outcome.metrics else "–"
        for name in figures_of(table)
    ]
    return [_seconds(outcome.seconds), _seconds(outcome.cpu_seconds), memory, *figures]


def _figure(name: str, value: float, finer: int = 0) -> str:
    """A figure of merit with its usual number of digits plus `more`; "equal" for the PSNR of two equal volumes."""
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
    """The table for people. A mark before a row shows its verdict."""
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
    """Write the pictures for which there are data, and the page."""
    drawn = dict(_pictures(table, slices))
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
    """The conclusions from the table, and the meaning of its figures."""
    if table.asks_costs:
        return _conclusions(table)
    return [*_draws(table), *table.notes]


def _conclusions(table: TrialTable) -> list[str]:
    """The trial that is best for its time, and the time that each further dB costs along the Pareto front."""
    measure, front = table.by, table.front
    if not front:
        return ["No trial has both a time and a quality."]
    best = front[-1]
    pick = next(outcome for outcome in front if outcome.quality(measure) >= best.quality(measure) - _ALIKE_DB)
    out = [f"Best for its time: {pick.trial.label}: {pick.quality(measure):.2f} dB in {_seconds(pick.seconds)} s."]
    out += [f"Quality: {_QUALITY[measure]}. Fastest: {front[0].trial.label}, {front[0].quality(measure):.2f} dB."]
    for before, after in pairwise(front):
        rise, cost = after.quality(measure) - before.quality(measure), after.seconds - before.seconds
        chance = f" ± {table.chance(after, before):.2f}" * (measure == HELD_OUT)
        price = f"{_seconds(cost)} s more ({_seconds(cost / rise)} s a dB)"
        out.append(f"+{rise:.2f}{chance} dB for {price}: {after.trial.label}.")
    highest = max((o for o in table.compared if math.isfinite(o.quality(measure))), key=lambda o: o.quality(measure))
    if (gain := highest.quality(measure) - best.quality(measure)) >= LEAST_GAIN:
        out.append(
            f"No trial is significantly better than {best.trial.label}. {highest.trial.label} has +{gain:.2f} dB, but "
            f"the difference may be chance (± {table.chance(highest, best):.2f} dB)."
        )
    return out


def _draws(table: TrialTable) -> Iterator[str]:
    """Mean and range of the figures over the random selections of one kind."""
    families: dict[tuple[str, str], list[Outcome]] = {}
    for outcome in table.compared:
        if outcome.trial.choice is not None and outcome.trial.choice.family:
            families.setdefault((outcome.trial.method, outcome.trial.choice.family), []).append(outcome)
    for (method, family), rows in families.items():
        parts = []
        for name in figures_of(table):
            values = [row.metrics[name] for row in rows if name in row.metrics]
            mean, low, high = (_figure(name, float(statistic(values))) for statistic in (np.mean, min, max))
            parts.append(f"{METRICS[name].short} {mean} ({low} to {high})")
        yield f"{method}, {family}, mean of {len(rows)}: {', '.join(parts)}."


def _pictures(table: TrialTable, slices: SliceSheet) -> Iterator[tuple[str, Picture]]:
    """The pictures by file name: quality against each cost, and the slices of the baselines or of all rows."""
    if any(math.isfinite(outcome.quality(table.by)) for outcome in table.compared):
        caption = (
            "Each point is a trial, that is, the reconstruction with one setting. Each colour is a method. The line "
            f"shows the best quality at each time. A triangle at the lower edge is a trial more than {_SHOWN_DB:g} dB "
            "below the best. Trials without a finite quality are not drawn."
        )
        yield "quality.png", Picture("Quality against its costs", caption, quality_plot(table))
    if labels := slices.labels():
        caption = (
            "The same slice by each method with its default settings, all with the grey window of the first slice."
        )
        marks = dict[str, tuple[str, str]]()
        if table.asks_best:
            caption = (
                "The middle slice of each trial, with its residual, all with the same grey window. If slices "
                "are large, only the part in which they differ most is shown. The best slice has a red frame; "
                "slices that are not significantly worse have an orange frame."
            )
            marks = {each.trial.shown: _mark(table, each) for each in table.compared}
        yield "slices.png", Picture("Slices", caption, slices.png(labels, marks))
    for method in dict.fromkeys(outcome.trial.method for outcome in table.compared if outcome.trial.choice):
        caption = (
            f"One slice of every volume by {method}, all with the same grey window. If a random selection was "
            "repeated, the volume of the first selection is shown."
        )
        title = f"{by_name(method).label}, slice by slice"
        yield f"slices_{method}.png", Picture(title, caption, slices.png(slices.labels(method)))


def _mark(table: TrialTable, outcome: Outcome) -> tuple[str, str]:
    """The residual of a trial, and the colour of its frame."""
    score = outcome.metrics.get(table.by)
    return "" if score is None else f"{score:.5g}", _COLOURS.get(outcome.verdict, "")


def quality_plot(table: TrialTable) -> bytes:
    """Quality against time, memory and dose as PNG: one colour per method, and a line along the Pareto front of
    time."""
    shown = [outcome for outcome in table.compared if math.isfinite(outcome.quality(table.by))]
    floor = max(outcome.quality(table.by) for outcome in shown) - _SHOWN_DB
    figure = new_figure((WIDTH, 4.2))
    panels = figure.subplots(1, len(_COSTS), sharey=True)
    for axes, (label, cost) in zip(panels, _COSTS.items(), strict=True):
        for n, method in enumerate(dict.fromkeys(outcome.trial.method for outcome in shown)):
            points = np.array([(cost(o), o.quality(table.by)) for o in shown if o.trial.method == method])
            low, look = points[:, 1] < floor, {"ms": 4, "color": f"C{n % 10}"}
            axes.plot(*points[~low].T, "osPXD"[n // 10 % 5], **look, label=method)
            axes.plot(points[low, 0], np.full(low.sum(), floor), "v", **look)
        values = [cost(outcome) for outcome in shown]
        if min(values) > 0 and max(values) > 4 * min(values):
            axes.set_xscale("log")
        axes.set_xlabel(label)
        axes.grid(alpha=0.3)
    front = [(outcome.seconds, outcome.quality(table.by)) for outcome in table.front]
    if front and table.asks_costs:
        panels[0].step(*zip(*front, strict=True), where="post", color="black", lw=1.1, alpha=0.5)
    panels[0].set_ylim(bottom=max(min(outcome.quality(table.by) for outcome in shown), floor) - 0.5)
    panels[0].set_ylabel(_QUALITY[table.by])
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=8)
    return png(figure)
