"""Locks on files: those of this program on a file that is being written, and failures of HDF5's own locks.

The lock of this program shows that a writer is alive, even if it writes nothing for a long time. The operating system
releases the lock when the program ends for any reason. HDF5 holds no lock on a file that others may follow, but it
locks every file that it creates or opens for ordinary reading. On a file system without locks (many NFS mounts) this
fails.
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

QUIET = 10.0  # s without a change, after which no program is taken to write the file, where locks do not say it

PATIENCE = 120.0  # s without a new frame, after which a growing file without the lock of its writer is given up
_LOOK = 1.0  # s between looks whether the writer still holds its lock

_TRIES, _PAUSE = 20, 0.005  # real s between tries for a lock

if sys.platform == "win32":
    import msvcrt

    _BEYOND = 2**62  # a byte that no file has: Windows lets nobody read or write one that is locked

    def _lock(file: int, *, exclusive: bool) -> None:
        os.lseek(file, _BEYOND, os.SEEK_SET)
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)

else:
    import fcntl

    def _lock(file: int, *, exclusive: bool) -> None:
        # Shared by the writer, because HDF5 takes a shared lock to open a file for reading.
        fcntl.flock(file, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)


SWITCH = "HDF5_USE_FILE_LOCKING"
WITHOUT = f"{SWITCH}=FALSE"
_NONE = {errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS}
_OFF = {"FALSE", "0", "BEST_EFFORT"}


class LockFailure(Enum):
    """Why HDF5 got no lock."""

    NO_LOCKS = "no locks"
    HELD = "held"


def lock_failure(error: BaseException) -> LockFailure | None:
    """Why a file could not be locked, from an error of h5py; None if that is another error."""
    match = re.search(r"unable to lock file, errno = (\d+)", str(error))
    if match is None:
        return None
    return LockFailure.NO_LOCKS if int(match[1]) in _NONE else LockFailure.HELD


def no_locks(folder: Path) -> str:
    """A sentence if files in a folder cannot be locked, so that HDF5 cannot create files there; "" if they can, if HDF5
    is set to use no locks, or if that is unknown.
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
    """A sentence with the cause and the remedy."""
    number_text = "" if number is None else f" (errno {number})"
    return (
        f"the file system of {place} has no file locks{number_text}, which is common with NFS, so HDF5 cannot create a "
        "file there. Choose a storage.folder on a local disk, mount the file system with locks, or set "
        f"{WITHOUT} in the environment"
    )


def opened_whole(path: Path, *, unlocked: bool = True) -> h5py.File:
    """Open for reading a file that no program is writing; without a lock if its file system has none.

    Args:
        unlocked: may be opened without a lock.

    Raises:
        OSError, ValueError: as h5py.File.
    """
    import h5py  # a command that only asks about locks, and its help, load without it

    try:
        return h5py.File(path, "r")
    except OSError as error:
        if not unlocked or lock_failure(error) is not LockFailure.NO_LOCKS:
            raise
        return h5py.File(path, "r", locking=False)


class WriterLock:
    """A lock held until `release`, or until this process ends. There is no lock if the file system has none.

    Args:
        exclusive: take an exclusive lock, and raise OSError if another process holds one; else a shared one.
    """

    def __init__(self, path: Path, *, exclusive: bool = False) -> None:
        file = os.open(path, os.O_RDWR)
        self.release = weakref.finalize(self, os.close, file)
        for left in reversed(range(_TRIES)):
            try:
                _lock(file, exclusive=exclusive)
                return
            except (BlockingIOError, PermissionError):
                if left:
                    time.sleep(_PAUSE)  # `held` has the lock for a moment
                elif exclusive:
                    self.release()
                    raise
            except OSError:  # no locks on this disk
                return


def held(path: Path, *, exclusively: bool = False) -> bool | None:
    """True if a running program has the file open, as far as locks tell; False if the file cannot be opened, None if
    its file system has no locks.

    Args:
        exclusively: True if the holder of this file locks it exclusively. Several processes can then ask at the same
            time without blocking one another (except on Windows).
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
    except OSError:  # no locks on this disk
        return None
    finally:
        os.close(file)
    return False


def abandoned(path: Path) -> bool:
    """True if no program seems to write the file: it has not changed for QUIET s, and no running program has it
    open."""
    return time.time() - path.stat().st_mtime > QUIET and not held(path)


class WriterWatch:
    """Detects, for the follower of a growing file, that its writer has died: at once by the lock, or else by its
    silence.

    Args:
        now: s, by the clock of the follower.
        patience: s without a frame, after which a file without a lock counts as one whose process was killed. With the
            lock the writer waits: for the operator, the beam, or a long exposure.
    """

    def __init__(self, path: Path, now: float, patience: float = PATIENCE) -> None:
        self._path, self._patience = path, patience
        self._last_frame = self._last_look = now
        self._was_held = self._held = held(path)

    def lost(self, now: float, grew: bool, finished: Callable[[], bool]) -> str:
        """How the loss of the writer was detected, as the end of a sentence; "" if it was not.

        Args:
            grew: True if the file has grown since the last call.
            finished: function that reads from the file whether the scan has ended; the lock is released after the end
                is written.
        """
        if now - self._last_look >= _LOOK:
            self._last_look, self._was_held, self._held = now, self._held, held(self._path)
        if grew or (self._held and now - self._last_frame > self._patience):
            self._last_frame = now
        if self._was_held and not self._held and not finished():
            return "is no longer being written, because the program that wrote it has ended"
        return f"has not grown for {self._patience:.0f} s" if now - self._last_frame > self._patience else ""
