"""The pipeline: from options to a volume with its report. What differs is the source of views: a file that is whole, or
one that grows."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace

from beamline.core.events import ReconStarted, Sink, StateEntered
from beamline.core.phases import Phases
from beamline.core.sinks import Warnings
from beamline.core.stop import StopScope, never_stopped
from beamline.projections.held_out import hold_out
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.error_bars import refuse_views
from beamline.reconstruct.growing_views import growing_views
from beamline.reconstruct.in_time import fit_within, warnings_told
from beamline.reconstruct.job import Channels, Job, compile_kernels, volume_of, with_error_bars
from beamline.reconstruct.measure import fit_truth
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.outcome import ReportContext, facts_of
from beamline.reconstruct.plan import ReconPlan
from beamline.reconstruct.progress import corrections_done
from beamline.reconstruct.refusals import refuse_before_reading
from beamline.reconstruct.region import Region, locate
from beamline.reconstruct.remarks import partly_seen_warning
from beamline.reconstruct.result import write_result
from beamline.reconstruct.slab_run import keeping
from beamline.reconstruct.slabs import prepare_within
from beamline.storage.recon_record import ReconRecord
from drivers.base.clock import Clock
from recon.base.decisions import Decisions
from recon.base.method import BoundedMethod
from recon.base.stop import Stop
from recon.base.volume import Grid

_HELD_OUT_ONE_IN = 10  # one of so many views is held out for --early-stop


@contextmanager
def finished_views(options: ReconOptions, channels: Channels) -> Iterator[Job]:
    """The job of a scan whose views are all there, with compiled kernels; slabs stay where the block fails.

    Raises:
        ConfigError, DataError: the views, the memory or the disk do not suffice.
    """
    sink, clock, warn, phases = channels.sink, channels.clock, channels.warn, channels.phases
    phases.enter("opening the scan")
    with options.source.open() as source:
        facts, options = facts_of(source), options.around_region(source)
        box = options.region if isinstance(options.region, Region) else None
        if box is not None and box.reason:
            sink(StateEntered("roi", box.reason, time=clock.now()))
        prepared, plan = prepare_within(source, options, sink, clock, warn, phases)
    prepared = _for_method(options, prepared, plan, channels)
    _announce(options, prepared, channels)
    if few := partly_seen_warning(prepared.geometry):
        warn(few)
    region = None if box is None else locate(box, options.selection, prepared.geometry)
    # A direct method and a slab have no volume so far: a signal interrupts them.
    stopping = never_stopped if options.method.traits.direct or plan.slabs else channels.stop_scope
    with keeping(options.partial_path) if plan.slabs else nullcontext():
        phases.enter("compiling kernels")
        compile_kernels(options, prepared.geometry, sink, clock)
        phases.enter("reconstruction")
        before_report = Stop()
        if isinstance(options.method, BoundedMethod) and options.method.seconds is not None:
            started = channels.started, channels.worked
            method, before_report = fit_within(options.method, prepared, options.target, started, clock, warn)
            options = replace(options, method=method)
        yield Job(
            options,
            channels,
            prepared,
            lambda: facts,
            stopping,
            slabs=plan.slabs,
            region=region,
            leaves=before_report.leaves,
        )


def _for_method(
    options: ReconOptions, prepared: PreparedProjections, plan: ReconPlan, channels: Channels
) -> PreparedProjections:
    """The views as the method takes them, with some held out where it ends early, after their disk was looked at.

    Raises:
        ConfigError, DataError: the views do not suffice, or the disk does not.
    """
    if options.uncertainty:
        refuse_views(options.method_for(prepared.geometry), prepared.geometry)
    if options.cluster is not None and not plan.slabs:
        channels.warn(
            "The volume fits into the memory and is made here, without --cluster; a smaller --memory makes slabs."
        )
    if options.stops_early and prepared.held_out is None:
        prepared = hold_out(prepared, _HELD_OUT_ONE_IN, advice="leave out --early-stop")
        n = prepared.projections.view_ids.size
        message = f"{prepared.n_projections - n} of {prepared.n_projections} views are held out to say when to stop"
        channels.sink(StateEntered("held_out", message, time=channels.clock.now()))
    options.target.require_room(plan.output, plan.scratch)
    return prepared


def _announce(options: ReconOptions, prepared: PreparedProjections, channels: Channels) -> None:
    """Report the requested corrections of the views, then send the event `recon_started`."""
    sink, clock = channels.sink, channels.clock
    corrections_done({name: done.sentence for name, done in prepared.done.items() if not done.warned}, sink, clock)
    views, confident = prepared.geometry, None if prepared.axis is None else prepared.axis.confident
    more = {"n_projections": prepared.n_projections, "detector": views.detector_shape, "axis_confident": confident}
    sink(
        ReconStarted(
            options.source.path, options.method.name, views.n_views, prepared.axis_col, more=more, time=clock.now()
        )
    )


def reconstruct_file(
    options: ReconOptions, sink: Sink, clock: Clock, stop_scope: StopScope = never_stopped
) -> ReconRecord:
    """Reconstruct a scan that has ended, or while it runs. Returns the record of the volume, as the event `done` does.

    A reconstruction that is stopped within `stop_scope` writes the volume so far, marked `ended_early`. One by a direct
    method is interrupted like all else, with nothing written; one in slabs keeps those that are finished.

    Of a scan that runs, intermediate volumes stand in `<output>.snapshot.h5`, their pictures in `<output>.live.png`,
    each replacing the last in one step; a failure leaves the newest ones, success the picture.

    Raises:
        ConfigError, DataError: with nothing written. Also for a scan that stopped growing without being finished.
        ScanStopped: interrupted, with slabs to go on from.
        KeyboardInterrupt: a stop of a scan that runs, before there was a volume.
    """
    channels = Channels(
        sink, clock, Warnings(sink, clock), Phases(sink, clock), stop_scope, clock.now(), time.process_time()
    )
    truth_given = refuse_before_reading(options)
    views_of = finished_views if options.follow is None else growing_views
    with views_of(options, channels) as job:
        if truth_given is not None:  # before the work
            fit_truth(truth_given, Grid.matching(job.prepared.geometry), options.selection.binning)
        decided = Decisions(options.seed)
        with job.stopping() as stopped, warnings_told(channels.warn):
            made, prepared = volume_of(replace(job, stop=Stop(stopped)), decided)
        if options.uncertainty:
            job.channels.phases.enter("error bars")
            with stop_scope() as stopped, warnings_told(channels.warn):
                made = with_error_bars(replace(job, stop=Stop(stopped)), made, decided)
        joined = round(prepared.geometry.pixel_pitch / job.prepared.geometry.pixel_pitch)
        selection = replace(job.options.selection, binning=options.selection.binning * joined)
        truth = None if truth_given is None else fit_truth(truth_given, made.volume.grid, selection.binning)
        context = ReportContext(
            job.facts(), selection, options.command, options.seed, channels.warn.messages, channels.started,
            recipe=options.recipe, region=job.region, phases=job.channels.phases, leaves=job.leaves,
            filter=options.filter,
        )  # fmt: skip
        partial_volume = options.partial_path if job.slabs and options.becomes_output else None
        with job.stopping():  # the volume is there: the first signal no longer discards it
            record = write_result(made, prepared, truth, options.target, context, sink, clock, partial_volume)
        del made, prepared  # Windows removes no file that is mapped
    return record
