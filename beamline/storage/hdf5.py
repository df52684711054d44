"""Opens and writes HDF5 files, including files that are growing, locked or damaged. Explains why a file cannot be
read.
"""

from __future__ import annotations

import errno
import math
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from functools import wraps
from pathlib import Path
from traceback import walk_tb
from typing import Any, Literal, Protocol, TypeVar

import h5py
import hdf5plugin  # noqa: F401 - registers the compressors that copies of scans use
import numpy as np

from beamline.core.errors import DataError
from beamline.core.files import no_file
from beamline.core.installed import of_library
from beamline.storage.disk_file import DiskFile, GrowingFile
from beamline.storage.structure import require_harmless
from beamline.storage.superblock import Superblock, superblock
from beamline.storage.writer_lock import QUIET, WITHOUT, LockFailure, abandoned, lock_failure, opened_whole

COMMITTED = "/entry/progress/frames_committed"  # path in the files of this program


class NotReadyError(DataError):
    """The file is just being created. This is not a fault: try again."""


class UnreadableError(DataError):
    """A frame cannot be read from a file that should contain it; other frames may be good."""


def open_hdf5(path: Path, follow: bool = False) -> h5py.File:
    """Open for reading, even a file that is being written or whose program was killed (SWMR).

    HDF5 shares an open file within a program. A reader in the same program as the writer would see only half of the
    file, and would write to it when it closes. Two readers that follow the same file would both get wrong values.
    Therefore such a file is opened with a separate handle.

    Raises DataError if the path is not a readable HDF5 file, or if the file refers to a path that is not a file (see
    storage.structure).
    Raises NotReadyError with `follow` if the file may become readable.
    """
    if not path.is_file():
        raise (NotReadyError if follow else DataError)(no_file(path))
    head = superblock(path)
    if grows_here(path) or (head is not None and head.open_for_writing and abandoned(path)):
        return _apart(path, head, follow)
    problems = []
    for swmr, locking in _ways(head, follow):
        try:
            if swmr:
                file = h5py.File(path, "r", swmr=swmr, locking=locking)
            else:
                file = opened_whole(path, unlocked=head is None or not head.open_for_writing)
        except (OSError, RuntimeError, ValueError) as error:
            problems.append(error)
            continue
        with closed_on_error(file), readable(path):
            require_harmless(file)
        return file
    raise _unopened(path, follow, head, problems)


def _ways(head: Superblock | None, follow: bool) -> list[tuple[bool, bool | None]]:
    """Ways to open a file, (swmr, locking), in the order in which they are tried."""
    # A reader that follows the file takes no lock, because it would otherwise look like a writer.
    growing, whole, shared = (True, False), (False, None), (True, None)
    ways: list[tuple[bool, bool | None]] = [growing, whole, shared] if follow else [whole, growing, shared]
    # HDF5 would wait for ever for a writer to complete what is missing or damaged
    waits = head is None or head.missing or not (follow or head.open_for_writing)
    return [way for way in ways if not (way[0] and waits)]


def _unopened(
    path: Path, follow: bool, head: Superblock | None, problems: list[OSError | RuntimeError | ValueError]
) -> DataError:
    """The error that says why the file could not be opened in any of these ways."""
    if follow:
        return NotReadyError(f"{path} cannot be followed yet ({problems[0]}).")
    cut = re.search(r"truncated file: eof = (\d+),.* stored_eof = (\d+)", str(problems[0]))
    missing = int(cut[2]) - int(cut[1]) if cut else head.missing if head is not None else 0
    if missing:
        return DataError(
            f"{path} is cut off: the last {missing} bytes are missing. Copy the file again, or use the "
            f"original. If there is no other copy, `beamline recover {path}` rescues the frames of a scan "
            "that this program took. Nothing was read."
        )
    if head is not None and head.open_for_writing:
        return DataError(
            f"{path} is marked as being written. If a scan is just starting or ending, or the program that wrote the "
            f"file was just killed, try again in {QUIET:.0f} s. If the program has ended, `h5clear -s {path}` clears "
            "the mark. Nothing was read."
        )
    if any(lock_failure(error) is LockFailure.HELD for error in problems):
        return DataError(
            f"{path} is open for writing in another program (HDF5 could not lock it). Close the file in that "
            "program, or wait until that program has ended. To read the file anyway, possibly incomplete, set "
            f"{WITHOUT} in the environment. Nothing was changed."
        )
    return DataError(f"{path} cannot be read as HDF5 ({problems[0]}).")


def grows_here(path: Path) -> bool:
    """True if this program has the file open with HDF5's own driver, to write it or to follow it."""
    status = path.stat()
    for file in h5py.h5f.get_obj_ids(h5py.h5f.OBJ_ALL, h5py.h5f.OBJ_FILE):
        with suppress(OSError, RuntimeError, ValueError):  # another thread has just closed the file
            by_name = file.get_access_plist().get_driver() != h5py.h5fd.fileobj_driver
            writes = by_name and file.get_intent() != h5py.h5f.ACC_RDONLY
            if writes and os.path.samestat(status, Path(os.fsdecode(file.name)).stat()):
                return True
    return False


def _apart(path: Path, head: Superblock | None, follow: bool) -> h5py.File:
    """Open a file that this program is writing, or whose process was killed. The driver used here shares no data with
    other HDF5 handles of the file.
    """
    if head is None or (head.open_for_writing and not head.grows and not abandoned(path)):
        raise (NotReadyError if follow else DataError)(f"This program is still creating {path}. Try again.")
    with readable(path):
        file = h5py.File(GrowingFile(path, head), "r")
        with closed_on_error(file):
            require_harmless(file)
        return file


