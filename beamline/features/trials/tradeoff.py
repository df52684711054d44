"""Trade-off: which trials it compares, of one volume, of volumes in time or of several energies.

The registry of methods says which lengths of a method are tried; one without is tried with its defaults.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Literal

import numpy as np

from beamline.core.durations import MachineSpeed
from beamline.core.errors import ConfigError
from beamline.core.events import TradeoffStarted
from beamline.core.files import refuse_existing
from beamline.core.sinks import Warn
from beamline.energies import EnergyScans, prepare_energies, views_of
from beamline.features.trials.front import TRADEOFF
from beamline.features.trials.launch import ComparedScan, TrialData, opened_scan, table_of
from beamline.features.trials.layout import Planned
from beamline.features.trials.runner import Expected, expected_seconds
from beamline.features.trials.trial import Outcome, Trial, TrialTable
from beamline.projections.prepared import with_views_held_out
from beamline.reconstruct.plan import times_of
from beamline.reconstruct.scan_facts import facts_of
from recon.base.empirical import ONE_IN
from recon.base.kernel import Kernel
from recon.base.method import Plain
from recon.features.joint.methods import EnergySeries
from recon.features.joint.series import refuse_few
from recon.methods import METHODS, by_name, has_setting, names_compared
from recon.splatting.initialise import default_count
from recon.splatting.r2 import R2
from recon.splatting.settings import FitSettings

Depth = Literal["quick", "full"]

_WITH_JOINT = ("fbp", "fista-tv", "r2")  # beside joint fits, where no methods are named
_LEAST_OF_PART = 6  # views
_SHARES: Mapping[Depth, tuple[float, ...]] = {"quick": (0.5,), "full": (0.25, 0.5)}
_BASE_STEPS = {"quick": 250, "full": 1000}
_STEPS = {"quick": (60, 125, 250, 500), "full": (125, 250, 500, 1000, 2000)}
_FACTORS = {"quick": (0.25,), "full": (0.25, 0.5, 2.0)}
_BINNED_STEPS = {"quick": (250,), "full": (125, 500, 1000)}


def planned_tradeoff(
    scan: ComparedScan,
    warn: Warn,
    depth: Depth = "quick",
    volumes: int = 0,
    scans: EnergyScans | None = None,
    states: Sequence[str] = (),
) -> Planned:
    """Read and correct the views, hold some out, and plan the trials.

    Args:
        volumes: that views show in time, to compare a fit of all of them; 0: none.
        scans: all scans at several energies, the one compared first, and their cross sections; None: it has one.
        states: names of two materials that are two states of the same one; empty: no such pair.

    Raises:
        ConfigError, DataError: nothing was written.
    """
    if scans is not None:
        data, table, trials = _of_energies(scan, scans, states, warn)
    elif volumes:
        data, table, trials = _in_time(scan, volumes, warn)
    else:
        data, table, trials = _of_one_volume(scan, depth, warn)
    if scan.max_seconds is not None:
        trials = telling_first(trials)
    by = "psnr" if data.truth is not None else "residual_held_out"
    table = replace(table, outcomes=tuple(Outcome(trial, "not run") for trial in trials), by=by)
    return Planned(data, table, TRADEOFF, TradeoffStarted(scan.source.path, len(trials), by))


Comparison = tuple[TrialData, TrialTable, Sequence[Trial]]


def _of_one_volume(scan: ComparedScan, depth: Depth, warn: Warn) -> Comparison:
    data, table = opened_scan(scan, warn, "give --truth")
    n, start = data.geometry.n_views, default_count(data.geometry, data.geometry.sample_pitch)
    methods = scan.methods or names_compared(data.prepared.emission is not None)
    trials = (
        quick_first(plan(methods, n, start, depth), expected_seconds(data.geometry, MachineSpeed()))
        if scan.seconds is None
        else plan_in_equal_time(methods, n, start, scan.seconds)
    )
    return data, replace(table, scan={**table.scan, "views used": str(n)}), trials


def _in_time(scan: ComparedScan, volumes: int, warn: Warn) -> Comparison:
    data, table = opened_scan(scan, warn, "leave out --time")
    held, n = data.prepared, data.geometry.n_views
    if held.emission is not None:
        raise ConfigError(f"--time: {scan.source.path} is of an emission. Leave it out. Nothing was written.")
    try:
        refuse_few(volumes, n)
    except ValueError as error:
        raise ConfigError(f"--time {volumes}: {error}. Nothing was written.") from error
    with scan.source.open() as source:
        unseen = held.projections.view_ids[:0] if held.held_out_ids is None else held.held_out_ids
        seconds = times_of(source, np.concatenate((held.projections.view_ids, unseen)), warn)
    begun = seconds - seconds.min()
    start = default_count(held.geometry, held.geometry.sample_pitch)
    trials = plan_in_time(scan.methods or _WITH_JOINT, n, start, volumes)
    table = replace(table, scan={**table.scan, "views used": f"{n}, over {np.ptp(seconds):.4g} s"})
    return TrialData(replace(held, times=begun[:n]), None, begun[n:]), table, trials


def _of_energies(scan: ComparedScan, scans: EnergyScans, states: Sequence[str], warn: Warn) -> Comparison:
    refuse_existing(scan.folder)
    names = scans.spectra.names
    try:
        two_states = EnergySeries(names, tuple(states)).states
    except ValueError as error:
        raise ConfigError(f"--states: {error} of {scans.spectra.path}. Nothing was written.") from error
    prepared = prepare_energies(scans, scan.selection, warn)
    views = views_of(prepared)
    weighted = replace(prepared.projections, weights=views.weight)  # also of the views held out
    prepared = replace(prepared, projections=weighted, shares=None)
    energies = len(views.cross_sections)
    unseen = np.flatnonzero(views.parted(ONE_IN) == ONE_IN // 2)
    data = TrialData(with_views_held_out(prepared, unseen), None, views.energy[unseen].astype(np.float64))
    geometry, used = data.geometry, data.geometry.n_views
    start = default_count(geometry, geometry.sample_pitch)
    trials = plan_of_energies(scan.methods or _WITH_JOINT, used, start, energies, names, two_states)
    with scan.source.open() as source:
        facts = dict(facts_of(source).table)
    facts |= {"energies": str(energies), "materials": ", ".join(names), "views used": str(used)}
    return data, table_of(scan, facts, data.prepared), trials


def trials_of(method: str, n_views: int, gaussians: int, depth: Depth) -> list[Trial]:
    """The settings that are tried on all views, the baseline first.

    Args:
        gaussians: how many a fit starts from by default.
        depth: "quick" has fewer trials, and shorter ones.
    """
    if (lengths := METHODS[method].lengths) is None:
        fits = issubclass(by_name(method), R2)
        return _fits(method, n_views, gaussians, depth) if fits else [Trial("method", method, n_views)]
    tried: Sequence[int] = getattr(lengths, depth)
    fixed: dict[str, Plain] = {"gaussians": gaussians} if has_setting(by_name(method), "gaussians") else {}
    settings = [{lengths.setting: length, **fixed} for length in tried]
    base, *others = [{}, *settings] if lengths.chosen else settings
    varied = [Trial(lengths.setting, method, n_views, settings=each) for each in others]
    return [Trial("method", method, n_views, settings=base), *varied]


def _fits(method: str, n_views: int, gaussians: int, depth: Depth) -> list[Trial]:
    usual: dict[str, Plain] = {"steps": _BASE_STEPS[depth], "gaussians": gaussians}
    # A bin of two halves the detail across: a quarter of the Gaussians describes it.
    coarse = max(1, gaussians // 4)
    changes: list[tuple[str, Mapping[str, Plain]]] = [
        ("method", {}),
        *(("steps", {"steps": n}) for n in _STEPS[depth] if n != usual["steps"]),
        *(("gaussians", {"gaussians": max(1, round(factor * gaussians))}) for factor in _FACTORS[depth]),
        *(("binning", {"steps": n, "gaussians": coarse}) for n in _BINNED_STEPS[depth]),
        *(("kernel", {"fit.kernel": kernel.value}) for kernel in Kernel if kernel is not FitSettings().kernel),
        ("start", {"start": "tv"}),
        ("loss", {"fit.ssim_weight": 0.0}),
        *(("loss", {"fit.loss": loss}) for loss in ("l2", "poisson")),
        ("rectification", {"fit.rays.rectified": False}),
    ]
    return [
        Trial(group, method, n_views, 2 if group == "binning" else 1, {**usual, **changed})
        for group, changed in changes
    ]


def plan(methods: Sequence[str], n_views: int, gaussians: int, depth: Depth) -> tuple[Trial, ...]:
    """The trials, one setting varied at a time about each method's baseline; baselines first.

    Args:
        methods: names in `recon.methods`, in the order wanted.
        gaussians: how many a fit would start from by itself.
        depth: "quick" has about half as many trials as "full", and shorter ones.

    Raises:
        ValueError: for a method that there is not.
    """
    counts = sorted({max(2, round(share * n_views)) for share in _SHARES[depth]} - {n_views})
    tried = [trials_of(method, n_views, gaussians, depth) for method in methods]
    fewer = [[replace(base, group="views", views=n) for n in counts] + others for base, *others in tried]
    return tuple(dict.fromkeys([*(replace(base, halves=True) for base, *_ in tried), *chain(*fewer)]))


def quick_first(trials: Sequence[Trial], expected: Expected) -> tuple[Trial, ...]:
    """The trials with baselines first, then those that take least time, and those whose time is not known."""
    baselines = [trial for trial in trials if trial.group == "method"]
    varied = [trial for trial in trials if trial.group != "method"]
    return *baselines, *sorted(varied, key=lambda trial: expected(trial) or math.inf)


def plan_in_equal_time(methods: Sequence[str], n_views: int, gaussians: int, seconds: float) -> tuple[Trial, ...]:
    """Each method once, all with the same time."""
    return tuple(base.in_time(seconds) for base in _baselines(methods, n_views, gaussians))


def telling_first(trials: Sequence[Trial]) -> tuple[Trial, ...]:
    """The trials in an order for little time: each method once, direct ones first, without half-set resolutions.

    These take two more reconstructions each, and say less than one of another method.
    """
    once = [replace(trial, halves=False) for trial in trials]
    alone = sorted((t for t in once if t.group == "method"), key=lambda t: not by_name(t.method).traits.direct)
    return tuple(dict.fromkeys([*alone, *once]))


def plan_in_time(methods: Sequence[str], n_views: int, gaussians: int, volumes: int) -> tuple[Trial, ...]:
    """Each method ignoring time, then of parts of the views; one fit of so many volumes."""
    alone = _baselines(methods, n_views, gaussians)
    numbers = sorted({n for n in (2, volumes, 2 * volumes) if n_views // n >= _LEAST_OF_PART})
    jointly = Trial("one fit", "series", n_views, settings={"volumes": volumes})
    return *alone, *(replace(base, group="parts", parts=n) for n in numbers for base in alone), jointly


def plan_of_energies(
    methods: Sequence[str], n_views: int, gaussians: int, energies: int, materials: Sequence[str], states: Sequence[str]
) -> tuple[Trial, ...]:
    """Each energy by itself with each method, then one fit of all materials, and with the share of two states."""
    alone = [replace(base, group="parts", parts=energies) for base in _baselines(methods, n_views, gaussians)]
    names: dict[str, Plain | None] = {"materials": ",".join(materials)}
    jointly = [Trial("one fit", "materials", n_views, settings=names)]
    jointly += [replace(jointly[0], settings={**names, "states": ",".join(states)})] if states else []
    return *alone, *jointly


def _baselines(methods: Sequence[str], n_views: int, gaussians: int) -> list[Trial]:
    """In short runs."""
    return [trials_of(method, n_views, gaussians, "quick")[0] for method in methods]
