"""The writer on a full, failing or hanging disk: what is reported, what is safe, what stays readable."""

from __future__ import annotations

import errno
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import h5py
import pytest

from beamline.core.errors import DataError
from beamline.storage import disk_file
from beamline.storage.readers.open import open_scan
from beamline.storage.writers import layout, nxtomo
from beamline.storage.writers.nxtomo import NXtomoWriter
from beamline.storage.writers.rows import Rows, put_exchange_view
from drivers.base.frame import Frame
from tests.beamline.storage.conftest import INFO, SHAPE, append
from tests.clock import SteppedClock
from tests.messages import refused


def test_a_full_disk_is_named_and_earlier_rows_stay(
    writer: NXtomoWriter, tmp_path: Path, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    append(writer, frames[0])
    full = Mock(side_effect=OSError(28, "No space left on device"))
    with monkeypatch.context() as patch:
        patch.setattr(Rows, "write", full)
        with pytest.raises(DataError, match=r"store the frame in .*s\.h5.*No space left.*are free.*first 1 frames"):
            append(writer, frames[1])
    with refused(DataError):
        append(writer, frames[1])
    writer.close()
    assert not writer.remarks
    with open_scan(tmp_path / "s.h5") as source:
        assert (source.refresh(), source.finished, source.attributes["status"]) == (1, True, "failed")


def test_a_disk_that_takes_no_end_of_a_pass_is_named_and_the_frames_stay(
    tmp_path: Path, frames: list[Frame], clock: SteppedClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = NXtomoWriter(tmp_path / "s.h5", replace(INFO, decides=True), SHAPE, clock=clock)
    append(writer, *frames[:3])
    with monkeypatch.context() as patch:
        patch.setattr(h5py.Dataset, "resize", Mock(side_effect=OSError(28, "No space left on device")))
        with pytest.raises(DataError, match=r"store the end of a pass in .*s\.h5.*No space left.*first 3 frames"):
            writer.end_pass()
    writer.add_decision({"choice": "next"})  # nothing more is written
    writer.close()
    with open_scan(tmp_path / "s.h5") as source:
        assert (source.refresh(), source.attributes["status"], source.table.pass_ends.size) == (3, "failed", 0)
        assert source.decisions == ()


def no_room(call: str = "take") -> RuntimeError:
    """As h5py tells of a full disk where it has no number for it."""
    return RuntimeError(
        f"Can't {call} (file write failed: time = Fri Nov 20 06:31:51 2026\n, filename = 'scan.h5', "
        "file descriptor = 5, errno = 28, error message = 'No space left on device', buf = 0x5, offset = 7)"
    )


def test_after_a_full_disk_another_process_reads_what_was_committed(
    tmp_path: Path, clock: SteppedClock, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "s.h5"
    writer = NXtomoWriter(path, INFO, SHAPE, clock=clock)
    append(writer, *frames[:2])
    full = Mock(side_effect=no_room())
    with monkeypatch.context() as patch:
        patch.setattr(Rows, "write", full)
        with pytest.raises(DataError, match=r"left on device\)"):
            append(writer, frames[2])
        patch.setattr(h5py.File, "flush", full)
        writer.close()
    code = (
        "import sys; from beamline.storage.readers.open import open_scan\n"
        "with open_scan(sys.argv[1]) as s: "
        "print(len(s.table), s.finished, s.attributes['status'], s.read([1]).sum())"
    )
    said = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True).stdout
    assert said.split() == ["2", "True", "failed", str(frames[1].counts.sum())]


def test_a_disk_that_is_full_when_the_scan_ends_is_named(
    writer: NXtomoWriter, tmp_path: Path, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    append(writer, frames[0])
    full = Mock(side_effect=no_room())
    with monkeypatch.context() as patch:
        patch.setattr(h5py.File, "flush", full)
        with pytest.raises(DataError, match=r"s\.h5.*first 1 frames"):
            writer.close()
    writer.close()
    with open_scan(tmp_path / "s.h5") as source:
        assert (source.refresh(), source.finished, source.attributes["status"]) == (1, True, "failed")


def test_no_view_is_begun_where_there_is_no_room_for_it(
    writer: NXtomoWriter, tmp_path: Path, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    append(writer, frames[0])
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=500))
    writer.close()
    assert len(writer.remarks) == 1
    assert "no /exchange view: " in writer.remarks[0]
    assert re.search(
        r"has 500 B free, but \S+ MB are needed to add the /exchange view.*1 frames are safe", writer.remarks[0]
    )
    with h5py.File(tmp_path / "s.h5") as file:
        assert list(file["exchange"]) == []
        assert file[layout.STATUS][()] == b"complete"


def test_what_close_changes_after_the_last_frame_is_nothing_that_frames_hang_on(
    tmp_path: Path, clock: SteppedClock, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The /exchange view comes to an ordinary file: but for the head and the group, it only makes it longer."""
    before, changed = [b""], tmp_path / "s.h5"
    writer = NXtomoWriter(changed, INFO, SHAPE, clock=clock)
    append(writer, *frames)
    view_of = put_exchange_view

    def look_first(path: Path) -> None:
        with h5py.File(path) as file:  # closed, in order, for any program
            assert len(file[layout.DATA]) == len(frames)
        before[0] = path.read_bytes()
        view_of(path)

    monkeypatch.setattr(nxtomo, "put_exchange_view", look_first)
    writer.close()
    after = changed.read_bytes()
    with h5py.File(changed) as file:
        group = h5py.h5o.get_info(file["exchange"].id).addr
    differ = [i for i, (old, new) in enumerate(zip(before[0], after, strict=False)) if old != new]
    assert differ and all(i < 48 or group <= i < group + 160 for i in differ)


def test_a_file_that_the_disk_has_no_room_for_is_not_left_half_made(
    tmp_path: Path, clock: SteppedClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = Mock(side_effect=no_room())

    monkeypatch.setattr(layout, "create", full)
    with refused(DataError):
        NXtomoWriter(tmp_path / "s.h5", INFO, SHAPE, clock=clock)
    assert list(tmp_path.iterdir()) == []


def test_what_was_flushed_is_brought_to_the_disk_and_at_the_end_all(
    tmp_path: Path, clock: SteppedClock, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, begun = [], threading.Event()

    def fsync(handle: int) -> None:
        calls.append((handle, writer.rows))
        begun.set()

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(disk_file, "SECONDS", 0.0)
    with NXtomoWriter(tmp_path / "s.h5", INFO, SHAPE, clock=clock) as writer:
        handle = writer._file.file.id.get_vfd_handle()
        for frame in frames:
            begun.clear()
            append(writer, frame)
            assert begun.wait(60.0)
    assert [rows for _, rows in calls[:14]] == list(range(1, 15))
    assert (handle, 14) in calls[14:]  # before the file is closed; then comes the /exchange view


def test_a_disk_that_did_not_take_what_was_flushed_is_told(
    tmp_path: Path, clock: SteppedClock, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []

    def fsync(handle: int) -> None:
        calls.append(handle)
        if len(calls) == 4:
            raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(disk_file, "SECONDS", 0.0)
    writer = NXtomoWriter(tmp_path / "s.h5", INFO, SHAPE, clock=clock)
    with pytest.raises(DataError, match=r"store the frame .*Input/output error.*first 3 frames"):
        for frame in frames:
            append(writer, frame)
            if (thread := writer._file._to_disk._thread) is not None:
                thread.join()
    assert (writer.committed, writer.safe) == (5, 3)  # of the other two nobody knows
    writer.close("failed")


def test_a_disk_that_hangs_does_not_hold_the_writer(
    tmp_path: Path, clock: SteppedClock, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    hangs = threading.Event()
    calls: list[int] = []

    def fsync(handle: int) -> None:
        calls.append(handle)
        hangs.wait(10.0)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(disk_file, "SECONDS", 0.0)
    writer = NXtomoWriter(tmp_path / "s.h5", INFO, SHAPE, clock=clock)
    append(writer, *frames)
    assert (writer.committed, len(calls)) == (14, 1)
    hangs.set()
    writer.close()
    assert len(calls) > 2


def test_rows_before_a_disk_that_takes_no_more_pixels_are_committed(
    tmp_path: Path, clock: SteppedClock, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    full = Mock(side_effect=OSError(28, "No space left on device"))

    writer = NXtomoWriter(tmp_path / "s.h5", INFO, SHAPE, clock=clock, flush_every=9)
    append(writer, *frames[:3])
    assert writer.committed == 0
    monkeypatch.setattr(Rows, "write", full)
    with pytest.raises(DataError, match="first 3 frames"):
        append(writer, frames[3])
    writer.close("failed")
    with open_scan(tmp_path / "s.h5") as source:
        assert source.refresh() == 3
        assert all((source.read([i])[0] == frames[i].counts).all() for i in range(3))
        assert source.table.angles[:3] == pytest.approx([frame.angle for frame in frames[:3]], nan_ok=True)


def _cut(path: Path) -> None:
    os.truncate(path, 0)


def _cut_in_half(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows lets nobody touch a file that is open")
@pytest.mark.parametrize("at", [5, 14])
@pytest.mark.parametrize(("touch", "said"), [(_cut, "to 0 bytes"), (_cut_in_half, "was cut"), (Path.unlink, "deleted")])
def test_a_file_that_another_program_touches_ends_the_scan(
    writer: NXtomoWriter, frames: list[Frame], touch: Callable[[Path], None], said: str, at: int
) -> None:
    """HDF5 writes on, so that nothing else tells: a cut file is a hole at its beginning, with the size that it had."""
    with pytest.raises(DataError, match=f"was writing it .*{said}"):
        for frame in frames:
            if frame.index == at:
                touch(writer.path)
            append(writer, frame)
        touch(writer.path)
        writer.close()
    writer.close("failed")
