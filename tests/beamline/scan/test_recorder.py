"""The recorder writes every frame in order or says why it cannot; the camera never waits for a dead disk."""

import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamline.core.errors import DataError
from beamline.core.events import Event
from beamline.core.stop import ScanAborted, StopRequest
from beamline.monitor.check import Flag, ScanContext
from beamline.monitor.digest import FrameDigest
from beamline.monitor.watch import start
from beamline.scan import backlog, frame_checks, measurement
from beamline.scan import recorder as module
from beamline.scan.flagged import FlaggedFrames
from beamline.scan.recorder import Recorder
from beamline.storage.readers.open import open_scan
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.frame import Frame, FrameKind
from tests.beamline.fakes import FakeInstrument, Faults
from tests.beamline.ran import Ran
from tests.messages import refused

TIMELINE = FakeInstrument().timeline()


class Writer:
    """Keeps the rows it was given; `before` is called with each row first, and may wait or raise."""

    def __init__(self, before: Callable[[int], object] = lambda row: None) -> None:
        self.path = Path("runs/scan.h5")
        self.rows: list[int] = []
        self.flushed: list[int] = []  # rows at each flush
        self._before = before

    @property
    def safe(self) -> int:
        return len(self.rows)

    def append(self, frame: Frame, digest: FrameDigest, flags: object = ()) -> None:
        self._before(frame.index)
        assert digest.mean == frame.index
        self.rows.append(frame.index)

    def flush(self) -> None:
        self.flushed.append(len(self.rows))


def record(writer: Any, sink: Callable[[Event], None] = lambda event: None, **more: Any) -> Recorder:
    return Recorder(writer, start(ScanContext(65535, 4, period=1.0)), TIMELINE, preview_bin=2, sink=sink, **more)


def frame(row: int) -> Frame:
    counts = np.full((2, 2), row, np.uint16)
    return Frame(counts, FrameKind.PROJECTION, row, row, row, 0.0, 1.8e9 + row, 0.1)


