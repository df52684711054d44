"""Trade-off and studies: makes the lists of trials that they compare.

The registry of methods lists the numbers of iterations that are tried for a method. A method without such a list is
tried with its defaults.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import Literal

from beamline.core.errors import DataError
from beamline.core.events import Sink
from beamline.core.sinks import Warnings
from beamline.features.trials.runner import ComparedScan, Planned, opened_scan, with_references
from beamline.features.trials.trial import MethodTrial, Outcome
from beamline.features.trials.view_choices import Study, ViewChoice, ViewSet
from drivers.base.clock import Clock
from recon.base.choices import Filter
from recon.base.method import Plain
from recon.methods import BASELINE, METHODS, names_compared

REFERENCE = "all views"


def planned_study(
    scan: ComparedScan,
    study: Study,
    sink: Sink,
    clock: Clock,
    settings: Mapping[str, Mapping[str, Plain]] | None = None,
    ramp: Filter = "hann",
    draws: int = 3,
) -> Planned:
    """Read and correct the projections, and select those of each row.

    Args:
        scan: the scan from whose projections the study selects.
        settings: settings of the methods, by the name of the method. A method without an entry uses its defaults.
        ramp: filter of each FBP, for the rows and for the volume from all projections.
        draws: number of random selections.

    Raises:
        ConfigError, DataError: nothing was written.
    """
    data, table = opened_scan(scan, "study", study.title, sink, clock, held_out=False)
    choices = study.rows(ViewSet(data.geometry.angles, data.geometry.period, scan.seed, draws))
    n_views, own_settings = data.geometry.n_views, dict(settings or {})
    own_settings[BASELINE] = {"filter": ramp, **own_settings.get(BASELINE, {})}

    def trial(method: str, choice: ViewChoice) -> MethodTrial:
        own = dict(own_settings.get(method, {}))
        return MethodTrial("method", method, choice.n_views, settings=own, choice=choice).in_time(scan.seconds)

    outcomes = [(trial(method, choice), choice.reason) for choice in choices for method in scan.methods]
    table = replace(
        table,
        outcomes=tuple(Outcome(each, "not run", message=reason) for each, reason in outcomes),
        by="psnr_all",
        question=study.question,
        notes=[_note(n_views), *_notes_on_methods({m: own_settings.get(m, {}) for m in scan.methods}, scan.seconds)],
        scan={**table.scan, "views to choose from": str(n_views)},
    )
    if not table.todo:
        last_reason = choices[-1].reason
        raise DataError(
            f"{scan.source.path}: {n_views} projections are too few for the study {study.name}, because no row of its "
            f"table can be computed (reason for the last row: {last_reason}). Use a scan with more projections."
        )
    warn = Warnings(sink, clock)
    for choice in choices:
        if choice.groups is None:
            warn(f"{choice.label} is left out: {choice.reason}")
    whole = ViewChoice(REFERENCE, [[view] for view in range(n_views)])
    references = tuple(trial(method, whole) for method in dict.fromkeys((BASELINE, *scan.methods)))
    data = replace(data, views=data.views.seen)
    return Planned(partial(with_references, data, references), table)


def _note(n_views: int) -> str:
    return (
        "PSNR all and SSIM all compare each volume with the volume that the same method and settings make of "
        f"{REFERENCE} ({n_views}). Both values show how much is lost with fewer projections, not which method is "
        "better. The values of PSNR and SSIM are too high, because the two volumes share projections, and therefore "
        "share some noise. A smoother volume has higher SNR and CNR."
    )


def _notes_on_methods(settings: Mapping[str, Mapping[str, Plain]], seconds: float | None) -> list[str]:
    words = {method: ", ".join(f"{name} {value}" for name, value in own.items()) for method, own in settings.items()}
    in_time = (
        []
        if seconds is None
        else [f"Each reconstruction had {seconds:g} s; methods without iterations took as long as they need."]
    )
    return [*(f"{method}: {own}." for method, own in words.items() if own), *in_time]


Depth = Literal["quick", "full"]

_SHARES: Mapping[Depth, tuple[float, ...]] = {"quick": (0.5,), "full": (0.25, 0.5)}


def planned_tradeoff(scan: ComparedScan, sink: Sink, clock: Clock, depth: Depth = "quick") -> Planned:
    """Read and correct the projections, hold some out if there is no ground truth, and plan the trials.

    Raises:
        ConfigError, DataError: nothing was written.
    """
    data, table = opened_scan(scan, "tradeoff", "What accuracy costs", sink, clock, held_out=True)
    geometry = data.geometry
    methods = scan.methods or names_compared()
    if scan.seconds is None:
        trials = plan(methods, geometry.n_views, depth)
    else:
        trials = plan_in_equal_time(methods, geometry.n_views, scan.seconds)
    table = replace(
        table,
        outcomes=tuple(Outcome(trial, "not run") for trial in trials),
        scan={**table.scan, "views used": str(geometry.n_views)},
        asks_costs=True,
        page="tradeoff.html",
    )
    return Planned(lambda run: data, table)


def trials_of(method: str, n_views: int, depth: Depth) -> list[MethodTrial]:
    """The trials that use all projections, the baseline first.

    Args:
        depth: "quick" has fewer trials, and shorter ones.
    """
    if (lengths := METHODS[method].lengths) is None:
        return [MethodTrial("method", method, n_views)]
    base, *others = (dict[str, Plain]({lengths.setting: length}) for length in getattr(lengths, depth))
    varied = [MethodTrial(lengths.setting, method, n_views, settings=each) for each in others]
    return [MethodTrial("method", method, n_views, settings=base), *varied]


def plan(methods: Sequence[str], n_views: int, depth: Depth) -> tuple[MethodTrial, ...]:
    """The list of trials. For each method, the baseline comes first; each further trial changes a single setting of the
    baseline.

    Args:
        methods: names in `recon.methods`, in the order wanted.
        depth: "quick" makes about half as many trials as "full", and each trial is shorter.

    Raises:
        ValueError: a method does not exist.
    """
    counts = sorted({max(2, round(share * n_views)) for share in _SHARES[depth]} - {n_views})
    tried = [trials_of(method, n_views, depth) for method in methods]
    fewer = [[replace(base, group="views", views=n) for n in counts] + others for base, *others in tried]
    return tuple(dict.fromkeys([*(base for base, *_ in tried), *chain(*fewer)]))


def plan_in_equal_time(methods: Sequence[str], n_views: int, seconds: float) -> tuple[MethodTrial, ...]:
    """One trial for each method, all with the same time limit."""
    return tuple(trials_of(method, n_views, "quick")[0].in_time(seconds) for method in methods)
