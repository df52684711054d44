"""Pictures of a trade-off: quality against cost of every trial with the Pareto front, and residuals against time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from beamline.report.figures import png
from beamline.trials.trial import Outcome, Trial
from beamline.trials.varied import colour_of

_SIZE, _DPI = (8.6, 5.2), 110
_SHOWN_DB = 12.0  # below the best; worse trials are counted, not drawn
_MARKERS = {
    "method": "o", "steps": "^", "iterations": "^", "views": "s", "gaussians": "D", "binning": "v", "kernel": "P",
    "loss": "X", "start": "*", "rectification": "h",
    "parts": "s", "one fit": "D",
}  # fmt: skip


def pareto_plot(
    points: Sequence[tuple[Trial, float, float]], front: Sequence[int], cost_label: str, quality_label: str
) -> bytes:
    """Quality against cost; the line is the best quality at each cost.

    Args:
        points: (trial, cost, dB); points that are not finite are left out.
        front: positions of the points on the front, by rising cost.
        cost_label, quality_label: with units.
    """
    figure = Figure(figsize=(_SIZE[0], _SIZE[1] + 0.18 * len(front)), dpi=_DPI, layout="constrained")
    axes: Axes = figure.subplots()
    shown = [(t, c, q) for t, c, q in points if math.isfinite(c) and math.isfinite(q)]
    named = {id(points[i]) for i in front}
    for point in points:
        trial, cost, quality = point
        if not (math.isfinite(cost) and math.isfinite(quality)):
            continue
        # The trials that numbers name lie above those at the same place.
        axes.scatter(
            cost, quality, s=_size(trial.group), marker=_MARKERS.get(trial.group, "o"),
            color=colour_of(trial.method), edgecolors="white", linewidths=0.6, zorder=4 if id(point) in named else 3,
        )  # fmt: skip
    kept = [points[i] for i in front]
    axes.step([p[1] for p in kept], [p[2] for p in kept], where="post", color="black", lw=1.1, alpha=0.5, zorder=2)
    _scale(axes, [c for _, c, _ in shown])
    axes.margins(x=0.08, y=0.1)
    best = max((q for _, _, q in shown), default=0.0)
    below = [q for _, _, q in shown if q < best - _SHOWN_DB]
    if below:
        axes.set_ylim(bottom=best - _SHOWN_DB)
        note = f"{len(below)} more below {best - _SHOWN_DB:.1f} dB"
        axes.text(0.99, 0.02, note, transform=axes.transAxes, ha="right", fontsize=8, color="0.4")
    for number, (_, cost, quality) in enumerate(kept, start=1):
        axes.annotate(
            str(number), (cost, quality), xytext=(-6, 5), textcoords="offset points", ha="right", fontsize=9,
            fontweight="bold",
        )  # fmt: skip
    axes.set(xlabel=cost_label, ylabel=quality_label)
    axes.grid(alpha=0.25)
    _legend(figure, axes, shown)
    names = [f"{number}  {trial.label}: {quality:.2f} dB" for number, (trial, _, quality) in enumerate(kept, start=1)]
    figure.supxlabel("\n".join(names), fontsize=8, x=0.06, ha="left", linespacing=1.5)
    return png(figure)


def cost_curves(outcomes: Sequence[Outcome]) -> bytes:
    """The residual of each trial during its run, dB against s: solid for views held out, dashed for views used."""
    figure = Figure(figsize=(_SIZE[0], 4.0), dpi=_DPI, layout="constrained")
    axes: Axes = figure.subplots()
    for outcome in outcomes:
        seconds, quality = np.array(outcome.curve).T
        axes.plot(
            seconds, quality, lw=1.4, color=colour_of(outcome.trial.method),
            ls="-" if outcome.curve_of == "views held out" else "--",
            label=f"{outcome.trial.method} ({outcome.curve_of})",
        )  # fmt: skip
    _scale(axes, [seconds for outcome in outcomes for seconds, _ in outcome.curve])
    axes.set(xlabel="time (s)", ylabel="residual (dB below the data)")
    figure.legend(loc="outside right upper", fontsize=8, frameon=False)
    axes.grid(alpha=0.25)
    return png(figure)


def _size(group: str) -> float:
    """Area of a marker, points²: a star looks smaller than other markers."""
    return 90 if _MARKERS.get(group) == "*" else 46


def _scale(axes: Axes, costs: Sequence[float]) -> None:
    """Make the axis of costs logarithmic if they differ by more than a factor of four."""
    if not costs or min(costs) <= 0 or max(costs) < 4 * min(costs):
        return
    axes.set_xscale("log")
    wide = max(costs) > 100 * min(costs)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0), numticks=20))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _legend(figure: Figure, axes: Axes, shown: Sequence[tuple[Trial, float, float]]) -> None:
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
