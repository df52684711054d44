"""The file of a killed writer becomes an ordinary one with exactly the committed frames, for any program."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from unittest.mock import Mock

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.features.files.validate import validate
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.recover import recover
from beamline.storage.superblock import block_size, lookup3, superblock
from beamline.storage.writer_lock import QUIET, held
from beamline.storage.writers import layout, nxtomo
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.frame import Frame, FrameKind
from tests.beamline.storage.conftest import INFO, SHAPE, append, scan_frames
from tests.clock import SteppedClock
from tests.messages import refused


def _aged(path: Path) -> Path:
    """As if its writer had died a while ago."""
    when = path.stat().st_mtime - 2 * QUIET
    os.utime(path, (when, when))
    return path


def _written(path: Path, frames: list[Frame], clock: SteppedClock) -> NXtomoWriter:
    writer = NXtomoWriter(path, INFO, SHAPE, clock=clock, flush_every=5)
    append(writer, *frames)
    return writer


def _died_in_the_scan(folder: Path, frames: list[Frame], clock: SteppedClock) -> Path:
    """Two frames after the last flush."""
    writer = _written(folder / "s.h5", frames[:12], clock)
    shutil.copy(folder / "s.h5", folder / "died.h5")
    writer.close()
    return _aged(folder / "died.h5")


def _died_at_the_end(folder: Path, frames: list[Frame], clock: SteppedClock) -> Path:
    """Before the view of a complete scan was added, where another program then left its mark."""
    writer = _written(folder / "s.h5", frames[:10], clock)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nxtomo, "put_exchange_view", Mock(side_effect=DataError("Killed.")))
        writer.close()
    with h5py.File(folder / "s.h5", "r+", libver=layout.LIBVER) as file:
        file.flush()
        shutil.copy(folder / "s.h5", folder / "died.h5")
    return _aged(folder / "died.h5")


@pytest.mark.parametrize(
    ("died", "status"),
    [(_died_in_the_scan, "failed"), (_died_at_the_end, "complete")],
)
def test_every_committed_frame_is_kept(
    tmp_path: Path,
    clock: SteppedClock,
    frames: list[Frame],
    died: Callable[[Path, list[Frame], SteppedClock], Path],
    status: str,
) -> None:
    path = died(tmp_path, frames, clock)
    with refused(OSError):
        h5py.File(path)
    done = recover(path)
    assert (done.changed, done.frames) == (True, 10)
    with h5py.File(path) as file:  # as any program opens it
        assert {file[name].shape[0] for name in (layout.DATA, layout.PREVIEW, *layout.COLUMNS)} == {10}
        assert datetime.fromisoformat(file[layout.END_TIME].asstr()[()])
        assert len(file["exchange/data"]) == sum(frame.kind is FrameKind.PROJECTION for frame in frames[:10])
    with open_scan(path) as source:
        assert (source.finished, source.attributes["status"]) == (True, status)
        np.testing.assert_array_equal(source.read(slice(None)), [frame.counts for frame in frames[:10]])
    assert [found for found in validate(path) if found.severity == "error"] == []
    again = path.read_bytes()
    assert not recover(path).changed and path.read_bytes() == again


def test_what_may_still_be_written_is_left_alone(tmp_path: Path, clock: SteppedClock, frames: list[Frame]) -> None:
    writer = _written(tmp_path / "s.h5", frames[:5], clock)
    before = (tmp_path / "s.h5").read_bytes()
    _aged(tmp_path / "s.h5")  # its writer waits: for a motor, the operator, or a long exposure
    with refused(DataError):
        recover(tmp_path / "s.h5")
    assert (tmp_path / "s.h5").read_bytes() == before
    writer.close()
    assert not recover(tmp_path / "s.h5").changed


def test_what_a_dead_writers_file_says_otherwise_of_a_frame_is_named(
    tmp_path: Path, clock: SteppedClock, frames: list[Frame]
) -> None:
    _written(tmp_path / "s.h5", frames[:10], clock).close()
    with h5py.File(tmp_path / "s.h5", "r+", libver=layout.LIBVER) as file:
        file[layout.TIME][4] += 1
        file.flush()
        shutil.copy(tmp_path / "s.h5", tmp_path / "died.h5")
    done = recover(_aged(tmp_path / "died.h5"))
    assert (done.changed, done.altered) == (True, (4,))
    assert "10 frames recovered; records differ from the checksum stored with them: frame 4." in done.in_words()


@pytest.mark.parametrize("ahead", [1e3, 1e6])
def test_a_file_of_a_clock_that_is_ahead_is_recovered(
    tmp_path: Path, clock: SteppedClock, frames: list[Frame], ahead: float
) -> None:
    died = _died_in_the_scan(tmp_path, frames, clock)
    os.utime(died, (died.stat().st_atime, time.time() + ahead))
    assert recover(died).frames == 10


def test_a_file_that_just_changed_is_left_alone_where_no_lock_tells(
    tmp_path: Path, clock: SteppedClock, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where locks work, that of the writer has gone with it, and the file is recovered at once."""
    died = _died_in_the_scan(tmp_path, frames, clock)
    os.utime(died)
    monkeypatch.setattr("beamline.storage.recover.held", lambda path: None)
    with refused(DataError):
        recover(died)
    monkeypatch.undo()
    assert recover(died).frames == 10


