"""Front: what follows from a trade-off: its pictures, and the Pareto front of quality and cost in sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

from beamline.features.trials.figures import cost_curves, pareto_plot
from beamline.features.trials.layout import Figure, TableLayout
from beamline.features.trials.table import LEAST_GAIN, MEMORY, TIME, TrialCost, TrialTable
from beamline.report.html import Picture
from beamline.report.metrics import METRICS
from beamline.report.sheets import SliceSheet
from recon.assess.time_model import duration_text

_FIGURES = {
    each.metric: each
    for each in (
        Figure("psnr", "PSNR", "PSNR (dB)", "dB against the truth"),
        Figure("ssim3d", "SSIM", "SSIM 3D", "mean over the slices of three directions"),
        Figure("rmse", "RMSE", "RMSE", "of the activity"),
        Figure("signal_to_background", "S/B", "signal/background", "hot regions over the body"),
        Figure("sbr_error", "S/B err", "its largest error", "of a hot region, relative"),
        Figure("recovery", "hot", "contrast recovery", "contrast of hot regions over the truth's"),
        Figure("spillover", "cold", "spillover", "level of cold regions over the body's"),
        Figure("variation", "noise", "noise", "standard deviation of the body over its level"),
        Figure("residual_held_out", "held out", "held-out res.", METRICS["residual_held_out"].label),
        Figure("resolution", "FSC", "FSC ({})", "period in {} to which two halves of the views agree"),
    )
}
_NEAR = 1.0  # dB below the best figure: a tenth more error
_FSC = (
    "FSC: a smaller period is better among settings of one method only. Two halves that are regularised alike agree "
    "also in what the prior made, and in rings. A higher FSC than that of FBP does not prove a sharper volume: look "
    "at the slices."
)


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
    "tradeoff", "tradeoff.html", "trials", "What accuracy costs", _FIGURES, conclusions, _pictures, front=True
)
"""The table of a trade-off, whose rows on the front of time and quality stand out."""
