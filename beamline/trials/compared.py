"""What a trade-off compares: the views of one scan, of one in time, or of scans at several energies; and its trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from beamline.core.errors import ConfigError
from beamline.core.files import refuse_existing
from beamline.core.sinks import Warn
from beamline.projections.held_out import hold_out
from beamline.projections.prepared import PreparedProjections
from beamline.projections.scan_statistics import Light
from beamline.projections.selection import Selection
from beamline.reconstruct.energy_views import energy_views, read_spectra
from beamline.reconstruct.outcome import facts_of
from beamline.reconstruct.time_series import times_of
from beamline.storage.readers.open import SourceOptions
from beamline.trials.data import Data
from beamline.trials.opened import ComparedScan, opened_scan
from beamline.trials.trial import Trial, plan, plan_in_equal_time, plan_in_time, plan_of_energies
from beamline.trials.varied import Depth
from recon.base.arrays import F32
from recon.base.volume import Grid
from recon.methods import names_compared
from recon.series import refuse_few
from recon.splatting.initialise import default_count

_HELD_OUT_ONE_IN = 8  # without a truth, one view in this many is held out
_HELD_OUT_VIEWS = 16  # at most
_WITH_JOINT = ("fbp", "fista-tv", "r2")  # beside joint fits, where no methods are named


@dataclass(frozen=True)
class Several:
    """How views show several volumes.

    Attributes:
        volumes: in time, to compare a fit of all of them; 0: none.
        others: scans of the same sample at other energies.
        spectra: table of what pure materials attenuate.
        states: names of two materials that are states of one; empty: there are none.
    """

    volumes: int = 0
    others: Sequence[tuple[SourceOptions, Selection]] = ()
    spectra: Path | None = None
    states: Sequence[str] = ()


@dataclass(frozen=True, eq=False)
class Compared:
    """Data and trials, with what the table says of the scan.

    Attributes:
        facts: for people, by name.
        light: of a view; None: the dose is counted in frames.
    """

    data: Data
    trials: tuple[Trial, ...]
    facts: Mapping[str, str]
    length_unit: str
    light: Light | None = None


def compared(
    scan: ComparedScan,
    methods: Sequence[str],
    depth: Depth,
    several: Several,
    warn: Warn,
    seconds: float | None = None,
) -> Compared:
    """Read and correct the views, hold some out, and plan the trials.

    Args:
        seconds: of each reconstruction, the same for all methods; None: settings are varied, and say how long each
            takes. Not of views that show several volumes.

    Raises:
        ConfigError, DataError: nothing was written.
    """
    if several.spectra is not None:
        return _of_energies(scan, methods, several, several.spectra, warn)
    if several.volumes:
        return _in_time(scan, methods, several.volumes, warn)
    opened = opened_scan(scan, warn)
    data = split(opened.prepared, opened.truth)
    n, start = data.geometry.n_views, default_count(data.geometry, opened.grid.voxel_size)
    facts = {**opened.facts, "views used": str(n)}
    methods = methods or names_compared(data.emission is not None)
    trials = plan(methods, n, start, depth) if seconds is None else plan_in_equal_time(methods, n, start, seconds)
    return Compared(data, trials, facts, opened.prepared.length_unit, opened.light)


def split(prepared: PreparedProjections, truth: F32 | None) -> Data:
    """The views that trials use, and the views held out that judge all trials if there is no truth.

    Raises:
        ConfigError: too few views to hold some out.
    """
    if truth is None:
        prepared = hold_out(prepared, _HELD_OUT_ONE_IN, most=_HELD_OUT_VIEWS, advice="give --truth")
    others = 0 if prepared.held_out is None else prepared.held_out[1].n_views
    rays = prepared.rays_there(others)
    return Data(prepared.projections.data, prepared.geometry, prepared.held_out, truth, rays, prepared.emission)


def _in_time(scan: ComparedScan, methods: Sequence[str], volumes: int, warn: Warn) -> Compared:
    opened = opened_scan(scan, warn)
    held = hold_out(opened.prepared, _HELD_OUT_ONE_IN, most=_HELD_OUT_VIEWS, advice="leave out --time")
    if held.emission is not None:
        raise ConfigError(f"--time: {scan.source.path} is of an emission. Leave it out. Nothing was written.")
    try:
        refuse_few(volumes, held.geometry.n_views)
    except ValueError as error:
        raise ConfigError(f"--time {volumes}: {error}. Nothing was written.") from error
    with scan.source.open() as source:
        used, unseen = held.projections.view_ids, held.held_out_ids
        seconds = times_of(source, used if unseen is None else np.concatenate((used, unseen)), warn)
    data = replace(split(held, None), of_view=seconds - seconds.min())
    n, start = data.geometry.n_views, default_count(data.geometry, opened.grid.voxel_size)
    trials = plan_in_time(methods or _WITH_JOINT, n, start, volumes)
    facts = {**opened.facts, "views used": f"{n}, over {np.ptp(seconds):.4g} s"}
    return Compared(data, trials, facts, held.length_unit, opened.light)


def _of_energies(scan: ComparedScan, methods: Sequence[str], several: Several, table: Path, warn: Warn) -> Compared:
    refuse_existing(scan.folder)
    spectra = read_spectra(table)
    states = spectra.states(several.states) or ()
    views, first = energy_views([(scan.source, scan.selection), *several.others], spectra, warn, lambda n, of: None)
    energies, held_out = len(views.cross_sections), views.parted(_HELD_OUT_ONE_IN) == _HELD_OUT_ONE_IN // 2
    used, unseen = np.flatnonzero(~held_out), np.flatnonzero(held_out)
    order, geometry = np.concatenate((used, unseen)), views.geometry.select(used)
    data = Data(
        views.projections[used], geometry, (views.projections[unseen], views.geometry.select(unseen)), None,
        None if views.weight is None else views.weight[order],
        of_view=views.energy[order].astype(np.float64), sections=views.cross_sections, states=states,
    )  # fmt: skip
    grid = Grid.matching(geometry)
    start = default_count(geometry, grid.voxel_size)
    trials = plan_of_energies(methods or _WITH_JOINT, used.size, start, energies, bool(states))
    with scan.source.open() as source:
        facts = dict(facts_of(source).table)
    facts |= {"energies": str(energies), "materials": ", ".join(spectra.names), "views used": str(used.size)}
    facts["volume"] = " × ".join(map(str, grid.shape))
    return Compared(data, trials, facts, first.length_unit)
