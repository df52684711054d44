"""Study: a scan from fewer or averaged views, by some methods, each compared with its volume of all views."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from beamline.core.errors import DataError
from beamline.core.events import StudyStarted
from beamline.core.files import REPORT
from beamline.core.sinks import Warn
from beamline.features.trials.dose import taken_scans
from beamline.features.trials.front import colour_of, scale
from beamline.features.trials.launch import ComparedScan, opened_scan
from beamline.features.trials.layout import Figure, Planned, TableLayout, known
from beamline.features.trials.trial import Outcome, Trial, TrialTable
from beamline.features.trials.view_choices import DOSE, SCAN_TIME, Study, ViewChoice, ViewSet
from beamline.projections.prepared import PreparedProjections
from beamline.report.figures import WIDTH, new_figure, png
from beamline.report.html import Picture
from beamline.report.metrics import METRICS
from beamline.report.sheets import SliceSheet
from recon.base.arrays import F32, F64
from recon.base.choices import Filter
from recon.base.method import Plain
from recon.methods import BASELINE, by_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes

REFERENCE = "all views"
FIGURES = {
    "psnr_all": Figure("psnr_all", "PSNR all views", digits_of="psnr"),
    "ssim_all": Figure("ssim_all", "SSIM all views", digits_of="ssim3d"),
    "psnr_truth": Figure("psnr", "PSNR truth"),
    "ssim_truth": Figure("ssim3d", "SSIM truth"),
    "snr": Figure("snr", "SNR rims"),
    "cnr": Figure("cnr", "CNR rims"),
    "residual_held_out": Figure("residual_held_out", "residual"),
}
"""By name in files."""


Value = Callable[[Outcome], float | None]
_KINDS = "os^vD"  # markers of kinds of scans


def planned_study(
    scan: ComparedScan,
    study: Study,
    warn: Warn,
    settings: Mapping[str, Mapping[str, Plain]] | None = None,
    ramp: Filter = "shepp-logan",
    draws: int = 3,
) -> Planned:
    """Read and correct the views, and choose those of each row.

    Args:
        scan: the study chooses from its views.
        settings: of its methods, by name; methods left out have their own.
        ramp: filter of the FBP of all views.
        draws: how often random views are drawn.

    Raises:
        ConfigError, DataError: nothing was written.
    """
    if study.rows is None:
        data, table, choices = taken_scans(scan, warn)
    else:
        data, table = opened_scan(scan, warn)
        choices = study.rows(_view_set(scan.seed, draws, data.prepared))
    n_views, given = data.geometry.n_views, settings or {}

    def trial(method: str, choice: ViewChoice) -> Trial:
        its_own = dict(given.get(method, {}))
        return Trial("method", method, choice.n_views, settings=its_own, choice=choice).in_time(scan.seconds)

    outcomes = [(trial(method, choice), choice.reason) for choice in choices for method in scan.methods]
    table = replace(
        table,
        outcomes=tuple(Outcome(each, "not run", message=reason) for each, reason in outcomes),
        by="psnr" if study.rows is None else "psnr_all",
        notes=[*_notes(study, n_views, ramp, data.truth is not None), *_notes_on_methods(given, scan.seconds)],
        scan={**table.scan, "views to choose from": str(n_views)},
    )
    if not table.todo:
        raise DataError(
            f"{scan.source.path}: {n_views} views are too few for any row of {study.name}: "
            f"left out: {choices[-1].reason}. Take a scan with more views."
        )
    for choice in choices:
        if choice.groups is None:
            warn(f"{choice.label} is left out: {choice.reason}")
    left_out = len(table.outcomes) - len(table.todo)
    started = StudyStarted(scan.source.path, len(table.todo), left_out, study.name)
    if study.rows is None:
        return Planned(data, table, layout_of(study), started)
    whole = ViewChoice(REFERENCE, [[view] for view in range(n_views)])
    fbp = Trial("method", BASELINE, n_views, settings={"filter": ramp}, choice=whole)
    others = (trial(method, whole) for method in scan.methods if method != BASELINE)
    data = replace(data, prepared=replace(data.prepared, held_out=None))
    return Planned(data, table, layout_of(study), started, (fbp, *others))


def _view_set(seed: int, draws: int, prepared: PreparedProjections) -> ViewSet:
    """The views of a scan that was taken, which rows choose from."""
    geometry = prepared.geometry
    turns = np.stack((geometry.roll, geometry.tilt), axis=1) * max(geometry.detector_shape) / 2
    places = np.concatenate((geometry.shifts, turns), axis=1)
    clear = clearest(np.mod(geometry.angles, geometry.period), prepared.projections.data)
    return ViewSet(geometry.angles, geometry.period, seed, draws, places, clear)


def clearest(angles: F64, lines: F32) -> int:
    """The middle, in degrees, of the 40 degrees in which the densest hundredth of a view's rays meets least matter.

    Args:
        angles: [view], radians within half a turn.
        lines: [view, row, col].
    """
    dense = np.array([np.percentile(view[:: max(1, len(view) // 16)], 99) for view in lines])
    middles = np.arange(20, 161)
    near = np.abs(np.degrees(angles) - middles[:, None]) <= 20
    counts = near.sum(axis=1)
    means = np.divide(near @ dense, counts, out=np.full(middles.size, np.inf), where=counts > 0)
    return int(middles[np.argmin(means)])


def _notes(study: Study, n_views: int, ramp: Filter, truth: bool) -> list[str]:
    if study.rows is None:
        return [
            "exposure: s of a view. light: of the beam, over the configuration's. scan time: s from the first view to "
            "the end of the last. dose: photons a pixel in the open beam while views are exposed; the shutter is open "
            "in between, too. blur: px at the edge of the field. residual: of standing views that no row has. SNR and "
            "CNR: whole regions of the truth, with their rims."
        ]
    return [
        f"PSNR and SSIM of {REFERENCE} are against the volume of {REFERENCE} ({n_views}) by the same method (fbp: "
        f"{ramp}): they tell what fewer views lose, not which method is better. It has noise of its own, "
        "which rows share as far as they share its views.",
        *(["PSNR truth and SSIM truth are against the truth."] if truth else []),
        "SNR and CNR are of the whole dense and empty region, with their rims (k-means of the "
        f"{'truth' if truth else f'FBP of {REFERENCE}'}), unlike those of beamline recon; a smoother volume has more.",
    ]


def _notes_on_methods(settings: Mapping[str, Mapping[str, Plain]], seconds: float | None) -> list[str]:
    told = {method: ", ".join(f"{name} {value}" for name, value in own.items()) for method, own in settings.items()}
    in_time = [] if seconds is None else [f"Each row had {seconds:g} s; direct methods take what they take."]
    return [*(f"{method}: {words}." for method, words in told.items() if words), *in_time]


def layout_of(study: Study) -> TableLayout:
    """The table of a study: a row for each choice of views and method."""
    return TableLayout(
        "study", REPORT, "rows", study.title, FIGURES, lambda table: [*draws(table), *table.notes], _pictures,
        study.question, {"study": study.name},
    )  # fmt: skip


def _pictures(table: TrialTable, slices: SliceSheet) -> Iterator[tuple[str, Picture]]:
    if table.compared:
        caption = "What each figure is of is said above. A smoother volume has more SNR and CNR."
        axes = {
            each.short + " (dB)" * bool(METRICS[each.digits_of or each.metric].unit): each.of
            for each in known(table, FIGURES).values()
        }
        yield "figures.png", Picture("Figures of all rows", caption, figures_of_rows(table, axes))
        caption = "Each frame of the scan has the same dose; one that several views share is counted once."
        dose = table.dose
        costs = {dose.axis: lambda o: dose.of(o) * dose.scale, "processor time (s)": lambda o: o.cpu_seconds}
        if any(o.trial.facts for o in table.compared):
            caption = "A line joins the plans of a kind and method, from many views to few."
            costs = {
                "dose (photons a pixel)": lambda o: o.trial.facts[DOSE],
                "scan time (s)": lambda o: o.trial.facts[SCAN_TIME],
            }
        first = next((axis for axis in axes if axis.startswith("PSNR truth")), next(iter(axes)))
        picture = against_cost(table, first, axes[first], costs)
        yield "cost.png", Picture("Quality against dose and time", caption, picture)
    for method in dict.fromkeys(outcome.trial.method for outcome in table.compared):
        caption = f"One slice of every volume by {method}, in one grey window; of repeated draws the first."
        title = f"{by_name(method).label}, slice by slice"
        yield f"slices_{method}.png", Picture(title, caption, slices.png(slices.labels(method)))


def draws(table: TrialTable) -> Iterator[str]:
    """Sentences: mean and range of the figures over the draws of one choice."""
    families: dict[tuple[str, str], list[Outcome]] = {}
    for outcome in table.compared:
        if outcome.trial.choice is not None and outcome.trial.choice.family:
            families.setdefault((outcome.trial.method, outcome.trial.choice.family), []).append(outcome)
    for (method, family), rows in families.items():
        parts = []
        for figure in known(table, FIGURES).values():
            values = [value for row in rows if (value := figure.of(row)) is not None]
            mean, low, high = (figure.words(float(of(values))) for of in (np.mean, min, max))
            parts.append(f"{figure.short} {mean} ({low} to {high})")
        yield f"{method}, {family}, mean of {len(rows)}: {', '.join(parts)}."


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
        scale(axes, [cost(outcome) for outcome in table.compared])
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
