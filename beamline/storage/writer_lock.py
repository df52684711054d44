"""Locks on files: the lock of this program on a file that is being written, and failures of HDF5's own locks.

The lock of this program shows that a writer is alive, even if the writer writes nothing for a long time. The operating
system releases the lock when the program ends, for whatever reason. HDF5 has its own locks: it locks every file that it
creates or opens for ordinary reading, but not a file that others may follow. On a file system without locks (many NFS
mounts), HDF5's locking fails.
"""

from __future__ import annotations

import errno
import os
import re
import sys
import tempfile
import time
import weakref
from collections.abc import Callable
from contextlib import suppress
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import h5py

QUIET = 10.0  # s without a change, after which nobody is assumed to be writing the file; for file systems without locks

PATIENCE = 120.0  # s without a new frame, after which the writer of a growing file without a lock is assumed to be dead
_LOOK = 1.0  # s between two checks whether the writer still holds its lock

_TRIES, _PAUSE = 20, 0.005  # real s between attempts to take a lock

if sys.platform == "win32":
    import msvcrt

    _BEYOND = 2**62  # a byte beyond the end of any file, because Windows lets nobody read or write a locked byte

    def _lock(file: int, *, exclusive: bool) -> None:
        os.lseek(file, _BEYOND, os.SEEK_SET)
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)

else:
    import fcntl

    def _lock(file: int, *, exclusive: bool) -> None:
        # The writer takes a shared lock, because HDF5 takes a shared lock when it opens a file for reading.
        fcntl.flock(file, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)


SWITCH = "HDF5_USE_FILE_LOCKING"
WITHOUT = f"{SWITCH}=FALSE"
_NONE = {errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS}
_OFF = {"FALSE", "0", "BEST_EFFORT"}


class LockFailure(Enum):
    """The reason why HDF5 could not lock a file."""

    NO_LOCKS = "no locks"
    HELD = "held"


def lock_failure(error: BaseException) -> LockFailure | None:
    """The reason why a file could not be locked, from an error of h5py. None if the error has another cause."""
    match = re.search(r"unable to lock file, errno = (\d+)", str(error))
    if match is None:
        return None
    return LockFailure.NO_LOCKS if int(match[1]) in _NONE else LockFailure.HELD


def no_locks(folder: Path) -> str:
    """A sentence if files in a folder cannot be locked, because HDF5 then cannot create files there. "" if files can be
    locked, if HDF5 is set to use no locks, or if it is unknown.
    """
    if os.environ.get(SWITCH, "").upper() in _OFF:
        return ""
    with suppress(OSError), tempfile.TemporaryFile(dir=folder, prefix=".beamline-lock-") as file:
        try:
            _lock(file.fileno(), exclusive=True)
        except OSError as error:
            if error.errno in _NONE:
                return no_locks_sentence(folder, error.errno)
    return ""


def no_locks_sentence(place: Path, number: int | None = None) -> str:
    """A sentence with the cause and what to do."""
    number_text = "" if number is None else f" (errno {number})"
    return (
        f"the file system of {place} has no file locks{number_text}, which is common with NFS, so HDF5 cannot create a "
        "file there. Choose a storage.folder on a local disk, mount the file system with locks, or set "
        f"{WITHOUT} in the environment"
    )


def opened_whole(path: Path, *, unlocked: bool = True) -> h5py.File:
    """Open a file for reading that no program is writing. If the file system has no locks, open it without a lock.

    Args:
        unlocked: True if the file may be opened without a lock.

    Raises:
        OSError, ValueError: the same errors as h5py.File.
    """
    import h5py  # imported here, so that a command that only asks about locks, and its help, start without it

    try:
        return h5py.File(path, "r")
    except OSError as error:
        if not unlocked or lock_failure(error) is not LockFailure.NO_LOCKS:
            raise
        return h5py.File(path, "r", locking=False)


class WriterLock:
    """A lock that is held until `release`, or until this process ends. On a file system without locks it does nothing.

    Args:
        exclusive: True: take an exclusive lock, and raise OSError if another process holds a lock. False: take a shared
            lock.
    """

    def __init__(self, path: Path, *, exclusive: bool = False) -> None:
        file = os.open(path, os.O_RDWR)
        self.release = weakref.finalize(self, os.close, file)
        for tries_left in reversed(range(_TRIES)):
            try:
                _lock(file, exclusive=exclusive)
                return
            except (BlockingIOError, PermissionError):
                if tries_left:
                    time.sleep(_PAUSE)  # the function `held` briefly holds the lock
                elif exclusive:
                    self.release()
                    raise
            except OSError:  # the file system has no locks
                return


def held(path: Path, *, exclusively: bool = False) -> bool | None:
    """True if a running program holds a lock on the file. False also if the file cannot be opened. None if the file
    system has no locks.

    Args:
        exclusively: True if the holder locks this file exclusively. Then several processes can call this function at
            the same time without blocking each other (except on Windows).
    """
    writable = not exclusively and os.access(path, os.W_OK)
    try:
        file = os.open(path, (os.O_RDWR if writable else os.O_RDONLY) | getattr(os, "O_NONBLOCK", 0))
    except OSError:
        return False
    try:
        _lock(file, exclusive=not exclusively)
    except (BlockingIOError, PermissionError):
        return True
    except OSError:  # the file system has no locks
        return None
    finally:
        os.close(file)
    return False


def abandoned(path: Path) -> bool:
    """True if nobody seems to be writing the file: it has not changed for QUIET s, and no running program has it
    open.
    """
    return time.time() - path.stat().st_mtime > QUIET and not held(path)


class WriterWatch:
    """Tells the reader of a growing file when the writer has died: at once if there are locks, otherwise after some
    time without new frames.

    Args:
        now: clock of the reader, in s.
        patience: s without a new frame, after which the writer of a file without a lock counts as dead. If the writer
            holds the lock, it is waiting for the operator, for the beam, or for a long exposure.
    """

    def __init__(self, path: Path, now: float, patience: float = PATIENCE) -> None:
        self._path, self._patience = path, patience
        self._last_frame = self._last_look = now
        self._was_held = self._held = held(path)

    def lost(self, now: float, grew: bool, finished: Callable[[], bool]) -> str:
        """How the death of the writer was detected, as the end of a sentence; "" if the writer is alive.

        Args:
            grew: True if the file has grown since the last call.
            finished: function that reads from the file whether the scan has ended. The writer releases the lock only
                after it has written the end.
        """
        if now - self._last_look >= _LOOK:
            self._last_look, self._was_held, self._held = now, self._held, held(self._path)
        if grew or (self._held and now - self._last_frame > self._patience):
            self._last_frame = now
        if self._was_held and not self._held and not finished():
            return "is no longer being written, because its program ended"
        return f"has not grown for {self._patience:.0f} s" if now - self._last_frame > self._patience else ""
