"""Offline reconstruction: a finished scan file in, a volume with its report out."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace

from beamline.core.errors import ConfigError, DataError
from beamline.core.events import ReconStarted, Sink, StateEntered
from beamline.core.phases import Phases
from beamline.core.sinks import Warnings
from beamline.core.stop import StopScope, never_stopped
from beamline.projections.held_out import hold_out
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.cluster import refuse_unusable
from beamline.reconstruct.energy_scans import EnergyScans
from beamline.reconstruct.error_bars import refuse_impossible, refuse_views
from beamline.reconstruct.in_time import fit_within, warnings_told
from beamline.reconstruct.job import Job, volume_of, with_error_bars
from beamline.reconstruct.measure import fit_truth, read_truth
from beamline.reconstruct.option_rules import OF_ONE_VOLUME
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.outcome import ReportContext, facts_of
from beamline.reconstruct.output_paths import OutputPaths
from beamline.reconstruct.progress import corrections_done
from beamline.reconstruct.region import locate
from beamline.reconstruct.remarks import partly_seen_warning
from beamline.reconstruct.result import write_result
from beamline.reconstruct.slab_run import keeping
from beamline.reconstruct.slabs import prepare_within
from beamline.storage.interrupted import next_step
from beamline.storage.readers.base import ScanSource
from beamline.storage.writers.recon_file import SUFFIXES
from drivers.base.clock import Clock
from recon.base.decisions import Decisions
from recon.base.method import (
    BoundedMethod,
    volume_names_of,
    volumes_of,
)
from recon.base.slabs import Slab
from recon.base.stop import Stop
from recon.base.volume import Grid
from recon.splatting.backend import backend_for

_HELD_OUT_ONE_IN = 10  # one of so many views is held out for --early-stop


def reconstruct_file(
    options: ReconOptions, sink: Sink, clock: Clock, stop_scope: StopScope = never_stopped
) -> dict[str, float]:
    """Reconstruct a finished scan. Returns the metrics; the event `done` says the rest.

    A reconstruction that is stopped within `stop_scope` writes the volume so far, marked `ended_early`. One by a direct
    method is interrupted like all else, with nothing written; one in slabs keeps those that are finished.

    Raises:
        ConfigError, DataError: with nothing written.
        ScanStopped: interrupted, with slabs to go on from.
    """
    started, worked, phases = clock.now(), time.process_time(), Phases(sink, clock)
    warn = Warnings(sink, clock)
    phases.enter("opening the scan")
    _refuse_impossible(options)
    truth_given = None if options.truth is None else read_truth(options.truth)
    _require_all_finished(options)
    with options.source.open() as source:
        facts, options = facts_of(source), options.around_region(source)
        prepared, slabs = prepare_within(source, options, sink, clock, warn, phases)
    prepared = _for_method(options, prepared, slabs, sink, clock, warn)
    if truth_given is not None:  # before the work
        fit_truth(truth_given, Grid.matching(prepared.geometry), options.selection.binning)
    announce(options, prepared, sink, clock)
    if few := partly_seen_warning(prepared.geometry):
        warn(few)
    region = None if options.region is None else locate(options.region, options.selection, prepared.geometry)
    with keeping(options.partial_path) if slabs else nullcontext():
        phases.enter("compiling kernels")
        job = Job(options, prepared, sink, clock, Stop(), warn, region)
        job.compile_kernels()
        phases.enter("reconstruction")
        before_report = Stop()
        if isinstance(options.method, BoundedMethod) and options.method.seconds is not None:
            method, before_report = fit_within(options.method, prepared, options.target, (started, worked), clock, warn)
            job = replace(job, options=replace(options, method=method))
        # A direct method and a slab have no volume so far: a signal interrupts them.
        stopping = never_stopped if job.options.method.traits.direct or slabs else stop_scope
        decided = Decisions(options.seed)
        with stopping() as stopped, warnings_told(warn):
            done = volume_of(replace(job, stop=Stop(stopped)), slabs, decided)
        if options.uncertainty:
            phases.enter("error bars")
            with stop_scope() as stopped, warnings_told(warn):
                job = replace(job, stop=Stop(stopped))
                done = replace(done, made=with_error_bars(job, done.made, slabs, decided))
        selection = replace(options.selection, binning=options.selection.binning * done.factor)
        truth = None if truth_given is None else fit_truth(truth_given, done.made.volume.grid, selection.binning)
        context = ReportContext(
            facts, selection, options.command, options.seed, warn.messages, started, recipe=options.recipe,
            region=region, phases=phases, leaves=before_report.leaves, filter=options.filter, chosen=done.chosen,
        )  # fmt: skip
        partial_volume = options.partial_path if slabs and options.becomes_output else None
        with stopping():  # the volume is there: the first signal no longer discards it
            metrics = write_result(
                done.made, done.prepared, truth, options.target, context, sink, clock, partial_volume
            )  # fmt: skip
        del done  # Windows removes no file that is mapped
    return metrics


def _refuse_impossible(options: ReconOptions) -> None:
    """Raises ConfigError and DataError for what shows before the scan is read."""
    options.target.refuse_existing()
    options.checkpoints.refuse_existing()
    check_device(options.device)
    options.refuse_contradictions()
    _refuse_for_source(options)
    if options.method.traits.several:
        _require_hdf5(options.target)
    if options.uncertainty:
        refuse_impossible(options)
    if options.cluster is not None:
        refuse_unusable(options.cluster)  # now, before the correction of the scan


def _for_method(
    options: ReconOptions,
    prepared: PreparedProjections,
    slabs: Sequence[Slab],
    sink: Sink,
    clock: Clock,
    warn: Warnings,
) -> PreparedProjections:
    """The views as the method takes them, with some held out where it ends early, after their disk was looked at.

    Raises:
        ConfigError, DataError: the views do not suffice, or the disk does not.
    """
    if options.uncertainty:
        refuse_views(options.method_for(prepared.geometry), prepared.geometry)
    if options.cluster is not None and not slabs:
        warn("The volume fits into the memory and is made here, without --cluster; a smaller --memory makes slabs.")
    if options.stops_early and prepared.held_out is None:
        prepared = hold_out(prepared, _HELD_OUT_ONE_IN, advice="leave out --early-stop")
        n = prepared.projections.view_ids.size
        message = f"{prepared.n_projections - n} of {prepared.n_projections} views are held out to say when to stop"
        sink(StateEntered("held_out", message, time=clock.now()))
    volume = 4 * volumes_of(options.method) * math.prod(Grid.matching(prepared.geometry).shape)
    volumes = volume * options.target.written * (1 + options.uncertainty)
    options.target.require_room(*(options.disk_needs(volume) if slabs else (volumes, 0)))
    return prepared


def _require_all_finished(options: ReconOptions) -> None:
    """As `require_finished`, of each scan."""
    for each in options.source.scans if isinstance(options.source, EnergyScans) else (options.source,):
        with each.open() as source:
            require_finished(source, options)


def require_finished(source: ScanSource, options: ReconOptions) -> None:
    """Raises DataError for an unfinished scan, unless it is to be taken as it is."""
    if source.finished or options.unfinished:
        return
    raise DataError(
        f"{source.path} is not finished. {next_step(source.path)} --unfinished takes the {source.image_key.size} "
        "frames that are there as they are. Nothing was written."
    )


def announce(options: ReconOptions, prepared: PreparedProjections, sink: Sink, clock: Clock) -> None:
    """Report the requested corrections of the views, then send the event `recon_started`."""
    corrections_done({name: done.sentence for name, done in prepared.done.items() if not done.warned}, sink, clock)
    views, confident = prepared.geometry, None if prepared.axis is None else prepared.axis.confident
    more = {"n_projections": prepared.n_projections, "detector": views.detector_shape, "axis_confident": confident}
    sink(
        ReconStarted(
            options.source.path, options.method.name, views.n_views, prepared.axis_col, more=more, time=clock.now()
        )
    )


def check_device(device: str) -> None:
    """Raises ConfigError if a fit cannot compute on the device."""
    try:
        backend_for(device)
    except (ImportError, RuntimeError, ValueError) as error:
        raise ConfigError(f"--device {device}: {error}. Leave it out to compute on the CPU.") from error


def _refuse_for_source(options: ReconOptions) -> None:
    """Raises ConfigError for a method of other scans than the source has, or of other materials than its spectra."""
    method, scans = options.method, options.source if isinstance(options.source, EnergyScans) else None
    if method.traits.by_energy != (scans is not None):
        wanted = "scans at several energies, and spectra of the materials" if scans is None else "one scan"
        raise ConfigError(f"{method.name} takes {wanted}. Choose another method. Nothing was read.")
    for name in (name for name in OF_ONE_VOLUME if scans is not None and name in options.given):
        raise ConfigError(f"--{name} does not go with several energies: {OF_ONE_VOLUME[name]}. Nothing was computed.")
    if scans is not None and volume_names_of(method) != scans.spectra.names:
        raise ConfigError(
            f"{method.name} is of {', '.join(volume_names_of(method))}, {scans.spectra.path} of "
            f"{', '.join(scans.spectra.names)}: give it the same materials. Nothing was read."
        )


def _require_hdf5(target: OutputPaths) -> None:
    """Raises ConfigError for a file that holds one volume."""
    if target.written and target.output.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"-o {target.output}: several volumes go into HDF5 files; give a name that ends in .h5.")
