"""The lock of a program on the file that it writes, so that a long silence does not count as its death.

The system gives the lock back when the program ends, however it ends. HDF5 has none while a file can be followed.
"""

from __future__ import annotations

import os
import sys
import time
import weakref
from pathlib import Path

QUIET = 10.0  # s without a change, after which no program is taken to write the file, where locks do not say it

_TRIES, _PAUSE = 20, 0.005  # real s between tries for a shared lock

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


class WriterLock:
    """Held from now on until `release`, or until this process ends. Nothing is held where the disk has no locks.

    Args:
        exclusive: take an exclusive lock, and raise OSError where another process holds one; else a shared one.
    """

    def __init__(self, path: Path, *, exclusive: bool = False) -> None:
        file = os.open(path, os.O_RDWR)
        self.release = weakref.finalize(self, os.close, file)
        for left in reversed(range(_TRIES)):
            try:
                _lock(file, exclusive=exclusive)
                return
            except (BlockingIOError, PermissionError):
                if exclusive:
                    self.release()
                    raise
                if left:
                    time.sleep(_PAUSE)  # `held` has the lock for a moment
            except OSError:  # no locks on this disk
                return


def held(path: Path) -> bool:
    """Whether a program that runs has the file open, so far as locks tell; not where the file cannot be opened."""
    try:
        file = os.open(path, os.O_RDWR if os.access(path, os.W_OK) else os.O_RDONLY)
    except OSError:
        return False
    try:
        _lock(file, exclusive=True)
    except (BlockingIOError, PermissionError):
        return True
    except OSError:  # no locks on this disk
        return False
    finally:
        os.close(file)
    return False
