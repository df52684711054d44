"""Trade-off: which trials it compares, of one volume, of volumes in time or of several energies."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from beamline.core.durations import MachineSpeed
from beamline.core.errors import ConfigError
from beamline.core.events import Sink, TradeoffStarted
from beamline.core.files import refuse_existing
from beamline.core.machine import machine
from beamline.core.sinks import Warn
from beamline.energies import EnergyScans, prepare_energies, views_of
from beamline.features.trials.front import TRADEOFF
from beamline.features.trials.launch import TrialData
from beamline.features.trials.plans import (
    Depth,
    expected_seconds,
    plan,
    plan_in_equal_time,
    plan_in_time,
    plan_of_energies,
    quick_first,
    telling_first,
)
from beamline.features.trials.runner import ComparedScan, Planned, RunLimits, opened_scan, run_comparison
from beamline.features.trials.table import TrialTable
from beamline.features.trials.trial import Outcome, Trial
from beamline.projections.prepared import PreparedProjections, hold_out, with_views_held_out
from beamline.projections.scan_statistics import Light
from beamline.reconstruct.outcome import facts_of
from beamline.reconstruct.plan import times_of
from drivers.base.clock import Clock
from recon.base.arrays import F32
from recon.base.volume import Grid
from recon.features.joint.methods import EnergySeries
from recon.features.joint.series import refuse_few
from recon.methods import names_compared
from recon.splatting.initialise import default_count

_HELD_OUT_ONE_IN = 8  # without a truth, one view in this many is held out
_HELD_OUT_VIEWS = 16  # at most
_WITH_JOINT = ("fbp", "fista-tv", "r2")  # beside joint fits, where no methods are named


@dataclass(frozen=True)
class SeveralVolumes:
    """How views show several volumes.

    Attributes:
        volumes: in time, to compare a fit of all of them; 0: none.
        scans: all scans at several energies, the one compared first, and their cross sections; None: it has one.
        states: names of two materials that are two states of the same one; empty: no such pair.
    """

    volumes: int = 0
    scans: EnergyScans | None = None
    states: Sequence[str] = ()


@dataclass(frozen=True)
class TradeoffOptions:
    """The scan and the trials to compare.

    Attributes:
        methods: names in `recon.methods`; none: those that suit such a scan.
        several: how the views show several volumes.
        max_seconds: wall time of the whole run, see `RunLimits`.
        seconds: of each reconstruction, the same for all methods; None: settings are varied.
    """

    scan: ComparedScan
    methods: Sequence[str]
    several: SeveralVolumes = field(default_factory=SeveralVolumes)
    depth: Depth = "quick"
    max_seconds: float | None = None
    seconds: float | None = None
    seed: int = 0
    command: str = ""


def run_tradeoff(
    options: TradeoffOptions,
    sink: Sink,
    clock: Clock,
    now: Callable[[], float] = time.monotonic,
    begun: float | None = None,
) -> TrialTable:
    """Run all trials of a trade-off, see `run_comparison`."""
    limits = RunLimits(options.scan.folder, options.seed, options.max_seconds)
    return run_comparison(partial(planned_tradeoff, options), limits, sink, clock, now, begun)


def planned_tradeoff(options: TradeoffOptions, warn: Warn) -> tuple[TrialData, Planned]:
    """Read and correct the views, hold some out, and plan the trials.

    Raises:
        ConfigError, DataError: nothing was written.
    """
    if options.several.scans is not None:
        data, trials, table = _of_energies(options, options.several.scans, warn)
    elif options.several.volumes:
        data, trials, table = _in_time(options, options.several.volumes, warn)
    else:
        data, trials, table = _of_one_volume(options, warn)
    if options.max_seconds is not None:
        trials = telling_first(trials)
    by = "psnr" if data.truth is not None else "residual_held_out"
    table = replace(table, outcomes=tuple(Outcome(trial, "not run") for trial in trials), by=by)
    return data, Planned(table, TRADEOFF, TradeoffStarted(options.scan.source.path, len(trials), by))


def _table(options: TradeoffOptions, facts: Mapping[str, str], length_unit: str, light: Light | None) -> TrialTable:
    return TrialTable((), "psnr", length_unit, machine(), facts, options.command, light=light)


Comparison = tuple[TrialData, Sequence[Trial], TrialTable]


def _of_one_volume(options: TradeoffOptions, warn: Warn) -> Comparison:
    opened = opened_scan(options.scan, warn)
    data = split(opened.prepared, opened.truth)
    n, start = data.geometry.n_views, default_count(data.geometry, opened.grid.voxel_size)
    facts = {**opened.facts, "views used": str(n)}
    methods, seconds = options.methods or names_compared(data.prepared.emission is not None), options.seconds
    trials = (
        quick_first(plan(methods, n, start, options.depth), expected_seconds(data.geometry, MachineSpeed()))
        if seconds is None
        else plan_in_equal_time(methods, n, start, seconds)
    )
    return data, trials, _table(options, facts, opened.prepared.length_unit, opened.light)


def split(prepared: PreparedProjections, truth: F32 | None) -> TrialData:
    """The views that trials use, and the views held out that judge all trials if there is no truth.

    Raises:
        ConfigError: too few views to hold some out.
    """
    if truth is None:
        prepared = hold_out(prepared, _HELD_OUT_ONE_IN, most=_HELD_OUT_VIEWS, advice="give --truth")
    return TrialData(prepared, truth)


def _in_time(options: TradeoffOptions, volumes: int, warn: Warn) -> Comparison:
    scan = options.scan
    opened = opened_scan(scan, warn)
    held = hold_out(opened.prepared, _HELD_OUT_ONE_IN, most=_HELD_OUT_VIEWS, advice="leave out --time")
    if held.emission is not None:
        raise ConfigError(f"--time: {scan.source.path} is of an emission. Leave it out. Nothing was written.")
    try:
        refuse_few(volumes, held.geometry.n_views)
    except ValueError as error:
        raise ConfigError(f"--time {volumes}: {error}. Nothing was written.") from error
    with scan.source.open() as source:
        unseen = held.projections.view_ids[:0] if held.held_out_ids is None else held.held_out_ids
        seconds = times_of(source, np.concatenate((held.projections.view_ids, unseen)), warn)
    begun = seconds - seconds.min()
    n_used = held.geometry.n_views
    data = TrialData(replace(held, times=begun[:n_used]), None, begun[n_used:])
    n, start = data.geometry.n_views, default_count(data.geometry, opened.grid.voxel_size)
    trials = plan_in_time(options.methods or _WITH_JOINT, n, start, volumes)
    facts = {**opened.facts, "views used": f"{n}, over {np.ptp(seconds):.4g} s"}
    return data, trials, _table(options, facts, held.length_unit, opened.light)


def _of_energies(options: TradeoffOptions, scans: EnergyScans, warn: Warn) -> Comparison:
    scan, several = options.scan, options.several
    refuse_existing(scan.folder)
    names = scans.spectra.names
    try:
        states = EnergySeries(names, tuple(several.states)).states
    except ValueError as error:
        raise ConfigError(f"--states: {error} of {scans.spectra.path}. Nothing was written.") from error
    prepared = prepare_energies(scans, scan.selection, warn)
    views = views_of(prepared)
    weighted = replace(prepared.projections, weights=views.weight)  # also of the views held out
    prepared = replace(prepared, projections=weighted, shares=None)
    energies = len(views.cross_sections)
    unseen = np.flatnonzero(views.parted(_HELD_OUT_ONE_IN) == _HELD_OUT_ONE_IN // 2)
    data = TrialData(with_views_held_out(prepared, unseen), None, views.energy[unseen].astype(np.float64))
    geometry = data.geometry
    grid, used = Grid.matching(geometry), geometry.n_views
    start = default_count(geometry, grid.voxel_size)
    trials = plan_of_energies(options.methods or _WITH_JOINT, used, start, energies, names, states)
    with scan.source.open() as source:
        facts = dict(facts_of(source).table)
    facts |= {"energies": str(energies), "materials": ", ".join(names), "views used": str(used)}
    facts["volume"] = " × ".join(map(str, grid.shape))
    return data, trials, _table(options, facts, prepared.length_unit, None)
