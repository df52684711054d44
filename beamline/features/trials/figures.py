"""Pictures of a table of trials: figures of every trial, against time, memory and dose, and residuals in its run."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from beamline.features.trials.table import TrialTable
from beamline.features.trials.trial import Outcome, Trial
from beamline.report.figures import WIDTH, new_figure, one_panel, png
from recon.methods import names

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_KINDS = "os^vD"  # markers of kinds of scans
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
    axes.set(xlabel=cost_label, ylabel=quality_label)
    axes.grid(alpha=0.25)
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
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

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

Value = Callable[[Outcome], float | None]


def figures_of_rows(table: TrialTable, values: Mapping[str, Value]) -> bytes:
    """Every figure of all rows, a line a method.

    Args:
        values: of a row, by the label of their axis.
    """
    rows = list(dict.fromkeys(_row(outcome) for outcome in table.compared))
    down = -(-len(values) // 2)
    height = 2.0 * down + 2.2
    figure = new_figure((WIDTH, height), constrained=False)
    panels = np.ravel(figure.subplots(down, 2, squeeze=False, sharex=True))
    figure.subplots_adjust(0.08, 2.1 / height, 0.99, 1 - 0.1 / height, wspace=0.2, hspace=0.12)
    for axes, (label, value) in zip(panels, values.items(), strict=False):
        _draw(axes, table, lambda outcome: rows.index(_row(outcome)), value, "-")
        axes.set_ylabel(label, fontsize=8)
        axes.set_xticks(range(len(rows)), rows, rotation=90, fontsize=6.5)
        axes.tick_params(axis="y", labelsize=7)
    panels[0].legend(fontsize=8)
    return png(figure)


def against_cost(table: TrialTable, label: str, value: Value, costs: Mapping[str, Callable[[Outcome], float]]) -> bytes:
    """A figure of all rows against each cost, a colour a method and a line a family of rows.

    Args:
        costs: by the labels of their axes.
    """
    figure = new_figure((WIDTH, 3.6))
    panels = figure.subplots(1, len(costs), sharey=True)
    for axes, (name, cost) in zip(panels, costs.items(), strict=True):
        _draw(axes, table, cost, value)
        axes.set_xlabel(name)
        _scale(axes, [cost(outcome) for outcome in table.compared])
    panels[0].set_ylabel(label)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    return png(figure)


def _row(outcome: Outcome) -> str:
    return "" if outcome.trial.choice is None else outcome.trial.choice.label


def _draw(axes: Axes, table: TrialTable, place: Callable[[Outcome], float], value: Value, line: str = "") -> None:
    """The rows that have a finite value: a colour a method, and a marker and line a kind of scan, if it is one of its
    own; `line` joins the others."""
    points: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for outcome in table.compared:
        kind = _row(outcome).partition(":")[0] if outcome.trial.facts else ""
        if (of_row := value(outcome)) is not None and math.isfinite(of_row):
            points.setdefault((outcome.trial.method, kind), []).append((place(outcome), of_row))
    kinds = list(dict.fromkeys(kind for _, kind in points))
    for (method, kind), same in points.items():
        style = _KINDS[kinds.index(kind) % len(_KINDS)] + ("-" if kind else line)
        words = f"{method}, {kind}" if kind else method
        axes.plot(*zip(*same, strict=True), style, ms=4, lw=0.8, color=colour_of(method), label=words)
    axes.grid(alpha=0.3)


def colour_of(method: str) -> str:
    """Of a method in pictures, as matplotlib takes it; a method without a line in `COLOURS` has one that is left."""
    others = [name for name in names() if name not in COLOURS]
    return COLOURS[method] if method in COLOURS else _SPARE[others.index(method) % len(_SPARE)]


COLOURS: Mapping[str, str] = {
    "r2": "tab:blue", "r2-published": "navy", "fbp": "0.35", "sirt": "tab:green", "sart": "tab:olive",
    "cgls": "tab:cyan", "asd-pocs": "tab:purple", "fista-tv": "tab:red", "os-sirt-tv": "tab:orange",
    "pnp-dct": "maroon",
    "osem": "gold", "mlem": "teal", "naf": "tab:brown", "intratomo": "rosybrown", "sax-nerf": "darkviolet",
    "series": "darkgreen", "materials": "slateblue",
}  # fmt: skip
_SPARE = ("tab:pink", "black", "sienna", "steelblue", "olivedrab", "orchid")
