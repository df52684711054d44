"""Runs whose parts end one after another, and the required content of their files."""

from __future__ import annotations

import errno
import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import pytest

from beamline.core.errors import BeamlineError, DataError
from beamline.core.files import JOINED, parts_of
from beamline.core.stop import StopRequest
from beamline.features.files.validate import validate
from beamline.scan.resume import open_for_resume
from beamline.scan.run import run_scan
from beamline.storage import parts
from beamline.storage.hdf5 import open_hdf5
from beamline.storage.readers.open import open_scan
from beamline.storage.writer_lock import QUIET
from beamline.storage.writers import layout
from beamline.storage.writers.rows import Rows
from drivers.base.errors import DeviceError
from drivers.base.frame import Frame, FrameKind
from tests.beamline.fakes import FakeInstrument, Faults, assert_true
from tests.beamline.ran import killed, small

FIRST = 5  # 3 darks and 2 flats
VIEWS = 12
START, DARKS, VIEW, END, LAST = 0, 2, FIRST + 2, FIRST + 4, FIRST + VIEWS  # frames of a part at which it can end


MODES = {
    "fly": ("scan.mode=fly",),
    "step": ("scan.mode=step",),
    "interlaced": ("scan.mode=fly", "scan.angles={scheme: interlaced, views: 12, passes: 2}"),
    "backwards": ("scan.mode=fly", "scan.angles={scheme: fixed, views: 12, start_deg: 90, span_deg: -180}"),
}
ENDS = "stopped", "aborted", "failed", "killed", "full", "lossy", "unjoined"


class Chain:
    """A run whose parts end one after another; `end` takes the next part, which ends in a given way at a given
    frame."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch, mode: str = "fly") -> None:
        self.folder, self.patch = folder, patch
        self.config = small("scan.flats.at=both", *MODES[mode])

    @property
    def run(self) -> Path:
        (run,) = self.folder.iterdir()
        return run

    def take(self, instrument: FakeInstrument, stop: StopRequest, at_start: bool = False) -> None:
        """Take the next part of the run, however it ends."""
        started = (lambda event: stop.stop() if event.event == "run_started" else None) if at_start else None
        sinks = [] if started is None else [started]
        devices = instrument.connected()
        if not self.folder.exists():
            run_scan(self.config, self.folder, sinks, stop, instrument=devices)
            return
        instrument.clock.sleep(1000.0 * len(parts_of(self.run)))
        with open_for_resume(self.run) as series:
            run_scan(series.config, series, sinks, stop, instrument=devices)

    def end(self, how: str, at: int) -> None:
        with suppress(BeamlineError, DeviceError):
            getattr(self, f"_{how}")(at)
        for part in self.run.rglob("scan.h5"):  # make the files look older
            when = part.stat().st_mtime - 2 * QUIET
            os.utime(part, (when, when))

    def _stopped(self, at: int, abort: bool = False) -> None:
        stop = StopRequest()
        instrument = FakeInstrument(at={at: stop.abort if abort else stop.stop})
        self.take(instrument, stop, at_start=at == START)

    def _aborted(self, at: int) -> None:
        self._stopped(at, abort=True)

    def _failed(self, at: int) -> None:
        """A device fails."""
        self.take(FakeInstrument(Faults(errors={at: 99})), StopRequest())

    def _lossy(self, at: int) -> None:
        """It runs to its end and loses projections: two neighbours, and the last one."""
        self.take(FakeInstrument(Faults(lost={at}, ignored={at + 1, FIRST + VIEWS - 1})), StopRequest())

    def _killed(self, at: int) -> None:
        """As after kill -9: the newest part is marked as being written, the joined file is unchanged."""
        with killed(self.patch), self._joined_stays():
            self._aborted(at)

    def _full(self, at: int) -> None:
        """From one frame on the disk is full; the file is never closed, as in a process that has ended."""
        reached = False

        def write(table: Rows, frame: Frame, *given: Any) -> None:
            nonlocal reached
            if frame.index == at:
                reached = True
                raise OSError(errno.ENOSPC, "No space left on device")
            usual(table, frame, *given)

        usual = Rows.write
        with self.patch.context() as patch:
            patch.setattr(Rows, "write", write)
            try:
                self.take(FakeInstrument(), StopRequest())
            except DataError as refused:
                assert reached and "No space left" in str(refused)
        if not reached:  # flats and darks at the end alone are fewer frames
            return
        part = parts_of(self.run)[-1] / "scan.h5"
        shutil.copy(part, part.with_name("died.h5"))
        part.with_name("died.h5").replace(part)

    def _unjoined(self, at: int) -> None:
        """As after kill -9 while the parts are joined."""
        with self._joined_stays():
            self._aborted(at)

    def _unjoined_whole(self, at: int) -> None:
        with self._joined_stays():
            self.take(FakeInstrument(), StopRequest())

    def _joined_stays(self) -> _Stays:
        return _Stays(self.run / JOINED if self.folder.exists() else None)


class _Stays:
    """Restores a file at the end of the context."""

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.before = path.read_bytes() if path is not None and path.exists() else None

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None:
        if self.path is not None:
            self.path.unlink(missing_ok=True)
            if self.before is not None:
                self.path.write_bytes(self.before)


def rows_of(run: Path) -> list[tuple[int, int]]:
    """Kind and trigger of the committed frames of all parts, from their files."""
    found: list[tuple[int, int]] = []
    for part in parts_of(run):
        if parts.may_hold_frames(part / "scan.h5"):
            with open_hdf5(part / "scan.h5") as file:
                n = int(file[layout.COMMITTED][()])
                found += zip(file[layout.KIND][:n].tolist(), file[layout.TRIGGER][:n].tolist(), strict=True)
    return found


def views_of(run: Path) -> list[int]:
    return sorted(trigger for kind, trigger in rows_of(run) if kind == FrameKind.PROJECTION)


def assert_whole(path: Path) -> None:
    """Assert that the file has each projection once, with the right angle and pixels, and all other frames of the
    parts."""
    with open_scan(path) as source:
        frames = list(source.frames())
    assert_true(frames)
    assert sorted((int(frame.kind), frame.trigger) for frame in frames) == sorted(rows_of(path.parent))
    assert views_of(path.parent) == list(range(VIEWS))
    assert [finding.message for finding in validate(path, lambda done, of: None) if finding.severity == "error"] == []
    with h5py.File(path) as file:  # as another program reads it
        assert len(file["exchange/data"]) == VIEWS