def test_the_writers_lock_is_given_back_when_it_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "s.h5"
    path.write_bytes(bytes(64))
    code = (
        f"import sys, time; from pathlib import Path; from beamline.storage.writer_lock import WriterLock; "
        f"lock = WriterLock(Path({str(path)!r})); print('held', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as writer:
        assert writer.stdout is not None and writer.stdout.readline().strip() == b"held"
        assert held(path)
        with path.open("rb") as reader:  # reading goes on
            assert reader.read() == bytes(64)
        writer.kill()
    assert not held(path)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda data: data[:2000], "is damaged"),
        (lambda data: data[:20] + bytes([data[20] ^ 1]) + data[21:], "not an HDF5 file"),
        (lambda data: data[:48] + bytes(400) + data[448:], "is damaged"),
        (lambda data: b"", "not an HDF5 file"),
    ],
)
def test_a_damaged_file_is_refused_and_stays_as_it_is(
    tmp_path: Path, clock: SteppedClock, frames: list[Frame], damage: Callable[[bytes], bytes], said: str
) -> None:
    path = _died_in_the_scan(tmp_path, frames, clock)
    path.write_bytes(damage(path.read_bytes()))
    before = _aged(path).read_bytes()
    with pytest.raises(DataError, match=rf"{said}.*Nothing was changed"):
        recover(path)
    assert path.read_bytes() == before


def _torn(old: bytes, new: bytes) -> Iterator[bytes]:
    """Files whose writer was killed within the write of a block across the end of a page of memory."""
    for end in range(4096, len(old), 4096):
        begin = old.rfind(b"OHDR", end - 400, end)
        if end < begin + block_size(memoryview(old[begin:])) and old[begin:end] != new[begin:end]:
            yield old[:begin] + new[begin:end] + old[end:]


def test_a_block_that_a_kill_left_half_written_is_made_whole(
    tmp_path: Path, clock: SteppedClock, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, died, seen = tmp_path / "s.h5", tmp_path / "died.h5", 0
    writer = NXtomoWriter(path, INFO, SHAPE, clock=clock)
    for k, frame in enumerate(frames[:8]):
        if seen >= 5:
            break
        before = path.read_bytes()
        append(writer, frame)
        for torn in _torn(before, path.read_bytes()) if k else ():
            died.write_bytes(torn)
            with monkeypatch.context() as patched, refused(DataError):
                patched.setattr("beamline.storage.disk_file.mend_checksum", lambda at, read: None)
                recover(_aged(died))
            with open_scan(died) as source:  # while HDF5 itself would wait for ever for a writer to end the block
                assert len(source.table) == k
            done = recover(died)
            assert (done.frames, done.damaged, done.altered) == (k, (), ())
            with open_scan(died) as source:
                assert all((source.read([i])[0] == frames[i].counts).all() for i in range(k))
            seen += 1
    writer.close()
    assert seen >= 5


def test_another_programs_file_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "other.h5", "w", libver=layout.LIBVER) as file:
        file["data"] = np.zeros(3)
    with refused(DataError):
        recover(tmp_path / "other.h5")


def test_the_checksum_is_the_published_one() -> None:
    """Jenkins 2006, lookup3.c, driver5."""
    assert lookup3(b"Four score and seven years ago") == (0x17770551).to_bytes(4, "little")


def test_the_head_is_read_and_written_as_hdf5_does(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "s.h5", "w", libver=layout.LIBVER) as file:
        file["data"] = np.arange(5)
    with h5py.File(tmp_path / "s.h5", "r+", libver=layout.LIBVER):
        opened = superblock(tmp_path / "s.h5")
    closed = superblock(tmp_path / "s.h5")
    assert opened is not None and closed is not None
    assert opened.open_for_writing and not closed.open_for_writing and closed.missing == 0
    assert opened.closed(opened.size) == closed.head
    (tmp_path / "s.h5").write_bytes(closed.head[:20] + b"\x01" + closed.head[21:])
    assert superblock(tmp_path / "s.h5") is None


