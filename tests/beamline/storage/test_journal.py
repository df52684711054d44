"""Changes to a file by a journal: whole or not at all, taken up where they were stopped, never on another file."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from beamline.core.errors import DataError
from beamline.storage import journal
from beamline.storage.journal import FileChanges, finish, journal_of, pending
from beamline.storage.overlay import Overlay

OLD = bytes(range(256)) * 40


def _changed(path: Path) -> tuple[FileChanges, bytes]:
    """A byte in one page, bytes over the edge of two others, and a longer file; and the file as it shall be."""
    overlay, expected = Overlay(path), bytearray(OLD)
    for at, new in ((5, b"\xff"), (8190, b"abcd"), (len(OLD) - 2, b"longer than before")):
        overlay.seek(at)
        overlay.write(new)
        expected[at : at + len(new)] = new
    overlay.seek(0, os.SEEK_END)
    assert overlay.tell() == len(expected)
    overlay.seek(0)
    assert overlay.read(len(expected)) == bytes(expected)
    return overlay.changes(), bytes(expected)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "s.h5").write_bytes(OLD)
    return tmp_path / "s.h5"


def _begun(path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[FileChanges, bytes]:
    """The journal is there, and the program was stopped."""
    changes, expected = _changed(path)

    class Killed(BaseException):
        pass

    def kill(*_: object) -> None:
        raise Killed

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(journal, "apply_changes", kill)
        changes.carry_out()
    assert path.read_bytes() == OLD and journal_of(path).is_file()
    return changes, expected


def test_what_is_written_to_an_overlay_is_not_on_the_disk_until_it_is_carried_out(path: Path) -> None:
    changes, expected = _changed(path)
    assert path.read_bytes() == OLD
    assert [change.at for change in changes.ranges] == [5, 8190, 8192]
    changes.carry_out()
    assert path.read_bytes() == expected
    assert list(path.parent.iterdir()) == [path]


def test_beyond_its_end_a_file_is_zero(path: Path) -> None:
    overlay = Overlay(path, length=len(OLD) + 100)
    overlay.seek(len(OLD) - 1)
    assert overlay.read(101) == OLD[-1:] + bytes(100)
    overlay.truncate(10)
    assert overlay.changes() == FileChanges(path, len(OLD), ())  # never shorter than it is


def test_changes_that_were_begun_are_seen_and_ended(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    changes, expected = _begun(path, monkeypatch)
    (path.parent / ".s.h5.journal.0123.partial").write_bytes(b"of a program that was killed")
    assert pending(path) == changes
    assert Overlay(path, changes.ranges).read(len(expected)) == expected
    for stopped in range(0, len(expected), 97):  # wherever the one before was stopped
        path.write_bytes(expected[:stopped] + OLD[stopped:])
        shutil.copy(journal_of(path), path.parent / "kept")
        assert finish(path)
        assert path.read_bytes() == expected
        (path.parent / "kept").rename(journal_of(path))
    assert finish(path) and not finish(path)
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("other", [bytes(len(OLD)), OLD[:100]])
def test_the_journal_of_another_file_changes_nothing(path: Path, other: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    _begun(path, monkeypatch)
    path.write_bytes(other)
    with pytest.raises(DataError, match=r"of another file.*Nothing was changed"):
        finish(path)
    assert path.read_bytes() == other


def test_a_damaged_journal_changes_nothing(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _begun(path, monkeypatch)
    written = journal_of(path).read_bytes()
    journal_of(path).write_bytes(written[:-1])
    with pytest.raises(DataError, match="is damaged"):
        finish(path)
    assert path.read_bytes() == OLD


def test_a_disk_without_room_is_refused_with_what_is_needed(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    changes, _ = _changed(path)
    assert changes.room == 3 * 4096  # the journal, and what is added
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=8000))
    with pytest.raises(DataError, match=r"needs 12\.3 kB"):
        changes.carry_out()
    assert path.read_bytes() == OLD and list(path.parent.iterdir()) == [path]


@pytest.mark.skipif(os.name != "posix", reason="a folder has no fsync")
@pytest.mark.parametrize(("call", "kept"), [(1, False), (2, False), (3, False), (4, True)])
def test_a_disk_that_fails_says_what_became_of_the_file(
    path: Path, call: int, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """fsync of the journal, of its folder, of what makes the file longer, of what changes in it."""
    changes, expected = _changed(path)
    calls: list[int] = []

    def fsync(handle: int) -> None:
        calls.append(handle)
        if len(calls) == call + (os.name != "posix" and call > 1) * -1:
            raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(journal, "to_disk", fsync)
        patch.setattr(journal, "folder_to_disk", fsync)
        with pytest.raises(DataError, match="Input/output error.*run `beamline recover`" if kept else "as it was"):
            changes.carry_out()
    assert journal_of(path).exists() == kept
    if kept:
        assert finish(path)
    assert path.read_bytes() == (expected if kept else OLD)


WAYS: dict[str, Callable[[Path], None]] = {
    "pipe": os.mkfifo if os.name == "posix" else Path.mkdir,
    "link": lambda place: place.symlink_to("s.h5"),
    "endless": lambda place: place.symlink_to("/dev/zero"),
    "huge": lambda place: (place.touch(), os.truncate(place, 2**33))[1],
}


@pytest.mark.skipif(os.name != "posix", reason="links and pipes take rights on Windows")
@pytest.mark.parametrize("way", WAYS)
def test_what_is_put_in_the_place_of_a_journal_is_not_waited_for(path: Path, way: str) -> None:
    WAYS[way](journal_of(path))
    for work in (pending, finish):
        with pytest.raises(DataError, match="cannot be read"):
            work(path)
    assert path.read_bytes() == OLD


@pytest.mark.parametrize(
    "head",
    [
        "[]", '{"length": 1}', '{"length": true, "ranges": []}', '{"length": -1, "ranges": []}', "[" * 10**5, "\xff",
        '{"length": 9, "ranges": [[-1, 1, 1]]}', '{"length": 9, "ranges": [[1.5, 1, 1]]}',
        f'{{"length": {"9" * 5000}}}',
        '{"length": 9, "ranges": [[1, 1]]}', '{"length": 9, "ranges": 7}',
    ],
    ids=range(11),
)  # fmt: skip
def test_a_journal_of_other_words_is_damaged(path: Path, head: str) -> None:
    content = head.encode("latin1") + b"\nabc"
    mark = f"{journal._FORMAT} {hashlib.sha256(content).hexdigest()}\n"
    journal_of(path).write_bytes(mark.encode() + content)
    with pytest.raises(DataError, match="of another file"):
        finish(path)
    assert path.read_bytes() == OLD
