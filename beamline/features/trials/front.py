"""Front: how a trade-off is written: its columns, the Pareto front of quality and cost, and what follows from it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from operator import attrgetter
from typing import Any

from beamline.features.trials.figures import cost_curves, pareto_plot
from beamline.features.trials.layout import TableColumn, TableLayout, in_digits
from beamline.features.trials.table import LEAST_GAIN, MEMORY, TIME, TrialCost, TrialTable
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


_FIGURES = {
    "psnr": _Figure("PSNR", "PSNR (dB)", "dB against the truth", partial(in_digits, "psnr")),
    "ssim3d": _Figure("SSIM", "SSIM 3D", "mean over the slices of three directions", partial(in_digits, "ssim3d")),
    "rmse": _Figure("RMSE", "RMSE", "of the activity", partial(in_digits, "rmse")),
    "signal_to_background": _Figure(
        "S/B", "signal/background", "hot regions over the body", partial(in_digits, "recovery")
    ),
    "sbr_error": _Figure("S/B err", "its largest error", "of a hot region, relative", partial(in_digits, "sbr_error")),
    "recovery": _Figure(
        "hot", "contrast recovery", "contrast of hot regions over the truth's", partial(in_digits, "recovery")
    ),
    "spillover": _Figure("cold", "spillover", "level of cold regions over the body's", partial(in_digits, "spillover")),
    "variation": _Figure(
        "noise", "noise", "standard deviation of the body over its level", partial(in_digits, "variation")
    ),
    "residual_held_out": _Figure(
        "held out", "held-out res.", METRICS["residual_held_out"].label, partial(in_digits, "residual_held_out")
    ),
    "resolution": _Figure(
        "FSC",
        "FSC ({})",
        "period in {} to which two halves of the views agree",
        lambda value: f"{value:.3g}" if math.isfinite(value) else "none",
    ),
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
        *(TableColumn(name, attrgetter(f"trial.{name}")) for name in ("group", "method", "views", "binning")),
        *(TableColumn(name, partial(_setting, name)) for name in settings),
        TableColumn("status", lambda o: o.status),
        TableColumn("seconds_asked", lambda o: o.trial.seconds_asked),
        TableColumn("seconds", lambda o: o.seconds, "s", "s", words=_time),
        TableColumn("cpu_seconds", lambda o: o.cpu_seconds, "CPU s", "CPU s", words=_time),
        TableColumn("reached", lambda o: o.reached, "reached" * table.timed, "reached", 0),
        TableColumn("peak_bytes", lambda o: o.peak_bytes, "MB", "MB", 6, lambda n: f"{n / 1e6:.0f}"),
        TableColumn("gaussians_end", lambda o: o.gaussians),
        *dose_columns(table),
        *(
            TableColumn(
                name,
                partial(_metric, name),
                figure.heading.format(table.length_unit),
                figure.short,
                9,
                figure.shown,
                metric=True,
            )
            for name, figure in _figures(table).items()
        ),
        TableColumn("quality_db", lambda o: o.quality(table.by)),
        TableColumn("message", lambda o: o.message),
    ]


def _marked(table: TrialTable) -> set[int]:
    best = {id(table.compared[i]) for i in table.front(TIME)}
    return {n for n, outcome in enumerate(table.outcomes) if id(outcome) in best}


def _legend(table: TrialTable) -> Sequence[str]:
    figures = _figures(table).values()
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


def _metric(name: str, outcome: Outcome) -> float | None:
    return outcome.metrics.get(name)


def _figures(table: TrialTable) -> dict[str, _Figure]:
    """Of the metrics that any trial has."""
    return {name: figure for name, figure in _FIGURES.items() if any(name in o.metrics for o in table.outcomes)}


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
    for i, j in pairwise(kept):
        rise, cost = qualities[j] - qualities[i], seconds[j] - seconds[i]
        chance = f" ± {table.chance(j, i):.2f}" * table.quality.of_views
        price = f"{_duration(cost)} more ({_duration(cost / rise)} a dB)"
        out.append(f"+{rise:.2f}{chance} dB for {price}: {compared[j].trial.label}.")
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