@pytest.mark.slow
def test_a_loss_of_power_that_kept_some_of_the_last_writes_takes_no_frame_that_was_on_the_disk(
    tmp_path: Path, clock: SteppedClock, rng: np.random.Generator
) -> None:
    """Any of the pages since the last fsync, which was after 15 frames: HDF5 overwrites its own blocks in place."""
    frames, on_disk, page = scan_frames(rng, 2, 3, 35), 15, 4096
    writer = NXtomoWriter(tmp_path / "s.h5", INFO, SHAPE, clock=clock)
    for frame in frames:
        if frame.index == on_disk:
            before = writer.path.read_bytes()
        append(writer, frame)
    after = writer.path.read_bytes()
    writer.close()
    pages = [slice(at, at + page) for at in range(0, len(after), page)]
    anew = 0
    for trial in range(12):
        folder = tmp_path / str(trial)
        folder.mkdir()
        state, share = bytearray(before.ljust(len(after), b"\0")), rng.uniform()
        for part in pages:
            if rng.uniform() < share:
                state[part] = after[part]
        (folder / "s.h5").write_bytes(state)
        done = recover(_aged(folder / "s.h5"))
        assert on_disk <= done.frames <= len(frames)
        with open_scan(folder / "s.h5") as source:
            pixels = source.read(slice(None))
            wrong = {row for row, image in enumerate(pixels) if (image != frames[row].counts).any()}
            assert wrong <= {*done.damaged} - {*range(on_disk)} and source.ending.status == "failed"
            angles = [frame.angle for frame in frames[:on_disk]]
            np.testing.assert_allclose(source.table.angles[:on_disk], angles, rtol=1e-15)  # stored in degrees
        assert "unreadable" not in {found.rule for found in validate(folder / "s.h5", lambda n, total: None)}
        if (kept := folder / "s.h5.damaged").exists():
            assert kept.read_bytes() == state and f"The damaged file was renamed to {kept}." in done.in_words()
            anew += 1
        assert not recover(folder / "s.h5").changed
    assert anew  # ways that HDF5 cannot end such a file by


@pytest.mark.parametrize("swmr", [False, True])
def test_a_file_of_another_program_that_died_is_read_as_it_is_and_not_recovered(tmp_path: Path, swmr: bool) -> None:
    code = (
        f"import h5py, os; f = h5py.File({str(tmp_path / 'd.h5')!r}, 'w', libver='latest'); "
        "g = f.create_group('exchange'); "
        "d = g.create_dataset('data', (0, 4, 8), 'u2', maxshape=(None, 4, 8), chunks=(1, 4, 8)); "
        f"g['theta'] = range(60); {'f.swmr_mode = True; ' if swmr else ''}"
        "[(d.resize(i + 1, 0), d.__setitem__(i, i), d.flush()) for i in range(60)]; f.flush(); os._exit(9)"
    )
    subprocess.run([sys.executable, "-c", code], check=False)
    died = _aged(tmp_path / "d.h5")
    with open_scan(SourceOptions(died, angles_path="/exchange/theta", angles_unit="deg")) as source:
        np.testing.assert_allclose(np.degrees(source.table.angles), np.arange(60))
    with refused(DataError):
        recover(died)


def test_the_frames_of_a_cut_file_are_rescued(tmp_path: Path, clock: SteppedClock, frames: list[Frame]) -> None:
    writer = _written(tmp_path / "s.h5", frames[:10], clock)
    writer.close()
    cut = tmp_path / "cut.h5"
    cut.write_bytes((tmp_path / "s.h5").read_bytes()[:-100])
    _aged(cut)
    with refused(DataError):
        open_scan(cut)
    assert recover(cut).frames


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is empty"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 3\n", "`git lfs pull`"),
        (b"\x1f\x8b\x08\x00abc", "`gunzip`"),
        (b"<!DOCTYPE html><html><body>Sign in</body></html>", "download the file again"),
    ],
)
@pytest.mark.parametrize("name", ["s.h5", "s.tif"])
def test_what_stands_in_the_place_of_a_scan_is_named(tmp_path: Path, name: str, content: bytes, said: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=said):
        open_scan(tmp_path / name)
