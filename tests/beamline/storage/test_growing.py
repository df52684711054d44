"""A growing file: followed by others, left by a killed writer, locked by another program."""

from __future__ import annotations

import multiprocessing
import os
from multiprocessing.synchronize import Event
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.features.files.ingest import ingest
from beamline.storage.readers.open import NotReadyError, open_scan
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.clock import SystemClock
from drivers.base.frame import Frame
from tests.beamline.storage.conftest import INFO, SHAPE, append, scan_frames
from tests.clock import SteppedClock
from tests.messages import refused


def test_followers_see_frames_when_they_are_flushed(tmp_path: Path, clock: SteppedClock, frames: list[Frame]) -> None:
    writer = NXtomoWriter(tmp_path / "s.h5", INFO, SHAPE, clock=clock, flush_every=3)
    with open_scan(tmp_path / "s.h5", follow=True) as source:
        seen = []
        for frame in frames[:8]:
            append(writer, frame)
            seen.append(source.refresh())
        assert seen == [0, 0, 3, 3, 3, 6, 6, 6]
        assert writer.committed == 6
        assert not source.finished
        with refused(IndexError):
            source.read([6])
        np.testing.assert_array_equal(source.read(slice(None)), [frame.counts for frame in frames[:6]])
        np.testing.assert_array_equal(source.table.kinds, [2, 2, 1, 1, 1, 0])
    writer.close()


def write_and_wait(path: Path, written: Event) -> None:
    """In another process: seven frames, the last two not flushed, then wait to be killed."""
    writer = NXtomoWriter(path, INFO, SHAPE, clock=SystemClock(), flush_every=5)
    append(writer, *scan_frames(np.random.default_rng(5))[:7])
    written.set()
    multiprocessing.get_context("spawn").Event().wait()


@pytest.mark.slow
def test_a_killed_writer_leaves_the_flushed_frames(tmp_path: Path) -> None:
    spawn = multiprocessing.get_context("spawn")
    written = spawn.Event()
    writer = spawn.Process(target=write_and_wait, args=(tmp_path / "s.h5", written))
    writer.start()
    assert written.wait(60)
    writer.kill()
    writer.join(60)
    expected = scan_frames(np.random.default_rng(5))[:5]
    for follow in (True, False):
        with open_scan(tmp_path / "s.h5", follow=follow) as source:
            assert source.refresh() == 5
            assert not source.finished
            for found, frame in zip(source.frames(), expected, strict=True):
                np.testing.assert_array_equal(found.counts, frame.counts)
                assert (found.kind, found.trigger, found.time) == (frame.kind, frame.trigger, frame.time)
    os.utime(tmp_path / "s.h5", (0, 0))  # its writer died long ago
    ingest(tmp_path / "s.h5", tmp_path / "rescued.h5")
    with open_scan(tmp_path / "rescued.h5") as source:
        assert source.finished
        assert [frame.time for frame in source.frames()] == [frame.time for frame in expected]


def hold_open(path: Path, opened: Event, released: Event) -> None:
    """In another process: a viewer that keeps the file open, with HDF5's own lock."""
    with h5py.File(path, "r", swmr=True):
        opened.set()
        released.wait()


def test_another_programs_lock_costs_nothing(tmp_path: Path, clock: SteppedClock, frames: list[Frame]) -> None:
    spawn = multiprocessing.get_context("spawn")
    opened, released = spawn.Event(), spawn.Event()
    writer = NXtomoWriter(tmp_path / "s.h5", INFO, SHAPE, clock=clock)
    append(writer, frames[0])
    viewer = spawn.Process(target=hold_open, args=(tmp_path / "s.h5", opened, released))
    viewer.start()
    assert opened.wait(60)
    writer.close()
    released.set()
    viewer.join(60)
    assert writer.remarks == []
    with open_scan(tmp_path / "s.h5") as source:
        assert (source.refresh(), source.finished, source.attributes["status"]) == (1, True, "complete")
    with h5py.File(tmp_path / "s.h5") as file:
        assert list(file["exchange"]) == ["data_dark", "theta_dark"]


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("missing", [1, 1000])
def test_a_file_that_is_cut_off_is_refused_at_once(
    tmp_path: Path, clock: SteppedClock, frames: list[Frame], missing: int, closed: bool
) -> None:
    """Under SWMR, which opens a file whose writer died, HDF5 would wait for the missing bytes for hours."""
    with NXtomoWriter(tmp_path / "s.h5", INFO, SHAPE, clock=clock) as writer:
        append(writer, *frames)
        if not closed:
            (tmp_path / "cut.h5").write_bytes((tmp_path / "s.h5").read_bytes()[:-missing])
    if closed:
        (tmp_path / "cut.h5").write_bytes((tmp_path / "s.h5").read_bytes()[:-missing])
    with refused(DataError):
        open_scan(tmp_path / "cut.h5")
    with refused(NotReadyError):
        open_scan(tmp_path / "cut.h5", follow=True)
