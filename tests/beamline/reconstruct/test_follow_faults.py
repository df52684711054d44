"""A fault around a followed scan costs less than 0.3 dB, compared with an undisturbed fit to the same projections."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Mapping
from dataclasses import replace
from multiprocessing.synchronize import Event as ProcessEvent
from pathlib import Path

import numpy as np
import pytest

from beamline.core.events import Event
from beamline.features.files.ingest import ingest
from beamline.monitor.check import Flag
from beamline.monitor.digest import digest
from beamline.reconstruct.options import OutputPaths, ReconOptions
from beamline.reconstruct.pipeline import reconstruct_file
from beamline.storage.readers.open import SourceOptions
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from beamline.storage.writers.recon_file import read_reconstruction
from drivers.base.clock import Clock, SystemClock
from drivers.base.frame import Frame
from recon.assess.metrics import psnr
from tests.beamline.reconstruct.growing_scan import (
    FIT,
    INTERLACED,
    SCAN,
    ScanClock,
    StandingClock,
    alarms,
    options,
    schedule,
)  # fmt: skip
from tests.beamline.scans import frames_of

pytestmark = pytest.mark.usefixtures("one_thread")

INFO = ScanInfo(sample="two cylinders", pixel_size_mm=0.5)
ALLOWED = 0.3  # dB


def _options(file: Path) -> ReconOptions:
    target = OutputPaths(file.with_name(f"{file.stem}_recon.h5"), None)
    return options(file.parent, source=SourceOptions(file), target=target, method=replace(FIT, seconds=4.0))


def _numbered(frames: list[Frame]) -> list[Frame]:
    return [replace(frame, index=k) for k, frame in enumerate(frames)]


def _quality(file: Path, clock: Clock, events: list[Event] | None = None) -> float:
    """PSNR in dB of what is made of a file that is followed."""
    wanted = _options(file)
    reconstruct_file(wanted, ([] if events is None else events).append, clock)
    volume = read_reconstruction(wanted.target.output).volume
    return psnr(SCAN.truth(volume.grid), volume.data)


def _followed(path: Path, frames: list[Frame], period: float, flags: Mapping[int, Flag], events: list[Event]) -> float:
    clock = ScanClock()
    schedule(clock, path, frames, begin=0.0, period=period, flags=flags)
    return _quality(path, clock, events)


def _spoiled(frames: list[Frame], bad: set[int]) -> list[Frame]:
    return [replace(f, counts=f.counts // 40) if f.index in bad else f for f in frames]


@pytest.mark.slow
def test_views_that_are_flagged_after_the_model_has_learnt_them(tmp_path: Path) -> None:
    frames, bad = frames_of(INTERLACED), set(range(18, 23))
    good = _numbered([frame for frame in frames if frame.index not in bad])
    undisturbed = _followed(tmp_path / "good.h5", good, 0.1, {}, [])
    events = list[Event]()
    # A later check: its finding comes with row 30, and holds for the rows 18 to 22 before it.
    found = {30: replace(alarms(22)[22], first=18)}
    late = _followed(tmp_path / "late.h5", _spoiled(frames, bad), 0.1, found, events)
    assert any("The fit continues without 5 projections" in str(event.data.get("message")) for event in events)
    assert late > undisturbed - ALLOWED


def _write_and_wait(path: Path, written: ProcessEvent) -> None:
    """In another process: most of a scan, then wait to be killed."""
    writer = NXtomoWriter(path, INFO, INTERLACED.shape, clock=SystemClock(), flush_every=3)
    for frame in frames_of(INTERLACED)[:26]:
        writer.append(frame, digest(frame.counts))
    written.set()
    multiprocessing.get_context("spawn").Event().wait()


@pytest.mark.slow
def test_a_writer_that_is_killed_leaves_views_as_good_as_those_of_a_scan_that_was_stopped(tmp_path: Path) -> None:
    spawn = multiprocessing.get_context("spawn")
    written = spawn.Event()
    writer = spawn.Process(target=_write_and_wait, args=(tmp_path / "died.h5", written))
    writer.start()
    assert written.wait(60)
    writer.kill()
    writer.join(60)
    os.utime(tmp_path / "died.h5", (0, 0))  # long ago
    ingest(tmp_path / "died.h5", tmp_path / "recovered.h5")
    with NXtomoWriter(tmp_path / "stopped.h5", INFO, INTERLACED.shape, clock=StandingClock()) as whole:
        for frame in frames_of(INTERLACED)[:24]:  # all that was flushed
            whole.append(frame, digest(frame.counts))
    recovered, stopped = (_quality(tmp_path / f"{name}.h5", ScanClock()) for name in ("recovered", "stopped"))
    assert recovered > stopped - ALLOWED
    frames = read_reconstruction(tmp_path / "recovered_recon.h5").parameters["view_frames"]
    np.testing.assert_array_equal(frames, np.arange(4, 24))
