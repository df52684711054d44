"""The results of a trade-off: a table as text, CSV, JSON and HTML page, with pictures of its Pareto fronts."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any

from beamline.core.files import write_whole
from beamline.core.machine import machine_line
from beamline.core.shipped import version
from beamline.report.html import Picture, render
from beamline.report.metrics import METRICS
from beamline.report.slice_sheet import SliceSheet
from beamline.trials import pareto
from beamline.trials.figures import cost_curves, pareto_plot
from beamline.trials.table import LEAST_GAIN, MEMORY, TIME, TrialCost, TrialTable
from beamline.trials.trial import Outcome
from recon.assess.time_model import duration_text

_FIELDS = ("group", "method", "views", "binning")
_WIDTH = 120  # characters


@dataclass(frozen=True)
class _Column:
    """How the tables name a metric. `{}` in `heading` and `legend` is the unit of length."""

    short: str
    heading: str
    legend: str


_COLUMNS = {
    "psnr": _Column("PSNR", "PSNR (dB)", "dB against the truth"),
    "ssim3d": _Column("SSIM", "SSIM 3D", "mean over the slices of three directions"),
    "recovery": _Column("hot", "contrast recovery", "contrast of hot regions over the truth's"),
    "spillover": _Column("cold", "spillover", "level of cold regions over the body's"),
    "variation": _Column("noise", "noise", "standard deviation of the body over its level"),
    "residual_held_out": _Column("held out", "held-out res.", "residual of views held out"),
    "resolution": _Column("FSC", "FSC ({})", "period in {} to which two halves of the views agree"),
}


_FSC = (
    "FSC: a smaller period is better among settings of one method only. Two halves that are regularised alike agree "
    "also in what the prior made, and in rings. A higher FSC than that of FBP does not prove a sharper volume: look "
    "at the slices."
)


def text(table: TrialTable) -> str:
    """The table for people; * marks the trials that no other beats in both time and quality."""
    lines = [machine_line(dict(table.machine)), ""]
    width = max((len(outcome.trial.label) for outcome in table.outcomes), default=5)
    names = _metric_names(table)
    lines.append(
        f"  {'trial':<{width}}{'s':>8}{'CPU s':>8}{'MB':>6}"
        + "".join(f"{_COLUMNS[n].short:>9}" for n in names)
        + "  reached" * table.timed
    )
    best = {table.compared[i].trial for i in table.front(TIME)}
    for outcome in table.outcomes:
        mark = "*" if outcome.trial in best else " "
        row = f"{mark} {outcome.trial.label:<{width}}"
        if outcome.status == "done":
            widths = (8, 8, 6, *(9 for _ in names))
            row += "".join(f"{cell:>{n}}" for cell, n in zip(_cells(outcome, names), widths, strict=True))
            row += f"  {outcome.reached}" * table.timed
        else:
            row += f"  {outcome.status}" + (f": {outcome.message}" if outcome.message else "")
        lines.append(row)
    legend = "; ".join(f"{_COLUMNS[n].short}: {_COLUMNS[n].legend.format(table.length_unit)}" for n in names)
    notes = [*([f"{legend}."] if legend else []), "*: on the front of time and quality.", *conclusions(table)]
    notes += [f"{o.trial.label}: {o.message}." for o in table.compared if o.message]
    return "\n".join([*lines, "", *(fill(line, _WIDTH, subsequent_indent="  ") for line in notes)])


def _time(seconds: float) -> str:
    """s to three significant digits in at most seven characters; whole ones from a hundred on."""
    if not math.isfinite(seconds):
        return "n/a"
    if 0 < seconds < 1e-3:
        return f"{seconds:.2e}".replace("e-0", "e-")
    digits = 2 - math.floor(math.log10(seconds)) if seconds > 0 else 0
    return f"{seconds:.{max(0, digits)}f}"


def _duration(seconds: float) -> str:
    """A time to three significant digits, in µs, ms, or the units of `duration_text`."""
    for unit, name in ((1e-3, "µs"), (1.0, "ms")):
        if 0 < seconds < unit:
            return f"{seconds / unit * 1e3:.3g} {name}"
    return duration_text(seconds)


def conclusions(table: TrialTable) -> list[str]:
    """Sentences: the time of each further dB along the front."""
    compared, qualities, seconds = table.compared, table.qualities, table.costs(TIME)
    kept = table.front(TIME)
    out = [f"Quality: {table.quality_name}, dB."]
    if not kept:
        return [*out, "No trial has both a time and a quality."]
    first = compared[kept[0]]
    out.append(f"Fastest: {first.trial.label}: {qualities[kept[0]]:.2f} dB in {_duration(first.seconds)}.")
    for stretch in pareto.steps(kept, seconds, qualities):
        chance = "" if table.by == "psnr" else f" ± {table.chance(stretch.end, stretch.start):.2f}"
        out.append(
            f"+{stretch.gain:.2f}{chance} dB for {_duration(stretch.cost)} more "
            f"({_duration(stretch.per_decibel)} a dB): {compared[stretch.end].trial.label}."
        )
    out += _level(table, kept[-1])
    if any("resolution" in outcome.metrics for outcome in compared):
        out.append(_FSC)
    return out


def _level(table: TrialTable, last: int) -> list[str]:
    """A sentence where a trial that costs more seems better than the last one of the front, by chance."""
    qualities = table.qualities
    best = max(range(len(qualities)), key=lambda i: qualities[i] if math.isfinite(qualities[i]) else -math.inf)
    gain, chance = qualities[best] - qualities[last], table.chance(best, last)
    if best == last or gain < LEAST_GAIN:
        return []
    more = table.compared[best].seconds - table.compared[last].seconds
    return [
        f"There it ends: the best figure, +{gain:.2f} dB for {_duration(more)} more "
        f"({table.compared[best].trial.label}), is within chance (± {chance:.2f} dB)."
    ]


def write_table(folder: Path, table: TrialTable) -> None:
    """Write tradeoff.csv and tradeoff.json, each completely, in place of earlier ones."""
    record = {
        "format": "splatline tradeoff 1",
        "version": version(),
        "command": table.command,
        "machine": dict(table.machine),
        "scan": dict(table.scan),
        "quality": table.by,
        "length_unit": table.length_unit,
        "trials": [outcome.as_record() for outcome in table.outcomes],
        "front_seconds": [table.compared[i].trial.label for i in table.front(TIME)],
        "front_memory": [table.compared[i].trial.label for i in table.front(MEMORY)],
    }
    text = json.dumps(finite(record), indent=1, ensure_ascii=False, allow_nan=False)
    write_whole(folder / "tradeoff.json", text, replace=True)
    write_whole(folder / "tradeoff.csv", to_csv(table), replace=True)


def to_csv(table: TrialTable) -> str:
    """One line for each trial; a value that is not known is empty."""
    names = _metric_names(table)
    settings = list(dict.fromkeys(name for outcome in table.outcomes for name in outcome.trial.settings))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    costs = ("seconds_asked", "seconds", "cpu_seconds", "reached", "peak_bytes", "gaussians_end")
    doses = [] if table.light is None else list(table.light.of(1))
    writer.writerow([*_FIELDS, *settings, "status", *costs, *doses, *names, "quality_db", "message"])
    for outcome in table.outcomes:
        values = [getattr(outcome.trial, name) for name in _FIELDS]
        values += [outcome.trial.settings.get(name) for name in settings]
        values += [outcome.status, outcome.trial.seconds_asked, outcome.seconds, outcome.cpu_seconds, outcome.reached]
        values += [outcome.peak_bytes, outcome.gaussians]
        values += [] if table.light is None else table.light.of(outcome.trial.views).values()
        values += [outcome.metrics.get(name) for name in names]
        writer.writerow([finite(v) for v in (*values, outcome.quality(table.by), outcome.message)])
    return out.getvalue()


def write_figures(folder: Path, table: TrialTable, slices: SliceSheet) -> None:
    """Write the page, and the pictures that have data; `slices` are of each baseline and of the truth."""
    pictures = []
    doses = [table.dose] if len({outcome.trial.views for outcome in table.compared}) > 1 else []
    for cost in (TIME, MEMORY, *doses):
        if table.front(cost):
            caption = (
                f"{table.quality_name} of every trial against its {cost.words}. The line is the best quality "
                "at each cost; its corners are the trials that no other beats in both."
            )
            picture = Picture(f"Quality against {cost.words}", caption, _pareto(table, cost))
            pictures.append((f"quality_{cost.name}.png", picture))
    curves = [o for o in table.compared if o.trial.group == "method" and len(o.curve) > 1]
    if curves:
        caption = (
            "−20 log₁₀ of the residual that each baseline recorded during its run. Solid: views held out. Dashed: "
            "views used; this residual still falls when the volume already fits their noise. A fit's residual is that "
            "of its Gaussians, which may lie between voxels and outside the volume; the table judges the volume."
        )
        pictures.append(("curves.png", Picture("Residual of each method during its run", caption, cost_curves(curves))))
    if labels := slices.labels():
        caption = "The same slice by each method with its usual settings, all in the grey window of the first."
        if any(outcome.trial.group == "one fit" for outcome in table.outcomes):
            caption += " Of several volumes, the one that the middle view shows, by its time or energy."
        pictures.append(("slices.png", Picture("Slices", caption, slices.png(labels))))
    for name, picture in pictures:
        write_whole(folder / name, picture.png, replace=True)
    write_whole(folder / "tradeoff.html", to_html(table, [picture for _, picture in pictures]), replace=True)


def _pareto(table: TrialTable, cost: TrialCost) -> bytes:
    points = zip(table.compared, table.costs(cost), table.qualities, strict=True)
    return pareto_plot(
        [(outcome.trial, value * cost.scale, quality) for outcome, value, quality in points],
        table.front(cost),
        cost.axis,
        "PSNR (dB)" if table.by == "psnr" else "held-out residual (dB below the data)",
    )


def to_html(table: TrialTable, pictures: Sequence[Picture]) -> str:
    names = _metric_names(table)
    on_front = {table.compared[i].trial for i in table.front(TIME)}
    return render(
        "tradeoff.html",
        title="What accuracy costs",
        summary=f"{table.n_done} of {len(table.outcomes)} trials on {machine_line(dict(table.machine))}.",
        conclusions=conclusions(table),
        pictures=pictures,
        columns=[
            "s",
            "CPU s",
            "MB",
            *(_COLUMNS[n].heading.format(table.length_unit) for n in names),
            *(["reached"] if table.timed else []),
        ],
        rows=[
            {
                "label": outcome.trial.label,
                "on_front": outcome.trial in on_front,
                "cells": [*cells, *([outcome.reached] if table.timed and cells else [])],
                "reason": f"{outcome.status}: {outcome.message}".rstrip(": "),
            }
            for outcome in table.outcomes
            for cells in [_cells(outcome, names)]
        ],
        scan=table.scan,
        command=table.command,
    )


def _cells(outcome: Outcome, names: Sequence[str]) -> list[str]:
    """The measured values of a trial; none where it failed."""
    if outcome.status != "done":
        return []
    return [
        _time(outcome.seconds),
        _time(outcome.cpu_seconds),
        "n/a" if outcome.peak_bytes is None else f"{outcome.peak_bytes / 1e6:.0f}",
        *(_cell(name, outcome) for name in names),
    ]


def _metric_names(table: TrialTable) -> list[str]:
    return [name for name in _COLUMNS if any(name in o.metrics for o in table.outcomes)]


def _cell(name: str, outcome: Outcome) -> str:
    value = outcome.metrics.get(name)
    if value is None:
        return "–"
    if name == "resolution":
        return f"{value:.3g}" if math.isfinite(value) else "none"
    return f"{value:.{METRICS[name].digits}f}" if math.isfinite(value) else "undefined"


def finite(value: Any) -> Any:
    """Plain values for JSON and CSV; numbers that are not finite become None."""
    if isinstance(value, Mapping):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