def look_again(item: h5py.Dataset) -> None:
    """Refresh a dataset of a growing file.

    HDF5 2.0 reads wrong values after a refresh of a dataset that is open twice, which can happen with a finished file.
    """
    plist = item.file.id.get_access_plist()
    if item.file.id.get_intent() != h5py.h5f.ACC_RDONLY or plist.get_driver() == h5py.h5fd.fileobj_driver:
        item.refresh()


def n_written(item: Any) -> int:
    """Number of frames or values of a growing dataset that are already written.

    The writer may have allocated more: frames without a stored chunk, or values at the end of a list that are still the
    fill value or NaN.
    """
    look_again(getattr(item, "item", item))
    if item.ndim == 1:
        values = item[()]
        return int(np.flatnonzero((values != item.fillvalue) & (values == values)).max(initial=-1)) + 1
    if not isinstance(item, h5py.Dataset) or item.chunks is None:
        return len(item)
    tiles = math.prod(-(-n // across) for n, across in zip(item.shape[1:], item.chunks[1:], strict=True))
    return min(len(item), item.id.get_num_chunks() // tiles * item.chunks[0])


def is_hdf5(path: Path, follow: bool = False) -> bool:
    """True if the path is an HDF5 file: by its signature, at the start or after a user block.

    h5py.is_hdf5 returns False for a file that is being written. A path that does not exist, or that is followed, counts
    as HDF5: `open_hdf5` then reports what is wrong with it, or that it is not ready.
    """
    if follow or not path.is_file():
        return True
    with path.open("rb") as file:
        for offset in (0, 512, 1024, 2048):
            file.seek(offset)
            if file.read(8) == b"\x89HDF\r\n\x1a\n":
                return True
    return False


ALTERED = (
    *(OSError, RuntimeError, LookupError, TypeError, ValueError, AttributeError, ArithmeticError, AssertionError),
    *(EOFError, MemoryError, struct.error, zlib.error, zipfile.BadZipFile),
)
"""Errors that libraries raise if a file is damaged, or contains something else than its names say. Errors of this
program are not among them.
"""


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """A context that converts h5py's errors to a DataError: the file is damaged, or altered by another program."""
    try:
        yield
    except ALTERED as error:
        if isinstance(error, MemoryError | PermissionError | FileNotFoundError) or _of_our_own(error):
            raise
        details = " ".join(str(error).split()) or "no further information"
        raise DataError(
            f"{path} is damaged or has an unexpected structure ({type(error).__name__}: {details}). Nothing was "
            "changed."
        ) from error


class _OfPath(Protocol):
    path: Path


_S = TypeVar("_S", bound=_OfPath)
_T = TypeVar("_T")


def guarded(method: Callable[[_S], _T]) -> Callable[[_S], _T]:
    """A method of an open file with this `path`, whose errors are converted as by `readable`."""

    @wraps(method)
    def read(self: _S) -> _T:
        with readable(self.path):
            return method(self)

    return read


_CONTENT = r"array|bytes|unsized|'(Dataset|Datatype|Empty|Group|str)'"  # the content of a file can cause a TypeError


def _of_our_own(error: Exception) -> bool:
    """True if the error is a programming error in a reader. False if a library raised it because the file contains
    something unexpected.

    If a file has a dataset instead of the expected group, the methods of a group are missing. The object that lacks
    them then belongs to the file, so the error is not a programming error.
    """
    content = isinstance(
        getattr(error, "obj", None), h5py.HLObject | h5py.Empty | np.ndarray | np.generic | str | bytes
    )
    of_type = isinstance(error, TypeError) and not re.search(_CONTENT, str(error))
    mistake = of_type or isinstance(error, AttributeError | LookupError | AssertionError)
    *_, (frame, _) = walk_tb(error.__traceback__)
    return mistake and not content and not of_library(frame)


@contextmanager
def closed_on_error(file: Any) -> Iterator[None]:
    """A context that closes what was opened if the block fails."""
    try:
        yield
    except BaseException:
        file.close()
        raise


def reason(error: Exception) -> str:
    """The reason in the words of the disk or the operating system, without the addresses and offsets that HDF5 adds."""
    message = re.search(r"error message = '([^']*)'", str(error))
    return message[1] if message else (isinstance(error, OSError) and error.strerror) or str(error)


class NewFile(h5py.File):  # type: ignore[misc]  # h5py has no types
    """A file that is created by `created` or changed by `changed`."""

    def __init__(self, disk: DiskFile, mode: str, libver: str | tuple[str, str] | None = None) -> None:
        super().__init__(disk, mode, libver=libver)
        self.require_taken = disk.require_taken
        """Raises OSError if a write to the disk failed. Call it from time to time during long writes."""


def created(path: Path, libver: str | tuple[str, str] | None = None) -> AbstractContextManager[NewFile]:
    """Create a file. At the end of the block it is flushed to the disk.

    Raises:
        OSError: the disk failed; the file is closed and not deleted.
    """
    return _written(path, "x", libver)


def changed(path: Path, libver: str | tuple[str, str] | None = None) -> AbstractContextManager[NewFile]:
    """Open an existing file to change it. Errors are raised as by `created`. After a disk error, only a part of the
    changes may be in the file.
    """
    return _written(path, "r+", libver)


@contextmanager
def _written(path: Path, mode: Literal["x", "r+"], libver: str | tuple[str, str] | None) -> Iterator[NewFile]:
    with closing(DiskFile(path, mode)) as disk:
        try:
            with NewFile(disk, mode, libver) as file:
                yield file
            disk.finish()
        except Exception as error:
            disk.require_taken()  # the cause, if the disk is the cause
            if isinstance(error, OSError | RuntimeError):  # names of h5py's classes for errors of HDF5
                number = error.errno if isinstance(error, OSError) and error.errno else errno.EIO
                raise OSError(number, reason(error), str(path)) from error
            raise
