"""Journal: changes an existing file completely or not at all, whatever is killed or fails meanwhile.

Changes are written beside the file first, then to it. A journal beside a file means that its changes have begun:
`finish` completes them, and readers see the finished file. Bytes beyond the present end are written first, then the
others. So a full disk is found while the file is unchanged; overwriting bytes takes no room.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beamline.core.errors import DataError
from beamline.core.files import bytes_below, folder_to_disk, to_disk, whole_file
from beamline.core.text import size

_FORMAT = "splatline journal 1"
_LARGEST = 2**31  # bytes of a journal: it has the few that differ
_BLOCK = 4096  # bytes, in which disks give room


@dataclass(frozen=True)
class FileChange:
    """Bytes of a file from `at` on, old and new; where the file had less, `old` is shorter."""

    at: int
    old: bytes
    new: bytes

    def fits(self, now: bytes) -> bool:
        """Whether the file has the old bytes, the new ones, or a mixture after an interruption."""
        return len(now) == len(self.old) and all(byte in pair for byte, *pair in zip(now, self.old, self.new))  # noqa: B905


@dataclass(frozen=True)
class FileChanges:
    """All changes of a file, which has `length` bytes afterwards."""

    path: Path
    length: int
    ranges: tuple[FileChange, ...]

    @property
    def room(self) -> int:
        """Required free bytes on its disk: for the journal, and for the growth of the file."""
        longer = max(0, self.length - self.path.stat().st_size)
        return sum(-(-n // _BLOCK) * _BLOCK for n in (len(_journal(self)), longer))

    def carry_out(self) -> None:
        """Change the file, by a journal.

        Raises:
            DataError: its disk has no room or does not take it; it says whether the file is as it was.
        """
        if not self.ranges:
            return
        journal = journal_of(self.path)
        room, free = self.room, shutil.disk_usage(self.path.parent).free
        if free < room:
            raise DataError(
                f"{self.path} needs {size(room)} on its disk to be changed, {size(free)} are free. Nothing was changed."
            )
        try:
            with whole_file(journal, replace=True) as partial, partial.open("xb") as file:
                file.write(_journal(self))
                file.flush()
                to_disk(file.fileno())
            folder_to_disk(journal.parent)
        except (OSError, DataError) as error:
            with suppress(OSError):
                journal.unlink(missing_ok=True)
            raise DataError(f"{journal} cannot be written ({_why(error)}). {self.path} is as it was.") from error
        apply_changes(self, journal)


def journal_of(path: Path) -> Path:
    """Where the journal of a file lies while it is changed."""
    path = path.resolve()
    return path.with_name(f"{path.name}.journal")


def pending(path: Path) -> FileChanges | None:
    """The unfinished changes of a file; None: there are none.

    Raises:
        DataError: their journal is damaged, or of another file.
    """
    journal = journal_of(path)
    try:
        changes = _changes(path, bytes_below(journal.parent, journal.name, _LARGEST))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise DataError(f"{journal} cannot be read ({_why(error)}), and {path} is not whole without it.") from error
    if changes is None or not all(change.fits(now) for change, now in _now(changes)):
        raise DataError(
            f"{journal} is damaged, or of another file than {path}. If that is so, move it away; else {path} is not "
            "whole without it. Nothing was changed."
        )
    return changes


def finish(path: Path) -> bool:
    """End the changes of a file that were begun; whether there were any.

    Raises:
        DataError: their journal cannot be read, or the disk does not take them.
    """
    journal = journal_of(path)
    if (changes := pending(path)) is not None:
        apply_changes(changes, journal)
    for left in journal.parent.glob(f".{journal.name}.*.partial"):  # of a program that was killed while it wrote it
        with suppress(OSError):
            left.unlink()
    return changes is not None


def apply_changes(changes: FileChanges, journal: Path) -> None:
    path, longer = changes.path, False
    before = path.stat().st_size
    try:
        with path.open("r+b", buffering=0) as file:
            for change in changes.ranges:
                _put(file, change.at + len(change.old), change.new[len(change.old) :])
            if path.stat().st_size < changes.length:
                file.truncate(changes.length)
            to_disk(file.fileno())
            longer = True
            for change in changes.ranges:
                _put(file, change.at, change.new[: len(change.old)])
            to_disk(file.fileno())
    except OSError as error:
        if longer or any(change.old != now for change, now in _now(changes)):
            raise DataError(
                f"{path} is changed in part only: its disk does not take the rest ({_why(error)}). {journal.name} "
                "beside it keeps that, and what reads the file here sees it whole. Mend the disk or make room, then "
                "run `beamline recover` on it again."
            ) from error
        with suppress(OSError):
            os.truncate(path, before)
        with suppress(OSError):
            journal.unlink()
        raise DataError(f"{path} cannot be made longer ({_why(error)}). What was in it is as it was.") from error
    with suppress(OSError):  # then it says what the file holds already
        journal.unlink()


def _now(changes: FileChanges) -> list[tuple[FileChange, bytes]]:
    """The present bytes of the file at the place of the old ones."""
    with changes.path.open("rb", buffering=0) as file:
        return [(change, _get(file, change.at, len(change.old))) for change in changes.ranges]


def _journal(changes: FileChanges) -> bytes:
    ranges = [(change.at, len(change.old), len(change.new)) for change in changes.ranges]
    head = json.dumps({"length": changes.length, "ranges": ranges}).encode()
    content = b"".join((head, b"\n", *(change.old + change.new for change in changes.ranges)))
    return f"{_FORMAT} {hashlib.sha256(content).hexdigest()}\n".encode() + content


def _changes(path: Path, journal: bytes) -> FileChanges | None:
    first, _, content = journal.partition(b"\n")
    if first != f"{_FORMAT} {hashlib.sha256(content).hexdigest()}".encode():
        return None
    head, _, data = content.partition(b"\n")
    try:
        header, ranges = json.loads(head), list[FileChange]()
        length, numbers = header["length"], [tuple(each) for each in header["ranges"]]
        if not all(type(n) is int and 0 <= n < 2**63 for each in (*numbers, (length,)) for n in each):
            return None
        for at, n_old, n_new in numbers:
            ranges.append(FileChange(at, data[:n_old], data[n_old : n_old + n_new]))
            data = data[n_old + n_new :]
    except (ValueError, TypeError, LookupError, RecursionError):
        return None
    return FileChanges(path, length, tuple(ranges))


def _get(file: Any, at: int, n: int) -> bytes:
    file.seek(at)
    return bytes(file.read(n))


def _put(file: Any, at: int, data: bytes) -> None:
    file.seek(at)
    while data:
        data = data[file.write(data) :]


def _why(error: BaseException) -> str:
    cause = error.__cause__ if isinstance(error, DataError) and error.__cause__ is not None else error
    return (isinstance(cause, OSError) and cause.strerror) or str(cause)
