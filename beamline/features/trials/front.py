"""Front: how a trade-off is written: its columns, the Pareto front of quality and cost, and what follows from it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from beamline.features.trials.figures import cost_curves, pareto_plot
from beamline.features.trials.layout import TableColumn, TableLayout, metric_column
from beamline.features.trials.table import LEAST_GAIN, MEMORY, TIME, TrialCost, TrialTable, steps
from beamline.features.trials.trial import Outcome
from beamline.projections.scan_statistics import Light
from beamline.report.html import Picture
from beamline.report.metrics import METRICS
from beamline.report.sheets import SliceSheet
from recon.assess.time_model import duration_text


@dataclass(frozen=True)
class _Figure:
    """How the tables name a metric. `{}` in `heading` and `legend` is the unit of length."""

    short: str
    heading: str
    legend: str
    shown: Callable[[float], str]


def _digits(name: str) -> Callable[[float], str]:
    return lambda value: f"{value:.{METRICS[name].digits}f}" if math.isfinite(value) else "undefined"


def _period(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "none"


_FIGURES = {
    "psnr": _Figure("PSNR", "PSNR (dB)", "dB against the truth", _digits("psnr")),
    "ssim3d": _Figure("SSIM", "SSIM 3D", "mean over the slices of three directions", _digits("ssim3d")),
    "recovery": _Figure("hot", "contrast recovery", "contrast of hot regions over the truth's", _digits("recovery")),
    "spillover": _Figure("cold", "spillover", "level of cold regions over the body's", _digits("spillover")),
    "variation": _Figure("noise", "noise", "standard deviation of the body over its level", _digits("variation")),
    "residual_held_out": _Figure(
        "held out", "held-out res.", METRICS["residual_held_out"].label, _digits("residual_held_out")
    ),
    "resolution": _Figure("FSC", "FSC ({})", "period in {} to which two halves of the views agree", _period),
}

_NEAR = 1.0  # dB below the best figure: a tenth more error
_FSC = (
    "FSC: a smaller period is better among settings of one method only. Two halves that are regularised alike agree "
    "also in what the prior made, and in rings. A higher FSC than that of FBP does not prove a sharper volume: look "
    "at the slices."
)


def _columns(table: TrialTable) -> Sequence[TableColumn]:
    settings = list(dict.fromkeys(name for outcome in table.outcomes for name in outcome.trial.settings))
    return [
        *(TableColumn(name, _of_trial(name)) for name in ("group", "method", "views", "binning")),
        *(TableColumn(name, partial(_setting, name)) for name in settings),
        TableColumn("status", lambda o: o.status),
        TableColumn("seconds_asked", lambda o: o.trial.seconds_asked),
        TableColumn("seconds", lambda o: o.seconds, "s", "s", shown=lambda o: _time(o.seconds)),
        TableColumn("cpu_seconds", lambda o: o.cpu_seconds, "CPU s", "CPU s", shown=lambda o: _time(o.cpu_seconds)),
        TableColumn("reached", lambda o: o.reached, "reached" * table.timed, "reached", 0, lambda o: o.reached),
        TableColumn("peak_bytes", lambda o: o.peak_bytes, "MB", "MB", 6, _megabytes),
        TableColumn("gaussians_end", lambda o: o.gaussians),
        *dose_columns(table),
        *(_figure(name, table.length_unit) for name in _names(table)),
        TableColumn("quality_db", lambda o: o.quality(table.by)),
        TableColumn("message", lambda o: o.message),
    ]


def _marked(table: TrialTable) -> set[int]:
    best = {id(table.compared[i]) for i in table.front(TIME)}
    return {n for n, outcome in enumerate(table.outcomes) if id(outcome) in best}


def _legend(table: TrialTable) -> Sequence[str]:
    figures = [_FIGURES[name] for name in _names(table)]
    words = "; ".join(f"{each.short}: {each.legend.format(table.length_unit)}" for each in figures)
    return [*([f"{words}."] if words else []), "*: on the front of time and quality."]


def _record(table: TrialTable) -> Mapping[str, Any]:
    return {
        "quality": table.by,
        "length_unit": table.length_unit,
        "trials": [outcome.as_record() for outcome in table.outcomes],
        "front_seconds": [table.compared[i].trial.label for i in table.front(TIME)],
        "front_memory": [table.compared[i].trial.label for i in table.front(MEMORY)],
    }


def _pictures(table: TrialTable, slices: SliceSheet) -> Sequence[tuple[str, Picture]]:
    """Quality against each cost, curves, and slices of each baseline and of the truth."""
    pictures = []
    doses = [table.dose] if len({outcome.trial.views for outcome in table.compared}) > 1 else []
    for cost in (TIME, MEMORY, *doses):
        if table.front(cost):
            caption = (
                f"{table.quality.words} of every trial against its {cost.words}. The line is the best quality "
                "at each cost; its corners are the trials that no other beats in both."
            )
            picture = Picture(f"Quality against {cost.words}", caption, _pareto(table, cost))
            pictures.append((f"quality_{cost.name}.png", picture))
    curves = [o for o in table.compared if o.trial.group == "method" and len(o.curve) > 1]
    if curves:
        caption = (
            "−20 log₁₀ of the residual that each baseline recorded during its run. Solid: views held out. Dashed: "
            "views used; this residual still falls when the volume already fits their noise. A fit's residual is "
            "that of its Gaussians, which may lie between voxels and outside the volume; the table judges the "
            "volume."
        )
        pictures.append(("curves.png", Picture("Residual of each method during its run", caption, cost_curves(curves))))
    if labels := slices.labels():
        caption = "The same slice by each method with its usual settings, all in the grey window of the first."
        if any(outcome.trial.several for outcome in table.outcomes):
            caption += " Of several volumes, the one that the middle view shows, by its time or energy."
        pictures.append(("slices.png", Picture("Slices", caption, slices.png(labels))))
    return pictures


def dose_columns(table: TrialTable) -> list[TableColumn]:
    """The dose of each trial, where the light is known."""
    if (light := table.light) is None:
        return []
    return [TableColumn(name, partial(_dose, light, name)) for name in light.of(1)]


def _dose(light: Light, name: str, outcome: Outcome) -> float:
    return light.of(outcome.trial.frames)[name]


def _setting(name: str, outcome: Outcome) -> Any:
    return outcome.trial.settings.get(name)


def _of_trial(name: str) -> Callable[[Outcome], Any]:
    return lambda outcome: getattr(outcome.trial, name)


def _figure(name: str, length_unit: str) -> TableColumn:
    figure = _FIGURES[name]
    heading = figure.heading.format(length_unit)
    return metric_column(name, lambda o: o.metrics.get(name), figure.shown, heading, figure.short, 9)


def _names(table: TrialTable) -> list[str]:
    """Of the metrics that any trial has."""
    return [name for name in _FIGURES if any(name in o.metrics for o in table.outcomes)]


def _megabytes(outcome: Outcome) -> str:
    return "n/a" if outcome.peak_bytes is None else f"{outcome.peak_bytes / 1e6:.0f}"


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
    out = [f"Quality: {table.quality.words}, dB."]
    if not kept:
        return [*out, "No trial has both a time and a quality."]
    first, best, pick = compared[kept[0]], compared[kept[-1]], kept[worth_its_time(table) or 0]
    words = f"Best for its time: {compared[pick].trial.label}: {qualities[pick]:.2f} dB in {_duration(seconds[pick])}"
    if pick != kept[-1]:
        gain, more = qualities[kept[-1]] - qualities[pick], _duration(best.seconds - seconds[pick])
        words += f"; the best of all ({best.trial.label}) has {gain:.2f} dB more, for {more} more"
    out = [f"{words}.", *out]
    out.append(f"Fastest: {first.trial.label}: {qualities[kept[0]]:.2f} dB in {_duration(first.seconds)}.")
    for stretch in steps(kept, seconds, qualities):
        chance = "" if not table.quality.of_views else f" ± {table.chance(stretch.end, stretch.start):.2f}"
        out.append(
            f"+{stretch.gain:.2f}{chance} dB for {_duration(stretch.cost)} more "
            f"({_duration(stretch.per_decibel)} a dB): {compared[stretch.end].trial.label}."
        )
    out += _level(table, kept[-1])
    if any("resolution" in outcome.metrics for outcome in compared):
        out.append(_FSC)
    return out


def worth_its_time(table: TrialTable) -> int | None:
    """Number on the front of time of the quickest trial within `_NEAR` of the best one; None without a front."""
    front, qualities = table.front(TIME), table.qualities
    near = [n for n, i in enumerate(front) if qualities[i] >= qualities[front[-1]] - _NEAR]
    return near[0] if near else None


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


def _pareto(table: TrialTable, cost: TrialCost) -> bytes:
    points = zip(table.compared, table.costs(cost), table.qualities, strict=True)
    return pareto_plot(
        [(outcome.trial, value * cost.scale, quality) for outcome, value, quality in points],
        table.front(cost),
        cost.axis,
        table.quality.axis,
        cost.unit,
        worth_its_time(table) if cost is TIME else None,
    )


TRADEOFF = TableLayout(
    "tradeoff", "tradeoff.html", "trials", "What accuracy costs", lambda outcome: (outcome.trial.label,), _columns,
    conclusions, _record, _pictures, marked=_marked, legend=_legend,
)  # fmt: skip
"""The table of a trade-off, whose rows on the front of time and quality stand out."""
