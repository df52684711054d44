"""Pipeline: makes a volume and its report from options. The projections come from a finished file, or from a file that
is still growing.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

from beamline.core.durations import Phases
from beamline.core.errors import DataError
from beamline.core.events import Sink, StateEntered
from beamline.core.recon_events import ALL_SHOWN, ReconStarted
from beamline.core.sinks import Warnings
from beamline.core.stop import StopScope, never_stopped
from beamline.core.text import count
from beamline.projections.prepared import PreparedProjections, hold_out
from beamline.projections.replayed_frames import awaited, growing
from beamline.projections.views import select
from beamline.reconstruct.followed_views import FollowedViews
from beamline.reconstruct.job import (
    Channels,
    Job,
    compilation_events,
    compile_kernels,
    corrections_done,
    refused,
    volume_of,
    with_error_bars,
)
from beamline.reconstruct.live_fit import ScanFollower
from beamline.reconstruct.live_reference import ReferencePictures
from beamline.reconstruct.live_states import LiveScan
from beamline.reconstruct.options import FollowTiming, ReconOptions
from beamline.reconstruct.plan import ReconPlan, prepare_within
from beamline.reconstruct.record import partly_seen_warning, write_result
from beamline.reconstruct.reference import with_reference
from beamline.reconstruct.refusals import refuse_before_reading
from beamline.reconstruct.region import Region, locate
from beamline.reconstruct.run import fit_within, refuse_views, warnings_shown
from beamline.reconstruct.scan_facts import MadeVolume, ReportContext, ScanFacts, facts_of
from beamline.reconstruct.slab_run import keeping
from beamline.reconstruct.snapshots import Snapshots
from beamline.reconstruct.truth import fit_truth
from beamline.storage.interrupted import next_step
from beamline.storage.readers.open import NotReadyError, ScanSource, SourceOptions
from beamline.storage.recon_record import ReconRecord
from beamline.storage.writer_lock import WriterWatch
from drivers.base.clock import Clock
from recon.base.arrays import F32
from recon.base.decisions import Decisions, Stop
from recon.base.volume import Grid
from recon.splatting.r2 import R2
from recon.warm_up import warm_up

MOST_SECONDS = 1800.0  # time limit of the final fit
_HELD_OUT_ONE_IN = 10  # every tenth projection is held out for --early-stop


@contextmanager
def growing_views(options: ReconOptions, channels: Channels, truth: F32 | None) -> Iterator[Job]:
    """Follow a running scan to its last projection with a growing fit; yields the job that makes its volume.

    Intermediate volumes are in `<output>.snapshot.h5`, their pictures in `<output>.live.png`. If the block fails, the
    newest volume and picture stay; otherwise only the picture stays.

    Raises:
        DataError: the file is not a scan, or it stopped growing without being finished.
        KeyboardInterrupt: the user stopped before there was a volume.
    """
    timing, sink, clock = options.follow, channels.sink, channels.clock
    assert timing is not None
    with suppress(NotReadyError):  # an error for a file that is not a scan comes before anything is compiled
        options.source.open(follow=True).close()
    _compile(options.target.live_picture, channels, timing)
    with channels.stop_scope() as should_stop:
        with _open(options.source, channels, timing) as source:
            views = FollowedViews(select(source, options.selection))
            live = LiveScan(options.streaming, options.seed, views, sink, clock, channels.warn, begin=clock.now())
            follower = ScanFollower(live, options.target)
            if _watch(follower, clock, timing, should_stop):
                follower.catch_up(should_stop)
                follower.draw_slices()
            else:
                n = follower.n_views_taken
                channels.warn(
                    f"Stopped during the scan: the volume is reconstructed from the first {count(n, 'projection')}."
                )
            last = follower.end()

        def facts() -> ScanFacts:
            # Open the file again, because HDF5 may still have the texts from before the end of the scan.
            picture = options.target.live_picture.name if follower.snapshots.drawn else ""
            with _open(options.source, channels, timing) as source:
                return replace(facts_of(source), live_picture=picture)

        phases = Phases(sink, clock)  # a new `Channels`, because waiting for projections does not count as work
        phases.enter("final fit")
        final_fit = follower.final_fit(last, options.streaming.seconds or MOST_SECONDS, timing.snapshot)
        channels = replace(channels, phases=phases)
        yield Job(
            options, channels, last.prepared, facts, lambda: nullcontext(should_stop), truth=truth, final_fit=final_fit
        )
    follower.snapshots.remove()


def _wait_for_the_end(options: ReconOptions, channels: Channels, timing: FollowTiming) -> None:
    """Wait for the end of a scan whose method needs all projections.

    If the method uses a reference, pictures of the projections so far are drawn during the wait.

    Raises:
        DataError: the scan died.
        KeyboardInterrupt: stopped before the end of the scan; nothing was written.
    """
    with channels.stop_scope() as should_stop, _open(options.source, channels, timing) as source:
        message = f"{options.method.name} needs all projections: the reconstruction starts when the scan has ended"
        channels.sink(StateEntered("waiting", message, time=channels.clock.now()))
        drawn = None
        if options.reference is not None:
            views = FollowedViews(select(source, options.selection))
            snapshots = Snapshots(options.target, views, channels.sink, channels.clock, channels.warn)
            drawn = ReferencePictures(views, options.method, snapshots, channels.clock, channels.warn)
        for n_frames in growing(source, channels.clock, timing.patience, timing.poll):
            if drawn is not None and n_frames:
                drawn.draw(None if source.finished else timing.picture)
            if should_stop():
                raise KeyboardInterrupt("stopped before the scan had ended; nothing was written")
        if drawn is not None:
            message = "The picture now shows slices from all projections of the scan"
            channels.sink(StateEntered(ALL_SHOWN, message, time=channels.clock.now()))


def _compile(picture: Path, channels: Channels, timing: FollowTiming) -> None:
    """Compile the kernels of the fit before the first projection (only once on a computer). Then send the event
    `ready`, which names the picture that shows the volume. The kernels of the voxel refinement are compiled after the
    last projection.
    """
    sink, clock = channels.sink, channels.clock
    compiled = compilation_events(sink, clock)
    sink(
        StateEntered(
            "warming_up",
            "Loading the compiled code of the fit (if the installation has no compiled code for this computer, the "
            "code is compiled now: 1 to 2 minutes)",
            time=clock.now(),
        )
    )
    warm_up(R2(finish=0), on_kernel=compiled)
    message = (
        f"The live reconstruction is ready. To watch the reconstruction, open {picture}: the picture shows slices "
        f"from the eighth projection on, later the volume. It is updated about every {timing.snapshot:g} s"
    )
    sink(StateEntered("ready", message, {"picture": picture}, time=clock.now()))


def _open(scan: SourceOptions, channels: Channels, timing: FollowTiming) -> ScanSource:
    """Wait until the file exists and is readable."""
    with suppress(NotReadyError):
        return scan.open(follow=True)
    path = Path(scan.path)
    channels.sink(StateEntered("waiting", f"Waiting for {path}", time=channels.clock.now()))
    return awaited(lambda: scan.open(follow=True), path, channels.clock, timing.patience, timing.poll)


def _watch(follower: ScanFollower, clock: Clock, timing: FollowTiming, should_stop: Callable[[], bool]) -> bool:
    """Read projections and fit, in turns. Returns True when the scan has ended, and False after a stop request, if
    there are enough projections for a volume.

    Raises:
        DataError: the scan died.
        KeyboardInterrupt: stopped before there were enough projections.
    """
    last_snapshot = clock.now()
    writer = WriterWatch(follower.source.path, last_snapshot, timing.patience)
    while True:
        ended = follower.source.finished  # read before the frames, so that no frame is missed
        grew = follower.take_new_frames(ended)
        if ended:
            return True
        if should_stop() and not follower.source.finished:
            if not follower.has_volume:
                raise KeyboardInterrupt(
                    "stopped before there were enough projections for a volume; nothing was written"
                )
            return False
        if reason := writer.lost(clock.now(), grew, lambda: follower.source.finished):
            raise DataError(
                f"{follower.source.path} {reason} and is not finished. {next_step(follower.source.path)} To use the "
                f"{count(follower.views.n, 'projection')} in the file, replace --follow by --unfinished."
            )
        follower.measure_law()
        follower.draw_slices(timing.picture)
        if not follower.advance(timing.slice):
            clock.sleep(timing.poll)
        elif clock.now() - last_snapshot >= timing.snapshot:
            follower.write_snapshot()
            last_snapshot = clock.now()


@contextmanager
def finished_views(options: ReconOptions, channels: Channels, truth: F32 | None) -> Iterator[Job]:
    """The job of a finished scan, with compiled kernels. A running scan is awaited first. Finished slabs are kept if
    the block fails.

    Raises:
        ConfigError, DataError: there are too few projections, or too little memory or disk space.
    """
    if options.follow is not None:
        _wait_for_the_end(options, channels, options.follow)
    sink, clock, warn, phases = channels.sink, channels.clock, channels.warn, channels.phases
    phases.enter("opening the scan")
    with options.source.open() as source:
        facts = facts_of(source)
        options, scan = options.around_region(select(source, options.selection))
        box = options.region if isinstance(options.region, Region) else None
        if box is not None and box.reason:
            sink(StateEntered("roi", box.reason, time=clock.now()))
        prepared, plan = prepare_within(scan, options, sink, clock, warn, phases)
    prepared = _for_method(options, prepared, plan, channels)
    _announce(options, prepared, channels)
    if few := partly_seen_warning(prepared.geometry):
        warn(few)
    region = None if box is None else locate(box, options.selection, prepared.geometry)
    # A signal interrupts a direct method and a slab, because they have no intermediate volume.
    stopping = channels.stop_scope if options.method.fitted and not plan.slabs else never_stopped
    with keeping(options.partial_path) if plan.slabs else nullcontext():
        phases.enter("compiling kernels")
        compile_kernels(options, prepared.geometry, sink, clock)
        phases.enter("reconstruction")
        before_report = Stop()
        if (limit := options.method.time_limit) is not None:
            started = channels.started, channels.worked
            method, before_report = fit_within(
                options.method, limit, prepared.geometry, options.target, started, clock, warn
            )
            options = replace(options, method=method)
        yield Job(
            options, channels, prepared, lambda: facts, stopping,
            truth=truth, slabs=plan.slabs, region=region, leaves=before_report.leaves,
        )  # fmt: skip


def _for_method(
    options: ReconOptions, prepared: PreparedProjections, plan: ReconPlan, channels: Channels
) -> PreparedProjections:
    """The projections in the form that the method needs. Some are held out if the method may end early. The function
    also checks the disk space.

    Raises:
        ConfigError, DataError: there are too few projections, or too little disk space.
    """
    with refused(options.source.path, f" by {options.method.name}"):
        prepared = prepared.selecting(options.method.views_wanted(prepared.geometry))
    if options.uncertainty:
        refuse_views(options.method_for(prepared.geometry), prepared.geometry)
    if options.cluster is not None and not plan.slabs:
        channels.warn(
            "--cluster was not used, because the volume fits into memory. With a smaller --memory the volume is "
            "made in slabs."
        )
    if options.method.stops_early and not prepared.lines.held_out.size:
        prepared = hold_out(prepared, _HELD_OUT_ONE_IN, advice="leave out --early-stop")
        total = prepared.origin.n_projections
        n_held_out = total - prepared.n_used
        message = f"{n_held_out} of {total} projections are held out to decide when to stop"
        channels.sink(StateEntered("held_out", message, time=channels.clock.now()))
    options.target.require_room(plan.output, plan.scratch - plan.line_integrals)  # line integrals are stored already
    return prepared


def _announce(options: ReconOptions, prepared: PreparedProjections, channels: Channels) -> None:
    """Report the corrections that were applied, then send the event `recon_started`."""
    sink, clock, origin = channels.sink, channels.clock, prepared.origin
    corrections_done({name: done.sentence for name, done in origin.done.items() if not done.warned}, sink, clock)
    views, confident = prepared.geometry, None if origin.axis is None else origin.axis.confident
    more = {"n_projections": origin.n_projections, "detector": views.detector_shape, "axis_confident": confident}
    path, name = options.source.path, options.method.name
    sink(ReconStarted(path, name, views.n_views, origin.axis_col, more=more, time=clock.now()))


def reconstruct_file(
    options: ReconOptions, sink: Sink, clock: Clock, stop_scope: StopScope = never_stopped
) -> ReconRecord:
    """Reconstruct a finished or running scan. Returns the record of the volume, as in the event `done`.

    If the reconstruction is stopped within `stop_scope`, the volume reached so far is written and marked `ended_early`.
    There are two exceptions: a direct method is interrupted and writes nothing, and a reconstruction in slabs is
    interrupted and keeps the finished slabs.

    While a scan is running, intermediate volumes are in `<output>.snapshot.h5`, and their pictures in
    `<output>.live.png`. Each file replaces the last one in one step. After a failure the newest volume and picture
    stay; after success only the picture stays.

    Raises:
        ConfigError, DataError: the reconstruction is not possible, or a growing scan stopped without being finished;
            nothing was written.
        ScanStopped: the user interrupted the reconstruction; it can be continued from the finished slabs.
        KeyboardInterrupt: the user stopped before there was a volume of the running scan.
    """
    channels = Channels(
        sink, clock, Warnings(sink, clock), Phases(sink, clock), stop_scope, clock.now(), time.process_time()
    )
    truth = refuse_before_reading(options)
    if options.reference is not None:
        first = partial(reconstruct_file, clock=clock, stop_scope=stop_scope)
        if options.follow is not None:  # a running scan waits for this event
            shown = f"Pictures of the scan will be in {options.target.live_picture}, from the eighth projection on"
            picture = {"picture": options.target.live_picture}
            sink(StateEntered("ready", shown, picture, time=clock.now()))
        options = with_reference(options, options.reference, first, sink, clock)
    views_of = growing_views if options.follow is not None and options.streams else finished_views
    with views_of(options, channels, truth) as job:
        return _reconstructed(job)  # keeps no voxels: Windows does not remove a file that is mapped


def _reconstructed(job: Job) -> ReconRecord:
    """Reconstruct the volume of a job, check the volume and write its files. Returns the record of the volume.

    Raises:
        ConfigError: the shape of the ground truth does not fit the volume.
        DataError: the method cannot use the projections, or the volume could not be written.
    """
    options, channels, truth_given = job.options, job.channels, job.truth
    if truth_given is not None:  # checked before the work starts
        fit_truth(truth_given, Grid.matching(job.prepared.geometry), options.selection.binning)
    decided = Decisions(options.seed)
    with job.stopping() as stopped, warnings_shown(channels.warn):
        result, prepared = volume_of(replace(job, stop=Stop(stopped)), decided)
    if options.uncertainty:
        channels.phases.enter("error bars")
        with channels.stop_scope() as stopped, warnings_shown(channels.warn):
            result = with_error_bars(replace(job, stop=Stop(stopped)), result, decided)
    joined = round(prepared.geometry.pixel_pitch / job.prepared.geometry.pixel_pitch)
    selection = replace(options.selection, binning=options.selection.binning * joined)
    truth = None if truth_given is None else fit_truth(truth_given, result.volume.grid, selection.binning)
    context = ReportContext(
        job.facts(), selection, options.command, options.seed, channels.warn.messages, channels.started,
        recipe=options.recipe, region=job.region, phases=channels.phases, leaves=job.leaves, filter=options.filter,
    )  # fmt: skip
    with job.stopping():  # the volume is complete: the first signal no longer discards it
        return write_result(MadeVolume(result, prepared, truth, options.target, context), channels.sink, channels.clock)
