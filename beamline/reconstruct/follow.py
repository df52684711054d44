"""Following a scan: the volume grows while the file does, and is finished when the scan is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from beamline.core.errors import ConfigError, DataError
from beamline.core.events import Sink, StateEntered
from beamline.core.sinks import Warnings
from beamline.core.stop import StopScope, never_stopped
from beamline.core.text import count
from beamline.reconstruct.live_fit import ScanFollower
from beamline.reconstruct.measure import fit_truth, read_truth
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.outcome import ReportContext, facts_of
from beamline.reconstruct.progress import compilation_events
from beamline.reconstruct.result import write_result
from beamline.storage.interrupted import next_step
from beamline.storage.readers.open import NotReadyError, ScanSource
from beamline.storage.writer_lock import PATIENCE, WriterWatch
from drivers.base.clock import Clock
from recon.base.views import parse_views
from recon.splatting.r2 import R2
from recon.warm_up import warm_up

DEFAULT_SECONDS = 20.0  # of the last round


@dataclass(frozen=True)
class FollowTiming:
    """How a scan is followed; all in s.

    Attributes:
        poll: between looks at the file while there is nothing to fit.
        slice: of fitting between looks at the file.
        snapshot: between intermediate volumes.
        picture: between slices by FBP, at least; drawing them takes at most half of the time.
        patience: without a new frame, before a file without the lock of its writer counts as one that died.
    """

    poll: float = 0.1
    slice: float = 0.25
    snapshot: float = 5.0
    picture: float = 0.3
    patience: float = PATIENCE


def follow(
    options: ReconOptions,
    sink: Sink,
    clock: Clock,
    rhythm: FollowTiming | None = None,
    stop_scope: StopScope = never_stopped,
) -> dict[str, float]:
    """Reconstruct a scan while it runs (or one that has ended). Returns the metrics; the event `done` says the rest.

    Intermediate volumes stand in `<output>.snapshot.h5`, their pictures in `<output>.live.png`, each replacing the last
    in one step; a failure leaves the newest ones, success the picture.

    A stop ends it with the volume of the views so far, marked `ended_early`.

    Raises:
        ConfigError: a method or selection that needs the whole scan.
        DataError: no scan, or one that stopped growing without being finished.
        KeyboardInterrupt: a stop before there was a volume.
    """
    rhythm = rhythm or FollowTiming()
    method = options.streaming
    options.refuse_contradictions("follow")
    views = options.selection.views
    if not (views == "all" or views.startswith("every:")) or method.steps is not None:
        raise ConfigError(
            "--follow takes views as they come, and fits for --seconds after the end: leave out --views, but for "
            "every:K, and --steps."
        )
    try:
        parse_views(views, [0.0])
    except ValueError as error:
        raise ConfigError(f"{error}. Nothing was written.") from error
    options.target.refuse_existing()
    wanted = None if options.truth is None else read_truth(options.truth)
    started = clock.now()
    warn = Warnings(sink, clock)
    _compile(options, sink, clock, rhythm)
    with _open(options, sink, clock, rhythm) as source:
        follower = ScanFollower(options, source, sink, clock, warn)
        with stop_scope() as should_stop:
            if _watch(follower, clock, rhythm, should_stop):
                follower.catch_up(should_stop)
            else:
                n = follower.n_views_taken
                warn(f"Stopped while the scan runs: the volume is of the first {count(n, 'view')}.")
            made, prepared = follower.finish(method.seconds or DEFAULT_SECONDS, rhythm.snapshot, should_stop)
    # Opened again: HDF5 may still have the texts of the end as they were when it first read them.
    with _open(options, sink, clock, rhythm) as source:
        facts = facts_of(source)
    truth = None if wanted is None else fit_truth(wanted, made.volume.grid, options.selection.binning)
    context = ReportContext(
        facts, options.selection, options.command, options.seed, warn.messages, started, recipe=options.recipe,
        live_picture=options.target.live_picture.name if follower.snapshots.drawn else "", filter=options.filter,
    )  # fmt: skip
    metrics = write_result(made, prepared, truth, options.target, context, sink, clock)
    follower.snapshots.remove()
    return metrics


def _compile(options: ReconOptions, sink: Sink, clock: Clock, rhythm: FollowTiming) -> None:
    """Compile what the fit needs, once on a machine, before the first view. Sweeps on voxels follow the last one.

    The state `ready` then says where the volume can be watched.
    """
    compiled = compilation_events(sink, clock)
    sink(StateEntered("warming_up", "Compiling the fit's kernels, if need be", time=clock.now()))
    warm_up(R2(finish=0), on_kernel=compiled)
    picture = options.target.live_picture
    message = (
        f"The live volume is ready for views. To watch it grow, open {picture}: slices from the eighth "
        f"view on, and the volume, drawn anew about every {rhythm.snapshot:g} s"
    )
    sink(StateEntered("ready", message, {"picture": picture}, time=clock.now()))


def _open(options: ReconOptions, sink: Sink, clock: Clock, rhythm: FollowTiming) -> ScanSource:
    """Wait until the file exists and is readable."""
    begin = clock.now()
    told = False
    while True:
        try:
            return options.source.open(follow=True)
        except NotReadyError as error:
            if clock.now() - begin > rhythm.patience:
                raise DataError(f"No scan began in {options.source.path} within {rhythm.patience:.0f} s.") from error
            if not told:
                sink(StateEntered("waiting", f"Waiting for {options.source.path}", time=clock.now()))
                told = True
            clock.sleep(rhythm.poll)


def _watch(follower: ScanFollower, clock: Clock, rhythm: FollowTiming, should_stop: Callable[[], bool]) -> bool:
    """Take views and fit, in turns, until the scan has ended (True) or a stop finds views enough for a volume (False).

    Raises:
        DataError: the scan died. KeyboardInterrupt: a stop, before there were views enough.
    """
    last_snapshot = clock.now()
    writer = WriterWatch(follower.source.path, last_snapshot, rhythm.patience)
    while True:
        ended = follower.source.finished  # asked before the frames, so that none is missed
        grew = follower.take_new_frames(ended)
        if ended:
            return True
        if should_stop() and not follower.source.finished:
            if not follower.has_volume:
                raise KeyboardInterrupt("stopped before the views were enough for a volume; nothing was written")
            return False
        if why := writer.lost(clock.now(), grew, lambda: follower.source.finished):
            raise DataError(
                f"{follower.source.path} {why} and is not finished. {next_step(follower.source.path)} Without --follow "
                f"and with --unfinished the {follower.n_views} views that are there are used."
            )
        follower.draw_slices(rhythm.picture)
        if not follower.advance(rhythm.slice):
            clock.sleep(rhythm.poll)
        elif clock.now() - last_snapshot >= rhythm.snapshot:
            follower.write_snapshot()
            last_snapshot = clock.now()
        follower.ask_whether_enough()