@settings(max_examples=15, deadline=None)
@given(n=st.integers(0, 60), room=st.integers(1, 4))
def test_every_frame_is_written_in_order_however_little_room_there_is(n: int, room: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(backlog, "WAITING_FRAMES", (room, room))
        recorder = record(writer := Writer())
        for row in range(n):
            recorder.put(frame(row))
        recorder.finish()
    assert writer.rows == list(range(n))
    assert recorder.n_frames == n
    assert not recorder.hangs


@pytest.mark.parametrize("at", [0, 3])
def test_a_failure_reaches_whoever_waits_for_room_and_nothing_is_written_after_it(
    monkeypatch: pytest.MonkeyPatch, at: int
) -> None:
    monkeypatch.setattr(backlog, "WAITING_FRAMES", (1, 1))
    go = threading.Event()

    def fail(row: int) -> None:
        if row == at:
            go.wait(30)
            raise OSError(28, "No space left on device")

    recorder = record(writer := Writer(fail))
    with pytest.raises(DataError, match=f"No space left.*{at} frames.*scan.h5") as caught:
        for row in range(99):
            if row == at + 2:  # one frame fails, one waits: this one finds no room
                go.set()
            recorder.put(frame(row))
    assert isinstance(caught.value.__cause__, OSError)
    with refused(DataError):
        recorder.finish()
    assert writer.rows == list(range(at))


def test_frames_before_one_that_cannot_be_digested_are_written() -> None:
    slow = threading.Event()
    recorder = record(writer := Writer(lambda row: slow.wait(30) if row == 0 else None))
    for row in range(3):
        recorder.put(frame(row))
    recorder.put(replace(frame(3), counts=np.zeros((2, 2, 2), np.uint16)))
    slow.set()
    with refused(DataError):
        recorder.finish()
    assert writer.rows == [0, 1, 2]


def test_a_frame_that_comes_alone_is_flushed_at_once_and_others_when_none_waits() -> None:
    slow = threading.Event()
    recorder = record(writer := Writer(lambda row: slow.wait(30) if row == 1 else None))
    recorder.put(frame(0))
    recorder.wait()
    assert writer.flushed == [1]
    for row in range(1, 9):
        recorder.put(frame(row))
    assert writer.flushed == [1]
    slow.set()
    recorder.wait()
    assert writer.flushed[-1] == 9
    recorder.finish()


def hanging(monkeypatch: pytest.MonkeyPatch, hang: Callable[[], object]) -> None:
    """The disk does not answer when the seventh frame is written."""

    class Hanging(NXtomoWriter):
        def append(self, frame: Frame, digest: FrameDigest, flags: Sequence[Flag] = ()) -> None:
            if frame.index == 6:
                hang()
            super().append(frame, digest, flags)

    monkeypatch.setattr(measurement, "NXtomoWriter", Hanging)


def test_a_disk_that_hangs_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = threading.Event()
    hanging(monkeypatch, lambda: free.wait(60))
    monkeypatch.setattr(module, "STALL", 0.05)
    monkeypatch.setattr(backlog, "WAITING_FRAMES", (2, 2))
    try:
        ran = Ran(tmp_path, FakeInstrument())
    finally:
        free.set()
    assert isinstance(ran.error, DataError)
    assert re.search(r"accepted no frame for 0\.05 s.*first [0-6] frames.*scan\.h5", str(ran.error)), ran.error
    ran.assert_safe()


def test_an_abort_does_not_wait_for_a_disk_that_hangs_and_no_frame_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free, stop, seconds = threading.Event(), StopRequest(), list[float]()

    def hang() -> None:
        threading.Timer(0.3, stop.abort).start()  # when the scan waits for room
        free.wait(60)

    def safe() -> None:
        if stop.aborting:
            seconds.append(stop.seconds)
            free.set()

    hanging(monkeypatch, hang)
    monkeypatch.setattr(backlog, "WAITING_FRAMES", (2, 2))
    instrument = FakeInstrument()
    monkeypatch.setattr(instrument.devices.shutter, "close", safe)
    ran = Ran(tmp_path, instrument, "scan.mode=step", stop=stop)
    assert type(ran.error) is ScanAborted and 0 < seconds[-1] < 2
    with open_scan(tmp_path / ran.folder / "scan.h5") as source:
        assert len(source.table.kinds) == instrument.camera.number


def test_flags_are_stored_with_the_row_and_told_once(tmp_path: Path) -> None:
    ran = Ran(tmp_path, FakeInstrument(Faults(repeats={9, 10, 11})))
    assert ran.result.flags == {"stuck": {"alarm": 3}}
    assert ran.result.alarmed_frames == ran.of("scan_done")[0].data["alarmed_frames"] == 3
    assert [(e.data["check"], e.data["frame"], e.data["level"]) for e in ran.of("flag")] == [("stuck", 9, "alarm")]
    with h5py.File(ran.folder / "scan.h5") as file:
        flags = file["entry/frame_log/flags"][()]
    assert np.flatnonzero(flags).tolist() == [9, 10, 11]
    assert flags[9] == (1 << 2) | (1 << 18)


def test_a_monitor_with_a_defect_costs_no_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("defect")

    monkeypatch.setattr(frame_checks, "look_past_failures", broken)
    ran = Ran(tmp_path, FakeInstrument())
    assert ran.error is None
    ran.assert_good_file(19, "complete")
    off, unjudged = ran.warnings
    assert "monitor failed at frame 0" in off and "did not check 19 frames (0-18)" in unjudged


@pytest.mark.parametrize("checks", [(), ("timing",), ("blur",)])
def test_views_with_a_warning_are_to_be_taken_again_where_the_check_is_named(checks: tuple[str, ...]) -> None:
    flagged = FlaggedFrames(lambda event: None, retaken_warnings=frozenset(checks))
    recorder = record(Writer(), flagged=flagged)
    for row in range(9):
        recorder.put(replace(frame(row), time=1.8e9 + row + (0.4 if row == 5 else 0.0)))
    recorder.finish()
    late = [view.row for view in flagged.views_to_retake]
    assert late == ([5, 6] if checks == ("timing",) else [])  # late, and the next one early after it
    assert len(flagged.alarmed_views) == 0
