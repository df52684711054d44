"""Study: a scan from fewer or averaged views, by some methods, each compared with its volume of all views."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from beamline.core.errors import DataError
from beamline.core.events import Sink, StudyStarted
from beamline.core.files import REPORT
from beamline.core.machine import machine
from beamline.core.sinks import Warn
from beamline.features.trials.figures import against_cost, figures_of_rows
from beamline.features.trials.front import dose_columns
from beamline.features.trials.launch import TrialData
from beamline.features.trials.layout import TableColumn, TableLayout, metric_column, records
from beamline.features.trials.runner import ComparedScan, Planned, RunLimits, opened_scan, run_comparison
from beamline.features.trials.table import TrialTable
from beamline.features.trials.trial import Outcome, Trial
from beamline.features.trials.view_choices import Study, ViewChoice, ViewSet
from beamline.report.html import Picture
from beamline.report.metrics import METRICS, Metric
from beamline.report.sheets import SliceSheet
from drivers.base.clock import Clock
from recon.base.choices import Filter
from recon.base.method import Plain
from recon.methods import BASELINE, by_name

REFERENCE = "all views"
_FIGURES = {
    "psnr_all": ("PSNR all views", "psnr"), "ssim_all": ("SSIM all views", "ssim3d"),
    "psnr_truth": ("PSNR truth", "psnr"),
    "ssim_truth": ("SSIM truth", "ssim3d"), "snr": ("SNR rims", "snr"), "cnr": ("CNR rims", "cnr"),
}  # fmt: skip
"""Heading, and the metric that says how many digits it has, by name in files."""
_MEASURED = {"psnr_truth": "psnr", "ssim_truth": "ssim3d"}  # names of metrics against the truth where trials end


@dataclass(frozen=True)
class StudyOptions:
    """The scan and the study.

    Attributes:
        scan: the study chooses from its views.
        methods: names in `recon.methods`.
        settings: of these methods, by name; methods left out have their own.
        seconds: of each row, the same for all methods; None: methods end when their work is done.
        filter: of the FBP of all views.
        draws: how often random views are drawn.
    """

    scan: ComparedScan
    study: Study
    methods: Sequence[str]
    settings: Mapping[str, Mapping[str, Plain]] = field(default_factory=dict)
    seconds: float | None = None
    filter: Filter = "shepp-logan"
    draws: int = 3
    seed: int = 0
    command: str = ""


def run_study(options: StudyOptions, sink: Sink, clock: Clock, now: Callable[[], float] = time.monotonic) -> TrialTable:
    """Run all rows of a study, see `run_comparison`."""
    limits = RunLimits(options.scan.folder, options.seed)
    return run_comparison(partial(planned_study, options), limits, sink, clock, now)


def planned_study(options: StudyOptions, warn: Warn) -> tuple[TrialData, Planned]:
    """Read and correct the views, and choose those of each row.

    Raises:
        ConfigError, DataError: nothing was written.
    """
    path, opened = options.scan.source.path, opened_scan(options.scan, warn)
    prepared, truth = opened.prepared, opened.truth is not None
    geometry = prepared.geometry
    turns = np.stack((geometry.roll, geometry.tilt), axis=1) * max(geometry.detector_shape) / 2
    places = np.concatenate((geometry.shifts, turns), axis=1)
    choices = options.study.rows(ViewSet(geometry.angles, geometry.period, options.seed, options.draws, places))
    table = TrialTable(
        tuple(_row(choice, method, options) for choice in choices for method in options.methods),
        "psnr_all",
        prepared.length_unit,
        machine(),
        {**opened.facts, "views to choose from": str(geometry.n_views)},
        options.command,
        light=opened.light,
        notes=_notes(options, geometry.n_views, truth),
    )
    if not table.todo:
        raise DataError(
            f"{path}: {geometry.n_views} views are too few for any row of {options.study.name}: "
            f"left out: {choices[-1].reason}. Take a scan with more views."
        )
    for choice in choices:
        if choice.groups is None:
            warn(f"{choice.label} is left out: {choice.reason}")
    whole = ViewChoice(REFERENCE, [[view] for view in range(geometry.n_views)])
    fbp = Trial("method", BASELINE, geometry.n_views, settings={"filter": options.filter}, choice=whole)
    others = (
        Trial("method", method, geometry.n_views, settings=dict(options.settings.get(method, {})), choice=whole)
        for method in options.methods
        if method != BASELINE
    )
    references = (fbp, *(trial.in_time(options.seconds) for trial in others))
    data = TrialData(replace(prepared, held_out=None), opened.truth)
    started = StudyStarted(path, len(table.todo), len(table.outcomes) - len(table.todo), options.study.name)
    return data, Planned(table, layout_of(options.study), started, references)


def _row(choice: ViewChoice, method: str, options: StudyOptions) -> Outcome:
    """A row before it is done."""
    trial = Trial("method", method, choice.n_views, settings=dict(options.settings.get(method, {})), choice=choice)
    return Outcome(trial.in_time(options.seconds), "not run", message=choice.reason)


def _notes(options: StudyOptions, n_views: int, truth: bool) -> list[str]:
    notes = [
        f"PSNR and SSIM of {REFERENCE} are against the volume of {REFERENCE} ({n_views}) by the same method (fbp: "
        f"{options.filter}): they tell what fewer views lose, not which method is better. It has noise of its own, "
        "which rows share as far as they share its views.",
        "SNR and CNR are of the whole dense and empty region, with their rims (k-means of the "
        + ("truth" if truth else f"FBP of {REFERENCE}")
        + "), unlike those of beamline recon; a smoother volume has more.",
    ]
    for method, settings in options.settings.items():
        if settings:
            notes.append(f"{method}: {', '.join(f'{name} {value}' for name, value in settings.items())}.")
    if options.seconds is not None:
        notes.append(f"Each row had {options.seconds:g} s; direct methods take what they take.")
    if truth:
        notes.insert(1, "PSNR truth and SSIM truth are against the truth.")
    return notes


def layout_of(study: Study) -> TableLayout:
    """The table of a study: a row for each choice of views and method."""
    return TableLayout(
        "study", REPORT, "rows", study.title, lambda outcome: (_choice(outcome).label, outcome.trial.method), _columns,
        lambda table: [*draws(table), *table.notes],
        lambda table: {"study": study.name, "notes": list(table.notes), "rows": records(table, layout_of(study))},
        _pictures, study.question,
    )  # fmt: skip


def _columns(table: TrialTable) -> Sequence[TableColumn]:
    timed, shown = table.timed, names(table)
    return [
        TableColumn("row", lambda o: _choice(o).label),
        TableColumn("method", lambda o: o.trial.method),
        TableColumn("views", lambda o: o.trial.views),
        TableColumn("window", lambda o: _choice(o).window),
        TableColumn("frames", lambda o: o.trial.frames),
        *dose_columns(table),
        TableColumn("status", lambda o: o.status),
        TableColumn("seconds_asked", lambda o: o.trial.seconds_asked, "s asked" * timed, "s asked", 9, _asked),
        TableColumn("seconds", lambda o: o.seconds, "s" * timed, "s", shown=lambda o: f"{o.seconds:.1f}"),
        TableColumn("cpu_seconds", lambda o: o.cpu_seconds, "CPU s", "CPU s", shown=lambda o: f"{o.cpu_seconds:.1f}"),
        TableColumn("reached", lambda o: o.reached, "reached" * timed, "reached", 0, lambda o: o.reached),
        *(_figure(name, name in shown) for name in _FIGURES),
        TableColumn("message", lambda o: o.message),
    ]


def _pictures(table: TrialTable, slices: SliceSheet) -> Sequence[tuple[str, Picture]]:
    pictures, figures = [], names(table)
    if table.compared:
        caption = "What each figure is of is said above. A smoother volume has more SNR and CNR."
        axes = {name: _FIGURES[name][0] + " (dB)" * bool(_metric(name).unit) for name in figures}
        picture = figures_of_rows(table, {axes[name]: partial(value_of, name) for name in figures})
        pictures.append(("figures.png", Picture("Figures of all rows", caption, picture)))
        first = "psnr_truth" if "psnr_truth" in figures else figures[0]
        caption = "Each frame of the scan has the same dose; one that several views share is counted once."
        picture = against_cost(table, axes[first], partial(value_of, first))
        pictures.append(("cost.png", Picture("Quality against dose and time", caption, picture)))
    for method in dict.fromkeys(outcome.trial.method for outcome in table.compared):
        caption = f"One slice of every volume by {method}, in one grey window; of repeated draws the first."
        picture = slices.png(slices.labels(method))
        title = f"{by_name(method).label}, slice by slice"
        pictures.append((f"slices_{method}.png", Picture(title, caption, picture)))
    return pictures


def _choice(outcome: Outcome) -> ViewChoice:
    assert outcome.trial.choice is not None
    return outcome.trial.choice


def value_of(name: str, outcome: Outcome) -> float | None:
    """A figure of a row; None where it is not known."""
    return outcome.metrics.get(_MEASURED.get(name, name))


def names(table: TrialTable) -> list[str]:
    """Figures that any row has."""
    return [name for name in _FIGURES if any(value_of(name, outcome) is not None for outcome in table.outcomes)]


def _metric(name: str) -> Metric:
    return METRICS[_FIGURES[name][1]]


def formatted(name: str, value: float) -> str:
    """A figure with its digits; "equal" for the PSNR of two equal volumes."""
    metric = _metric(name)
    if math.isfinite(value):
        return f"{value:.{metric.digits}f}"
    return "equal" if metric is METRICS["psnr"] and value > 0 else "undefined"


def _figure(name: str, shown: bool) -> TableColumn:
    heading = _FIGURES[name][0]

    return metric_column(name, partial(value_of, name), partial(formatted, name), heading * shown, heading, 12)


def _asked(outcome: Outcome) -> str:
    seconds = outcome.trial.seconds_asked
    return "–" if seconds is None else f"{seconds:g}"


def draws(table: TrialTable) -> list[str]:
    """Sentences: mean and range of the figures over the draws of one choice."""
    sentences = []
    families = dict.fromkeys((_choice(o).family, o.trial.method) for o in table.compared if _choice(o).family)
    for family, method in families:
        rows = [o for o in table.compared if (_choice(o).family, o.trial.method) == (family, method)]
        parts = []
        for name in names(table):
            values = [value for o in rows if (value := value_of(name, o)) is not None]
            low, high = formatted(name, min(values)), formatted(name, max(values))
            parts.append(f"{_FIGURES[name][0]} {formatted(name, float(np.mean(values)))} ({low} to {high})")
        sentences.append(f"{method}, {family}, mean of {len(rows)}: {', '.join(parts)}.")
    return sentences
