"""Pictures of trials: quality against each cost, and slices side by side."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from beamline.features.trials.trial import HELD_OUT, Outcome, TrialTable
from beamline.report.figures import WIDTH, new_figure, png
from beamline.report.html import Picture
from beamline.report.sheets import SliceSheet
from recon.methods import by_name

QUALITY = {
    "psnr": "PSNR (dB)",
    "psnr_all": "PSNR all views (dB)",
    HELD_OUT: "−20 log₁₀ of the held-out residual (dB)",
}
"""Label of the quality by each metric."""
_COSTS: dict[str, Callable[[Outcome], float]] = {
    "time (s)": lambda outcome: outcome.seconds,
    "memory (MB)": lambda outcome: math.nan if outcome.peak_bytes is None else outcome.peak_bytes / 1e6,
    "dose (frames)": lambda outcome: outcome.trial.frames,  # those that several views share are counted once
}  # that a picture shows, by the label of their axis
_SHOWN_DB = 12.0  # below the best; worse trials are drawn at the lower edge
_COLOURS = {"best": "tab:red", "alike": "tab:orange"}  # of frames, by verdict


def pictures(table: TrialTable, slices: SliceSheet) -> Iterator[tuple[str, Picture]]:
    """Quality against each cost, and the slices of baselines or of all rows, by file name."""
    if any(math.isfinite(outcome.quality(table.by)) for outcome in table.compared):
        caption = (
            "Each point is a trial, a colour a method. The line is the best quality at each time. A triangle at the "
            f"lower edge is more than {_SHOWN_DB:g} dB below the best. Trials without a finite quality are not drawn."
        )
        yield "quality.png", Picture("Quality against its costs", caption, quality_plot(table))
    if labels := slices.labels():
        caption = (
            "The same slice by each method with its usual settings, all in the grey window of matter of the first."
        )
        marks = dict[str, tuple[str, str]]()
        if table.asks_best:
            caption = (
                "The middle slice of each trial in one grey window, with its residual; of large ones the part that "
                "changes most. The best has a red frame, those that are no worse but for chance an orange one."
            )
            marks = {each.trial.shown: _mark(table, each) for each in table.compared}
        yield "slices.png", Picture("Slices", caption, slices.png(labels, marks))
    for method in dict.fromkeys(outcome.trial.method for outcome in table.compared if outcome.trial.choice):
        caption = f"One slice of every volume by {method}, in one grey window; of repeated draws the first."
        title = f"{by_name(method).label}, slice by slice"
        yield f"slices_{method}.png", Picture(title, caption, slices.png(slices.labels(method)))


def _mark(table: TrialTable, outcome: Outcome) -> tuple[str, str]:
    """The residual of a trial, and the colour of its frame."""
    score = outcome.metrics.get(table.by)
    return "" if score is None else f"{score:.5g}", _COLOURS.get(outcome.verdict, "")


def quality_plot(table: TrialTable) -> bytes:
    """Quality against time, memory and dose as PNG: a colour a method, and a line along the front of time."""
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
    panels[0].set_ylabel(QUALITY[table.by])
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=8)
    return png(figure)
