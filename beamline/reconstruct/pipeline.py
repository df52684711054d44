"""The pipeline: from options to a volume with its report. What differs is the source of views: a file that is whole, or
one that grows."""

from __future__ import annotations

import time
from dataclasses import replace

from beamline.core.events import Sink
from beamline.core.phases import Phases
from beamline.core.sinks import Warnings
from beamline.core.stop import StopScope, never_stopped
from beamline.reconstruct.finished_views import finished_views
from beamline.reconstruct.growing_views import growing_views
from beamline.reconstruct.in_time import warnings_told
from beamline.reconstruct.job import Channels, volume_of, with_error_bars
from beamline.reconstruct.measure import fit_truth
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.outcome import ReportContext
from beamline.reconstruct.refusals import refuse_before_reading
from beamline.reconstruct.result import write_result
from beamline.storage.recon_record import ReconRecord
from drivers.base.clock import Clock
from recon.base.decisions import Decisions
from recon.base.stop import Stop
from recon.base.volume import Grid


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
