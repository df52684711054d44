"""Front: what follows from a trade-off: the Pareto front of quality and cost, as pictures and in sentences."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from beamline.features.trials.layout import Figure, TableLayout
from beamline.features.trials.trial import (
    HELD_OUT,
    LEAST_GAIN,
    MEMORY,
    QUALITIES,
    TIME,
    Outcome,
    Trial,
    TrialCost,
    TrialTable,
)
from beamline.report.figures import finish, one_panel, png
from beamline.report.html import Picture
from beamline.report.metrics import METRICS
from beamline.report.sheets import SliceSheet
from recon.assess.time_model import duration_text
from recon.methods import by_name, names

if TYPE_CHECKING:
    from matplotlib import figure as drawing
    from matplotlib.axes import Axes

_FIGURES = {
    each.metric: each
    for each in (
        Figure("psnr", "PSNR", "PSNR (dB)", "dB against the truth"),
        Figure("ssim3d", "SSIM", "SSIM 3D", "mean over the slices of three directions"),
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


def _pictures(table: TrialTable, slices: SliceSheet) -> Iterator[tuple[str, Picture]]:
    """Quality against each cost, curves, and slices of each baseline and of the truth."""
    doses = [table.dose] if len({outcome.trial.views for outcome in table.compared}) > 1 else []
    for cost in (TIME, MEMORY, *doses):
        if table.front(cost):
            caption = (
                f"{QUALITIES[table.by][0]} of every trial against its {cost.words}. The line is the best quality "
                "at each cost; its corners are the trials that no other beats in both."
            )
            yield f"quality_{cost.name}.png", Picture(f"Quality against {cost.words}", caption, _pareto(table, cost))
    curves = [o for o in table.compared if o.trial.group == "method" and len(o.curve) > 1]
    if curves:
        caption = (
            "−20 log₁₀ of the residual that each baseline recorded during its run. Solid: views held out. Dashed: "
            "views used; this residual still falls when the volume already fits their noise. A fit's residual is "
            "that of its Gaussians, which may lie between voxels and outside the volume; the table judges the "
            "volume."
        )
        yield "curves.png", Picture("Residual of each method during its run", caption, cost_curves(curves))
    if labels := slices.labels():
        caption = "The same slice by each method with its usual settings, all in the grey window of the first."
        if any(by_name(outcome.trial.method).traits.several for outcome in table.outcomes):
            caption += " Of several volumes, the one that the middle view shows, by its time or energy."
        yield "slices.png", Picture("Slices", caption, slices.png(labels))


def _duration(seconds: float) -> str:
    """A time to three significant digits, in µs, ms, or the units of `duration_text`."""
    for unit, name in ((1e-3, "µs"), (1.0, "ms")):
        if 0 < seconds < unit:
            return f"{seconds / unit * 1e3:.3g} {name}"
    return duration_text(seconds)


def conclusions(table: TrialTable) -> list[str]:
    """Sentences: the time of each further dB along the front."""
    by, kept, quality = table.by, table.front(TIME), f"Quality: {QUALITIES[table.by][0]}, dB."
    if not kept:
        return [quality, "No trial has both a time and a quality."]
    fastest, best, pick = kept[0], kept[-1], worth_its_time(kept, by)
    out = [_told("Best for its time", pick, by), quality, f"{_told('Fastest', fastest, by)}."]
    if pick is not best:
        gain, more = best.quality(by) - pick.quality(by), _duration(best.seconds - pick.seconds)
        out[0] += f"; the best of all ({best.trial.label}) has {gain:.2f} dB more, for {more} more"
    out[0] += "."
    for before, after in pairwise(kept):
        rise, cost = after.quality(by) - before.quality(by), after.seconds - before.seconds
        chance = f" ± {table.chance(after, before):.2f}" * (by == HELD_OUT)
        price = f"{_duration(cost)} more ({_duration(cost / rise)} a dB)"
        out.append(f"+{rise:.2f}{chance} dB for {price}: {after.trial.label}.")
    out += _level(table, best)
    return [*out, _FSC] if any("resolution" in outcome.metrics for outcome in table.compared) else out


def _told(what: str, outcome: Outcome, by: str) -> str:
    return f"{what}: {outcome.trial.label}: {outcome.quality(by):.2f} dB in {_duration(outcome.seconds)}"


def worth_its_time(front: Sequence[Outcome], by: str) -> Outcome:
    """The quickest trial of the front within `_NEAR` of its best one."""
    return next(outcome for outcome in front if outcome.quality(by) >= front[-1].quality(by) - _NEAR)


def _level(table: TrialTable, last: Outcome) -> list[str]:
    """A sentence where a trial that costs more seems better than the last one of the front, by chance."""
    known = [outcome for outcome in table.compared if math.isfinite(outcome.quality(table.by))]
    best = max(known, key=lambda outcome: outcome.quality(table.by))
    gain = best.quality(table.by) - last.quality(table.by)
    if best is last or gain < LEAST_GAIN:
        return []
    return [
        f"There it ends: the best figure, +{gain:.2f} dB for {_duration(best.seconds - last.seconds)} more "
        f"({best.trial.label}), is within chance (± {table.chance(best, last):.2f} dB)."
    ]


def _pareto(table: TrialTable, cost: TrialCost) -> bytes:
    front, compared = table.front(cost), table.compared
    return pareto_plot(
        [(outcome.trial, cost.of(outcome) * cost.scale, outcome.quality(table.by)) for outcome in compared],
        [compared.index(outcome) for outcome in front],
        cost.axis,
        QUALITIES[table.by][1],
        cost.unit,
        front.index(worth_its_time(front, table.by)) if cost is TIME else None,
    )


TRADEOFF = TableLayout(
    "tradeoff", "tradeoff.html", "trials", "What accuracy costs", _FIGURES, conclusions, _pictures, front=True
)
"""The table of a trade-off, whose rows on the front of time and quality stand out."""


_SHOWN_DB = 12.0  # below the best; worse trials are counted, not drawn
_APART = 16.0  # pixels between two numbers on the same side of their points, at least
_MARKERS = {
    "method": "o", "steps": "^", "iterations": "^", "views": "s", "gaussians": "D", "binning": "v", "kernel": "P",
    "loss": "X", "start": "*", "rectification": "h",
    "parts": "s", "one fit": "D",
}  # fmt: skip


def pareto_plot(
    points: Sequence[tuple[Trial, float, float]],
    front: Sequence[int],
    cost_label: str,
    quality_label: str,
    unit: str = "",
    pick: int | None = None,
) -> bytes:
    """Quality against cost; the line is the best quality at each cost.

    Args:
        points: (trial, cost, dB); points that are not finite are left out.
        front: positions of the points on the front, by rising cost.
        cost_label, quality_label: with units.
        unit: of the cost.
        pick: number in `front` of the trial that is worth its cost, which gets a ring; None: of none.
    """
    figure, axes = one_panel(5.2 + 0.18 * len(front))
    shown = [(t, c, q) for t, c, q in points if math.isfinite(c) and math.isfinite(q)]
    kept = [points[i] for i in front]
    for trial, cost, quality in shown:
        # The trials that numbers name lie above those at the same place.
        axes.scatter(
            cost, quality, s=_size(trial.group), marker=_MARKERS.get(trial.group, "o"),
            color=colour_of(trial.method), edgecolors="white", linewidths=0.6,
            zorder=4 if (trial, cost, quality) in kept else 3,
        )  # fmt: skip
    axes.step([p[1] for p in kept], [p[2] for p in kept], where="post", color="black", lw=1.1, alpha=0.5, zorder=2)
    scale(axes, [c for _, c, _ in shown])
    axes.margins(x=0.08, y=0.1)
    best = max((q for _, _, q in shown), default=0.0)
    lowest = min([best - _SHOWN_DB, *(q - 0.5 for _, _, q in kept)])  # the front is drawn whole
    below = [q for _, _, q in shown if q < lowest]
    if below:
        axes.set_ylim(bottom=lowest)
        note = f"{len(below)} more below {lowest:.1f} dB"
        axes.text(0.99, 0.02, note, transform=axes.transAxes, ha="right", fontsize=8, color="0.4")
    _number(axes, [(cost, quality) for _, cost, quality in kept])
    if pick is not None:
        _, cost, quality = kept[pick]
        axes.scatter(cost, quality, s=220, facecolors="none", edgecolors="black", linewidths=1.4, zorder=5)
    finish(axes, cost_label, quality_label, grid=True)
    _legend(figure, axes, shown)
    lines = [f"{n + 1}  {t.label}: {quality:.2f} dB, {cost:.3g} {unit}" for n, (t, cost, quality) in enumerate(kept)]
    if pick is not None:
        lines[pick] += "   (ring: best for its time)"
    figure.supxlabel("\n".join(lines), fontsize=8, x=0.06, ha="left", linespacing=1.5)
    return png(figure)


def _number(axes: Axes, places: Sequence[tuple[float, float]]) -> None:
    """Number points from 1 on, to the left of each; to the right where that would hit the number before."""
    before = None
    for number, place in enumerate(places, start=1):
        pixel = axes.transData.transform(place)
        beside = before is not None and float(np.hypot(*(pixel - before))) < _APART
        axes.annotate(
            str(number), place, xytext=(7, -9) if beside else (-6, 5), textcoords="offset points",
            ha="left" if beside else "right", fontsize=9, fontweight="bold",
        )  # fmt: skip
        before = None if beside else pixel


def cost_curves(outcomes: Sequence[Outcome]) -> bytes:
    """The residual of each trial during its run, dB against s: solid for views held out, dashed for views used."""
    figure, axes = one_panel(4.0)
    for outcome in outcomes:
        seconds, quality = np.array(outcome.curve).T
        axes.plot(
            seconds, quality, lw=1.4, color=colour_of(outcome.trial.method),
            ls="-" if outcome.curve_of == "views held out" else "--",
            label=f"{outcome.trial.method} ({outcome.curve_of})",
        )  # fmt: skip
    scale(axes, [seconds for outcome in outcomes for seconds, _ in outcome.curve])
    axes.set(xlabel="time (s)", ylabel="residual (dB below the data)")
    figure.legend(loc="outside right upper", fontsize=8, frameon=False)
    axes.grid(alpha=0.25)
    return png(figure)


def _size(group: str) -> float:
    """Area of a marker, points²: a star looks smaller than other markers."""
    return 90 if _MARKERS.get(group) == "*" else 46


def scale(axes: Axes, costs: Sequence[float]) -> None:
    """Make the axis of costs logarithmic if they differ by more than a factor of four."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    if not costs or min(costs) <= 0 or max(costs) < 4 * min(costs):
        return
    axes.set_xscale("log")
    wide = max(costs) > 100 * min(costs)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0), numticks=20))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _legend(figure: drawing.Figure, axes: Axes, shown: Sequence[tuple[Trial, float, float]]) -> None:
    methods = dict.fromkeys(t.method for t, _, _ in shown)
    groups = dict.fromkeys("steps" if t.group == "iterations" else t.group for t, _, _ in shown)
    handles = [
        axes.scatter([], [], color=colour_of(m), s=40, label=m) for m in methods
    ] + [
        axes.scatter(
            [], [], color="white", edgecolors="0.2", marker=_MARKERS.get(g, "o"), s=_size(g), label=_WORDS.get(g, g)
        )
        for g in groups
    ]  # fmt: skip
    figure.legend(handles=handles, loc="outside right upper", fontsize=8, frameon=False, title="method, varied setting")


_WORDS = {
    "method": "baseline", "steps": "steps, iterations", "views": "fewer views", "gaussians": "number of Gaussians",
    "parts": "parts of the views", "one fit": "one fit of all views",
}  # fmt: skip


def colour_of(method: str) -> str:
    """Of a method in pictures, as matplotlib takes it; a method without a line in `COLOURS` has one that is left."""
    others = [name for name in names() if name not in COLOURS]
    return COLOURS[method] if method in COLOURS else _SPARE[others.index(method) % len(_SPARE)]


COLOURS: Mapping[str, str] = {
    "r2": "tab:blue", "r2-published": "navy", "fbp": "0.35", "sirt": "tab:green", "sart": "tab:olive",
    "cgls": "tab:cyan", "asd-pocs": "tab:purple", "fista-tv": "tab:red", "os-sirt-tv": "tab:orange",
    "pnp-dct": "maroon",
    "series": "darkgreen", "materials": "slateblue",
}  # fmt: skip
_SPARE = ("tab:pink", "black", "sienna", "steelblue", "olivedrab", "orchid")
