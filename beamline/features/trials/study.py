"""Study: a scan from fewer or averaged views, by some methods, each compared with its volume of all views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from beamline.core.errors import DataError
from beamline.core.events import StudyStarted
from beamline.core.sinks import Warn
from beamline.features.trials.runner import ComparedScan, Planned, opened_scan
from beamline.features.trials.trial import Outcome, Trial
from beamline.features.trials.view_choices import Study, ViewChoice, ViewSet
from recon.base.choices import Filter
from recon.base.method import Plain
from recon.methods import BASELINE

REFERENCE = "all views"


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
    data, table = opened_scan(scan, "study", study.title, warn, held_out=False)
    choices = study.rows(ViewSet(data.geometry.angles, data.geometry.period, scan.seed, draws))
    n_views, given = data.geometry.n_views, settings or {}

    def trial(method: str, choice: ViewChoice) -> Trial:
        own = dict(given.get(method, {}))
        return Trial("method", method, choice.n_views, settings=own, choice=choice).in_time(scan.seconds)

    outcomes = [(trial(method, choice), choice.reason) for choice in choices for method in scan.methods]
    table = replace(
        table,
        outcomes=tuple(Outcome(each, "not run", message=reason) for each, reason in outcomes),
        by="psnr_all",
        question=study.question,
        notes=[_note(n_views, ramp), *_notes_on_methods(given, scan.seconds)],
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
    whole = ViewChoice(REFERENCE, [[view] for view in range(n_views)])
    fbp = Trial("method", BASELINE, n_views, settings={"filter": ramp}, choice=whole)
    others = (trial(method, whole) for method in scan.methods if method != BASELINE)
    data = replace(data, prepared=replace(data.prepared, held_out=None))
    return Planned(data, table, started, (fbp, *others))


def _note(n_views: int, ramp: Filter) -> str:
    return (
        f"PSNR all and SSIM all are against the volume of {REFERENCE} ({n_views}) by the same method (fbp: {ramp}): "
        "they say what fewer views lose, not which method is better. That volume has noise, too, which rows share as "
        "far as they share its views. SNR and CNR are not those of beamline recon; a smoother volume has more."
    )


def _notes_on_methods(settings: Mapping[str, Mapping[str, Plain]], seconds: float | None) -> list[str]:
    words = {method: ", ".join(f"{name} {value}" for name, value in own.items()) for method, own in settings.items()}
    in_time = [] if seconds is None else [f"Each row had {seconds:g} s; direct methods take what they take."]
    return [*(f"{method}: {own}." for method, own in words.items() if own), *in_time]
