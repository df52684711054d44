"""Study: a scan from fewer or averaged views, by some methods, each compared with its volume of all views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from beamline.core.errors import DataError
from beamline.core.events import StudyStarted
from beamline.core.files import REPORT
from beamline.core.sinks import Warn
from beamline.features.trials.dose import taken_scans
from beamline.features.trials.figures import against_cost, figures_of_rows
from beamline.features.trials.layout import Figure, Planned, TableLayout, known
from beamline.features.trials.runner import ComparedScan, opened_scan
from beamline.features.trials.table import TrialTable
from beamline.features.trials.trial import Outcome, Trial
from beamline.features.trials.view_choices import DOSE, SCAN_TIME, Study, ViewChoice, ViewSet
from beamline.projections.prepared import PreparedProjections
from beamline.report.html import Picture
from beamline.report.metrics import METRICS
from beamline.report.sheets import SliceSheet
from recon.assess import metrics
from recon.base.arrays import F32, F64
from recon.base.choices import Filter
from recon.base.method import Plain
from recon.methods import BASELINE, by_name

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


@dataclass(frozen=True)
class StudyOptions:
    """The scan and the study.

    Attributes:
        scan: the study chooses from its views.
        settings: of its methods, by name; methods left out have their own.
        filter: of the FBP of all views.
        draws: how often random views are drawn.
    """

    scan: ComparedScan
    study: Study
    settings: Mapping[str, Mapping[str, Plain]] = field(default_factory=dict)
    filter: Filter = "shepp-logan"
    draws: int = 3

    def trial(self, method: str, choice: ViewChoice) -> Trial:
        """The reconstruction of these views by a method."""
        settings = dict(self.settings.get(method, {}))
        return Trial("method", method, choice.n_views, settings=settings, choice=choice).in_time(self.scan.seconds)


def planned_study(options: StudyOptions, warn: Warn) -> Planned:
    """Read and correct the views, and choose those of each row.

    Raises:
        ConfigError, DataError: nothing was written.
    """
    scan, study = options.scan, options.study
    if study.rows is None:
        data, table, choices = taken_scans(scan, warn)
    else:
        data, table = opened_scan(scan, warn)
        choices = study.rows(_view_set(options, data.prepared))
    n_views = data.geometry.n_views
    outcomes = tuple(
        Outcome(options.trial(method, choice), "not run", message=choice.reason)
        for choice in choices
        for method in scan.methods
    )
    notes = _notes(options, n_views, data.truth is not None)
    by = "psnr" if study.rows is None else "psnr_all"
    table = replace(table, outcomes=outcomes, by=by, notes=notes).with_fact("views to choose from", str(n_views))
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
        if data.truth is not None:
            with suppress(ValueError):  # no contrast
                data = replace(data, regions=metrics.kmeans_mask(metrics.sampled(data.truth), scan.seed))
        return Planned(data, table, layout_of(study), started)
    whole = ViewChoice(REFERENCE, [[view] for view in range(n_views)])
    fbp = Trial("method", BASELINE, n_views, settings={"filter": options.filter}, choice=whole)
    others = (options.trial(method, whole) for method in scan.methods if method != BASELINE)
    data = replace(data, prepared=replace(data.prepared, held_out=None))
    return Planned(data, table, layout_of(study), started, (fbp, *others))


def _view_set(options: StudyOptions, prepared: PreparedProjections) -> ViewSet:
    """The views of a scan that was taken, which rows choose from."""
    geometry = prepared.geometry
    turns = np.stack((geometry.roll, geometry.tilt), axis=1) * max(geometry.detector_shape) / 2
    places = np.concatenate((geometry.shifts, turns), axis=1)
    clear = clearest(np.mod(geometry.angles, geometry.period), prepared.projections.data)
    return ViewSet(geometry.angles, geometry.period, options.scan.seed, options.draws, places, clear)


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


def _notes(options: StudyOptions, n_views: int, truth: bool) -> list[str]:
    notes = (
        [
            "exposure: s of a view. light: of the beam, over the configuration's. scan time: s from the first view to "
            "the end of the last. dose: photons a pixel in the open beam while views are exposed; the shutter is open "
            "in between, too. blur: px at the edge of the field. residual: of standing views that no row has. SNR and "
            "CNR: whole regions of the truth, with their rims."
        ]
        if options.study.rows is None
        else [
            f"PSNR and SSIM of {REFERENCE} are against the volume of {REFERENCE} ({n_views}) by the same method (fbp: "
            f"{options.filter}): they tell what fewer views lose, not which method is better. It has noise of its own, "
            "which rows share as far as they share its views.",
            "SNR and CNR are of the whole dense and empty region, with their rims (k-means of the "
            + ("truth" if truth else f"FBP of {REFERENCE}")
            + "), unlike those of beamline recon; a smoother volume has more.",
        ]
    )
    for method, settings in options.settings.items():
        if settings:
            notes.append(f"{method}: {', '.join(f'{name} {value}' for name, value in settings.items())}.")
    if (seconds := options.scan.seconds) is not None:
        notes.append(f"Each row had {seconds:g} s; direct methods take what they take.")
    if truth and options.study.rows is not None:
        notes.insert(1, "PSNR truth and SSIM truth are against the truth.")
    return notes


def layout_of(study: Study) -> TableLayout:
    """The table of a study: a row for each choice of views and method."""
    return TableLayout(
        "study", REPORT, "rows", study.title, FIGURES, lambda table: [*draws(table), *table.notes], _pictures,
        study.question, {"study": study.name},
    )  # fmt: skip


def _pictures(table: TrialTable, slices: SliceSheet) -> Sequence[tuple[str, Picture]]:
    pictures = []
    if table.compared:
        caption = "What each figure is of is said above. A smoother volume has more SNR and CNR."
        axes = {
            each.short + " (dB)" * bool(METRICS[each.digits_of or each.metric].unit): each.of
            for each in known(table, FIGURES).values()
        }
        pictures.append(("figures.png", Picture("Figures of all rows", caption, figures_of_rows(table, axes))))
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
        pictures.append(("cost.png", Picture("Quality against dose and time", caption, picture)))
    for method in dict.fromkeys(outcome.trial.method for outcome in table.compared):
        caption = f"One slice of every volume by {method}, in one grey window; of repeated draws the first."
        picture = slices.png(slices.labels(method))
        title = f"{by_name(method).label}, slice by slice"
        pictures.append((f"slices_{method}.png", Picture(title, caption, picture)))
    return pictures


def draws(table: TrialTable) -> list[str]:
    """Sentences: mean and range of the figures over the draws of one choice."""
    families: dict[tuple[str, str], list[Outcome]] = {}
    for outcome in table.compared:
        if outcome.trial.choice is not None and outcome.trial.choice.family:
            families.setdefault((outcome.trial.method, outcome.trial.choice.family), []).append(outcome)
    sentences = []
    for (method, family), rows in families.items():
        parts = []
        for figure in known(table, FIGURES).values():
            values = [value for row in rows if (value := figure.of(row)) is not None]
            mean, low, high = (figure.words(float(of(values))) for of in (np.mean, min, max))
            parts.append(f"{figure.short} {mean} ({low} to {high})")
        sentences.append(f"{method}, {family}, mean of {len(rows)}: {', '.join(parts)}.")
    return sentences
