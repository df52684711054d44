"""A scan that grows while it is followed; both use the test's clock, so that nothing waits in real time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from beamline.core.events import Event
from beamline.core.sinks import Warnings
from beamline.monitor.check import Flag, Level
from beamline.monitor.checks import CHECKS
from beamline.monitor.digest import digest
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.reconstruct.followed_views import FollowedViews
from beamline.reconstruct.live_fit import ScanFollower
from beamline.reconstruct.live_states import LiveScan
from beamline.reconstruct.options import FollowTiming, OutputPaths, ReconOptions
from beamline.storage.readers.open import SourceOptions
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.frame import Frame
from recon.splatting.r2 import R2
from tests.beamline.scans import TwoCylinders
from tests.clock import SteppedClock

EPOCH = 1.8e9
TICK = 0.02  # s that pass each time the clock is read


class ScanClock(SteppedClock):
    def __init__(self) -> None:
        super().__init__(EPOCH, TICK)


class StandingClock:
    def now(self) -> float:
        return EPOCH

    def sleep(self, seconds: float) -> None:
        pytest.fail("nobody should wait for this clock")


SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(2, 40), pixel_size_mm=0.5)
INTERLACED = replace(SCAN, angles=np.concatenate([SCAN.angles[i::3] for i in (0, 2, 1)]))
RHYTHM = FollowTiming(poll=0.1, slice=0.3, snapshot=0.4, patience=3.0)


def schedule(
    clock: ScanClock,
    path: Path,
    frames: list[Frame],
    *,
    begin: float = 0.5,
    period: float = 0.1,
    status: str | None = "complete",
    axis_col: float | None = None,
    pause: float = 0.0,
    flags: Mapping[int, Flag] = MappingProxyType({}),
    passes: Sequence[int] = (),
    **info: Any,
) -> None:
    """Schedule the scan: its file appears after `begin` s, gets a frame every `period` s, ends `pause` s after the
    last.

    status None: it never ends. `flags`: flags, by the row with which they are written. `passes`: rows at the ends of
    passes of a scan that decides. `info`: information in the file.
    """
    writers: list[NXtomoWriter] = []
    of_file = ScanInfo(sample="two cylinders", pixel_size_mm=0.5, axis_col=axis_col, decides=bool(passes), **info)

    def create() -> None:
        writers.append(NXtomoWriter(path, of_file, frames[0].counts.shape, clock=StandingClock()))

    def append(frame: Frame) -> Callable[[], None]:
        said = [flags[frame.index]] if frame.index in flags else []

        def write() -> None:
            writers[0].append(frame, digest(frame.counts), said)
            if frame.index + 1 in passes:
                writers[0].end_pass()

        return write

    start = clock.time + begin
    clock.due.append((start, create))
    clock.due += [(start + period * (i + 1), append(frame)) for i, frame in enumerate(frames)]
    end = start + period * (len(frames) + 1) + pause
    if status is not None:
        clock.due.append((end, lambda: writers[0].close(status)))
    else:
        clock.due.append((end, lambda: writers[0]._file.lock.release()))  # the lock of a dead program is released
        # Hours later, so that the file is closed when the test is over.
        clock.due.append((end + 1e5, lambda: writers[0].close("failed")))


def alarms(*frames: int) -> dict[int, Flag]:
    return {frame: Flag(CHECKS[0].name, Level.ALARM, frame, 1.0, 0.0, "") for frame in frames}


FIT = R2(seconds=2.0, gaussians=200)
BRIEF = R2(seconds=0.3, gaussians=100)  # for tests that do not check the voxels


def options(tmp_path: Path, **changes: object) -> ReconOptions:
    output = tmp_path / "recon.h5"
    usual = ReconOptions(
        source=SourceOptions(tmp_path / "scan.h5"),
        target=OutputPaths(output, None),
        selection=Selection(axis_col=SCAN.axis_col),
        method=FIT,
        follow=RHYTHM,
        command="beamline recon scan.h5 --follow",
    )
    return replace(usual, **changes)  # type: ignore[arg-type]


def close(clock: ScanClock) -> None:
    """Run the rest of the schedule."""
    clock.sleep(1e6)


def follower_of(options: ReconOptions, clock: ScanClock, events: list[Event]) -> ScanFollower:
    """Of the scan of these options, whose events are added to the list. Nobody closes its file."""
    views = FollowedViews(select(options.source.open(follow=True), options.selection))
    warn = Warnings(events.append, clock)
    live = LiveScan(options.streaming, options.seed, views, events.append, clock, warn, begin=clock.now())
    return ScanFollower(live, options.target)
