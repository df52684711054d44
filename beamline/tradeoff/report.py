"""What a trade-off found: the table as text, CSV, JSON and a page, with the pictures of its Pareto fronts."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from textwrap import fill
from typing import Any

from beamline.core.files import named_on_failure, whole_file
from beamline.core.machine import machine_line
from beamline.core.version import version
from beamline.report.html import METRICS, Picture, page, picture_html, table_html
from beamline.tradeoff import pareto
from beamline.tradeoff.figures import cost_curves, pareto_plot
from beamline.tradeoff.table import Table
from beamline.tradeoff.trials import Outcome
from recon.assess.time_model import parts_of

_FIELDS = ("group", "method", "views", "binning", "steps", "gaussians", "loss", "sigmas", "start", "iterations")
_COLUMNS = 120
_SHORT = {"psnr": "PSNR", "ssim3d": "SSIM", "residual_held_out": "held out", "resolution": "FSC"}
_LONG = {
    "psnr": "dB against the truth",
    "ssim3d": "mean over the slices of three directions",
    "residual_held_out": "residual of views held out",
    "resolution": "period in {} to which two halves of the views agree",
}


def text(table: Table) -> str:
    """The table for people; * marks what no other trial beats in both time and quality."""
    lines = [machine_line(dict(table.machine)), ""]
    shown = [o for o in table.outcomes if o.trial.group != "precision"]
    width = max((len(outcome.trial.label) for outcome in shown), default=5)
    names = _metric_names(table)
    lines.append(f"  {'trial':<{width}}{'s':>8}{'CPU s':>8}{'MB':>6}" + "".join(f"{_SHORT[n]:>9}" for n in names))
    best = {table.compared[i].trial for i in table.front("seconds")}
    for outcome in table.outcomes:
        if outcome.trial.group == "precision" and outcome.status == "done":
            continue
        mark = "*" if outcome.trial in best else " "
        row = f"{mark} {outcome.trial.label:<{width}}"
        if outcome.status == "done":
            row += f"{_time(outcome.seconds):>8}{_time(outcome.cpu_seconds):>8}{_megabytes(outcome):>6}"
            row += "".join(f"{_cell(n, outcome):>9}" for n in names)
        else:
            row += f"  {outcome.status}" + (f": {outcome.message}" if outcome.message else "")
        lines.append(row)
    legend = "; ".join(f"{_SHORT[n]}: {_LONG[n].format(table.length_unit)}" for n in names)
    said = [*([f"{legend}."] if legend else []), "*: on the front of time and quality.", *conclusions(table)]
    return "\n".join([*lines, "", *(fill(line, _COLUMNS, subsequent_indent="  ") for line in said)])


def _time(seconds: float) -> str:
    """s to three significant digits in at most seven characters; whole ones from a hundred on."""
    if not math.isfinite(seconds):
        return "n/a"
    if 0 < seconds < 1e-3:
        return f"{seconds:.2e}".replace("e-0", "e-")
    digits = 2 - math.floor(math.log10(seconds)) if seconds > 0 else 0
    return f"{seconds:.{max(0, digits)}f}"


def _said(seconds: float) -> str:
    """A time to three significant digits, in the unit that suits it."""
    for unit, name in ((1e-3, "µs"), (1.0, "ms")):
        if 0 < seconds < unit:
            return f"{seconds / unit * 1e3:.3g} {name}"
    return parts_of(seconds)


def conclusions(table: Table) -> list[str]:
    """Sentences: what each further dB costs along the front, and what float32 costs."""
    compared, qualities, seconds = table.compared, table.qualities, table.costs("seconds")
    kept = table.front("seconds")
    out = [f"Quality: {table.quality_name}, dB."]
    if not kept:
        return [*out, "No trial has both a time and a quality."]
    first = compared[kept[0]]
    out.append(f"Fastest: {first.trial.label}: {qualities[kept[0]]:.2f} dB in {_said(first.seconds)}.")
    for stretch in pareto.steps(kept, seconds, qualities):
        out.append(
            f"+{stretch.gain:.2f} dB for {_said(stretch.cost)} more ({_said(stretch.per_decibel)} a dB): "
            f"{compared[stretch.end].trial.label}."
        )
    out += [_precision(o.details) for o in table.outcomes if o.trial.group == "precision" and o.details]
    return out


def _precision(details: Mapping[str, float]) -> str:
    return (
        "The same small fit in float32 and in the float64 twin: residual "
        f"{details['residual_float32']:.5f} and {details['residual_float64']:.5f}, volumes "
        f"{details['difference']:.2g} apart (relative RMS), {_said(details['seconds_float32'])} and "
        f"{_said(details['seconds_float64'])}."
    )


def write_table(folder: Path, table: Table) -> None:
    """tradeoff.csv and tradeoff.json, each whole, in place of earlier ones."""
    record = {
        "format": "splatline tradeoff 1",
        "version": version(),
        "command": table.command,
        "machine": dict(table.machine),
        "scan": dict(table.scan),
        "quality": table.by,
        "length_unit": table.length_unit,
        "trials": [outcome.as_record() for outcome in table.outcomes],
        "front_seconds": [table.compared[i].trial.label for i in table.front("seconds")],
        "front_memory": [table.compared[i].trial.label for i in table.front("memory")],
    }
    _write(folder / "tradeoff.json", json.dumps(finite(record), indent=1, ensure_ascii=False, allow_nan=False))
    _write(folder / "tradeoff.csv", to_csv(table))


def to_csv(table: Table) -> str:
    """One line a trial; empty where there is no figure."""
    names = _metric_names(table)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(
        [*_FIELDS, "status", "seconds", "cpu_seconds", "peak_bytes", "gaussians_end", *names, "quality_db", "message"]
    )
    for outcome in table.outcomes:
        values = [getattr(outcome.trial, name) for name in _FIELDS]
        values += [outcome.status, outcome.seconds, outcome.cpu_seconds, outcome.peak_bytes, outcome.gaussians]
        values += [outcome.metrics.get(name) for name in names]
        writer.writerow([finite(v) for v in (*values, outcome.quality(table.by), outcome.message)])
    return out.getvalue()


def write_figures(folder: Path, table: Table) -> None:
    """The pictures and the page; nothing where no trial was made."""
    pictures = []
    for cost, title in (("seconds", "Quality against time"), ("memory", "Quality against memory")):
        if table.front(cost):
            caption = (
                f"{table.quality_name} of every trial against its {'time' if cost == 'seconds' else 'peak memory'}; "
                "the line is the best that can be had for so much, its corners the trials that no other beats in both."
            )
            pictures.append((f"quality_{cost}.png", Picture(title, caption, _pareto(table, cost))))
    curves = [o for o in table.compared if o.trial.group == "method" and len(o.curve) > 1]
    if curves:
        caption = (
            "−20 log₁₀ of the residual that each baseline recorded while it ran: solid where it is of views held out, "
            "dashed where of the views used, which falls on when the volume already follows their noise. A fit's is "
            "that of its Gaussians, which may lie between voxels and beyond the volume, by which the table judges."
        )
        pictures.append(("curves.png", Picture("Each method's own curve", caption, cost_curves(curves))))
    for name, picture in pictures:
        with named_on_failure(folder / name), whole_file(folder / name, replace=True) as partial:
            partial.write_bytes(picture.png)
    _write(folder / "tradeoff.html", to_html(table, [picture for _, picture in pictures]))


def _pareto(table: Table, cost: str) -> bytes:
    scale, unit = (1.0, "time (s)") if cost == "seconds" else (1e-6, "peak memory of the process (MB)")
    return pareto_plot(
        [(o.trial, c * scale, q) for o, c, q in zip(table.compared, table.costs(cost), table.qualities, strict=True)],
        table.front(cost),
        unit,
        "PSNR (dB)" if table.by == "psnr" else "held-out residual (dB below the data)",
    )


def to_html(table: Table, pictures: Sequence[Picture]) -> str:
    """The page."""
    names = _metric_names(table)
    best = {table.compared[i].trial for i in table.front("seconds")}
    head = "".join(
        f"<th scope='col'>{escape(h)}</th>" for h in ("s", "CPU s", "MB", *(_heading(n, table) for n in names))
    )
    rows = []
    for o in table.outcomes:
        if o.trial.group == "precision":
            continue
        label = escape(o.trial.label)
        label = f"<strong>{label}</strong>" if o.trial in best else label
        if o.status == "done":
            cells = "".join(
                f"<td>{escape(c)}</td>"
                for c in (_time(o.seconds), _time(o.cpu_seconds), _megabytes(o), *(_cell(n, o) for n in names))
            )
        else:
            why = escape(f"{o.status}: {o.message}".rstrip(": "))
            cells = f"<td colspan='{len(names) + 3}'>{why}</td>"
        rows.append(f"<tr><th scope='row'>{label}</th>{cells}</tr>")
    body = "".join(rows)
    summary = f"{table.n_done} of {len(table.outcomes)} trials on {machine_line(dict(table.machine))}."
    sections = [
        f"<h1>What accuracy costs</h1>\n<p class='summary'>{escape(summary)}</p>",
        "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in conclusions(table)) + "</ul>",
        *(picture_html(picture) for picture in pictures),
        "<h2>Trials</h2>\n<p>Bold: on the front of time and quality.</p>\n"
        f"<table class='metrics'><thead><tr><td></td>{head}</tr></thead>\n<tbody>{body}</tbody></table>",
        "<h2>Scan</h2>\n" + table_html(table.scan),
        f"<h2>To repeat</h2>\n<pre><code>{escape(table.command)}</code></pre>",
    ]
    return page("What accuracy costs", sections)


def _metric_names(table: Table) -> list[str]:
    order = ("psnr", "ssim3d", "residual_held_out", "resolution")
    return [name for name in order if any(name in o.metrics for o in table.outcomes)]


def _heading(name: str, table: Table) -> str:
    if name == "resolution":
        return f"FSC ({table.length_unit})"
    return {"psnr": "PSNR (dB)", "ssim3d": "SSIM 3D", "residual_held_out": "held-out res."}[name]


def _cell(name: str, outcome: Outcome) -> str:
    value = outcome.metrics.get(name)
    if value is None:
        return "–"
    if name == "resolution":
        return f"{value:.3g}" if math.isfinite(value) else "none"
    return f"{value:.{METRICS[name].digits}f}" if math.isfinite(value) else "undefined"


def _megabytes(outcome: Outcome) -> str:
    return "n/a" if outcome.peak_bytes is None else f"{outcome.peak_bytes / 1e6:.0f}"


def finite(value: Any) -> Any:
    """Plain values for JSON and CSV; what is not finite becomes None."""
    if isinstance(value, Mapping):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _write(path: Path, content: str) -> None:
    with named_on_failure(path), whole_file(path, replace=True) as partial:
        partial.write_text(content, encoding="utf-8")
