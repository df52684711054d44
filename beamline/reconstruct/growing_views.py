"""Growing views: the source of views of a scan that still runs; the volume grows while they come."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace

from beamline.core.errors import DataError
from beamline.core.events import StateEntered
from beamline.core.phases import Phases
from beamline.core.text import count
from beamline.reconstruct.job import Channels, Job
from beamline.reconstruct.live_fit import ScanFollower
from beamline.reconstruct.options import FollowTiming, ReconOptions
from beamline.reconstruct.outcome import ScanFacts, facts_of
from beamline.reconstruct.progress import compilation_events
from beamline.storage.interrupted import next_step
from beamline.storage.readers.open import NotReadyError, ScanSource
from beamline.storage.writer_lock import WriterWatch
from drivers.base.clock import Clock
from recon.splatting.r2 import R2
from recon.warm_up import warm_up

MOST_SECONDS = 600.0  # of the last round


@contextmanager
def growing_views(options: ReconOptions, channels: Channels) -> Iterator[Job]:
    """The job of a scan that runs, or one that has ended, when its last view is there: its fit has learnt all views.

    Intermediate volumes stand in `<output>.snapshot.h5`, their pictures in `<output>.live.png`; where the block fails
    the newest ones stay, else the picture.

    Raises:
        DataError: no scan, or one that stopped growing without being finished.
        KeyboardInterrupt: a stop before there was a volume.
    """
    timing, sink, clock = options.follow, channels.sink, channels.clock
    assert timing is not None
    with suppress(NotReadyError):
        options.source.open(follow=True).close()  # what is no scan is refused before anything is compiled
    _compile(options, channels, timing)
    with channels.stop_scope() as should_stop:
        with _open(options, channels, timing) as source:
            follower = ScanFollower(options, source, sink, clock, channels.warn)
            if _watch(follower, clock, timing, should_stop):
                follower.catch_up(should_stop)
                follower.draw_slices()
            else:
                n = follower.n_views_taken
                channels.warn(f"Stopped while the scan runs: the volume is of the first {count(n, 'view')}.")
            prepared = follower.prepared()

        def facts() -> ScanFacts:
            # Opened again: HDF5 may still have the texts of the end as they were when it first read them.
            picture = options.target.live_picture.name if follower.snapshots.drawn else ""
            with _open(options, channels, timing) as source:
                return replace(facts_of(source), live_picture=picture)

        phases = Phases(sink, clock)  # waiting for views does not count as work
        phases.enter("last round")
        last_round = follower.last_round(options.streaming.seconds or MOST_SECONDS, timing.snapshot)
        channels = replace(channels, phases=phases)
        yield Job(options, channels, prepared, facts, lambda: nullcontext(should_stop), last_round=last_round)
    follower.snapshots.remove()


def _compile(options: ReconOptions, channels: Channels, timing: FollowTiming) -> None:
    """Compile what the fit needs, once on a machine, before the first view. Sweeps on voxels follow the last one.

    The state `ready` then says where the volume can be watched.
    """
    sink, clock = channels.sink, channels.clock
    compiled = compilation_events(sink, clock)
    sink(StateEntered("warming_up", "Compiling the fit's kernels, if need be", time=clock.now()))
    warm_up(R2(finish=0), on_kernel=compiled)
    picture = options.target.live_picture
    message = (
        f"The live volume is ready for views. To watch it grow, open {picture}: slices from the eighth "
        f"view on, and the volume, drawn anew about every {timing.snapshot:g} s"
    )
    sink(StateEntered("ready", message, {"picture": picture}, time=clock.now()))


def _open(options: ReconOptions, channels: Channels, timing: FollowTiming) -> ScanSource:
    """Wait until the file exists and is readable."""
    sink, clock = channels.sink, channels.clock
    begin = clock.now()
    told = False
    while True:
        try:
            return options.source.open(follow=True)
        except NotReadyError as error:
            if clock.now() - begin > timing.patience:
                raise DataError(f"No scan began in {options.source.path} within {timing.patience:.0f} s.") from error
            if not told:
                sink(StateEntered("waiting", f"Waiting for {options.source.path}", time=clock.now()))
                told = True
            clock.sleep(timing.poll)


def _watch(follower: ScanFollower, clock: Clock, timing: FollowTiming, should_stop: Callable[[], bool]) -> bool:
    """Take views and fit, in turns, until the scan has ended (True) or a stop finds views enough for a volume (False).

    Raises:
        DataError: the scan died. KeyboardInterrupt: a stop, before there were views enough.
    """
    last_snapshot = clock.now()
    writer = WriterWatch(follower.source.path, last_snapshot, timing.patience)
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
                f"and with --unfinished the {follower.views.n} views that are there are used."
            )
        follower.draw_slices(timing.picture)
        if not follower.advance(timing.slice):
            clock.sleep(timing.poll)
        elif clock.now() - last_snapshot >= timing.snapshot:
            follower.write_snapshot()
            last_snapshot = clock.now()
        follower.ask_whether_enough()
