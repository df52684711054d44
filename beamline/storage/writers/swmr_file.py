"""SwmrFile: a new scan file that other programs can follow, because it is written SWMR (single writer, multiple
readers).

It creates the file, commits rows, notices that another program changed the file, and finishes the file or lets it go.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.text import size
from beamline.storage import hdf5
from beamline.storage.disk_file import ToDisk
from beamline.storage.writer_lock import LockFailure, WriterLock, lock_failure, no_locks_sentence
from beamline.storage.writers import layout
from beamline.storage.writers.rows import ScanEnding, state_ending, state_words

LAST = (
    layout.STATUS, layout.FINISHED, layout.END_TIME, layout.FIELD_OF_VIEW, layout.MISSING, layout.REASON,
    layout.BEAM_TIME, layout.BEAM_VALUE, layout.PASS_ENDS, layout.DECISIONS,
)  # fmt: skip
"""Datasets that are written at the end of a scan, or of a pass."""
FAILURES = (OSError, RuntimeError, ValueError)  # the classes of errors to which h5py converts errors of HDF5


class TouchedError(OSError):
    """Another program truncated or deleted the file while it was being written."""


def _new_file(path: Path) -> h5py.File:
    """Create a new file. Raises DataError if the file exists or HDF5 cannot create it. An incomplete file is
    deleted.
    """
    try:
        return h5py.File(path, "x", libver=layout.LIBVER)
    except FileExistsError as error:
        raise DataError(
            f"{path} exists, and a scan never overwrites a file. Give another name. Nothing was written."
        ) from error
    except OSError as error:
        with suppress(OSError):  # HDF5 created it and then failed; a file that existed before raises FileExistsError
            path.unlink()
        if lock_failure(error) is LockFailure.NO_LOCKS:
            reason = no_locks_sentence(path.parent, error.errno)
            raise DataError(f"{path} cannot be created: {reason}. No part of the file was left on the disk.") from error
        reason = hdf5.reason(error)
        raise DataError(
            f"{path} cannot be created ({reason}). Check that its folder exists and is writable."
        ) from error


class SwmrFile:
    """An open scan file. Its datasets can grow, and no object can be created any more.

    Args:
        create: function that creates all objects of the file.

    Attributes:
        file: the file.
        lock: tells other programs that this process writes the file.
        last: the datasets of LAST that the file has.
        committed: number of rows that are complete in the file.
        broken: True after a failed write: nothing more may be written.

    DataError if the file exists or cannot be made.
    """

    def __init__(self, path: Path, create: Callable[[h5py.File], None]) -> None:
        self._path, self.committed, self.broken = path, 0, False
        self.file = _new_file(path)
        try:
            create(self.file)
            self.file.swmr_mode = True  # from now on no object may be created
            self.lock = WriterLock(path)
        except BaseException as error:  # an empty file is of no use
            with suppress(*FAILURES):
                self.file.close()
            path.unlink()
            if isinstance(error, OSError | RuntimeError):
                raise DataError(
                    f"{path} cannot be created ({hdf5.reason(error)}). No part of the file was left on the disk."
                ) from error
            raise
        self._handle: int = self.file.id.get_vfd_handle()
        self._to_disk, self._before = ToDisk(self._handle), os.fstat(self._handle)
        self._progress = self.file[layout.COMMITTED]
        # Kept open until the end: if the disk fails, closing a dataset would write to it again.
        self.last: dict[str, h5py.Dataset] = {path: self.file[path] for path in LAST if path in self.file}

    @property
    def safe(self) -> int:
        """Number of committed rows that are known to be on the disk. After a failed fsync, all rows since the last
        successful fsync may be lost.
        """
        return self._to_disk.rows if self._to_disk.failed else self.committed

    def commit(self, rows: int) -> None:
        """Flush the file, and count its first rows as complete."""
        self.file.flush()
        self._progress[()] = rows
        self._progress.flush()
        self.committed, self._before = rows, os.fstat(self._handle)
        self._to_disk(rows)

    def grow(self, path: str, value: int | bytes) -> None:
        """Add a value to one of the datasets `last`."""
        column = self.last[path]
        column.resize(len(column) + 1, 0)
        column[-1] = value

    def finish(self, values: Mapping[str, NDArray[np.float64] | bytes], ending: ScanEnding) -> None:
        """Write the last values, by the path of their dataset, and close the file."""
        for path, value in values.items():
            if path in self.last:
                if isinstance(value, bytes):
                    self.last[path][()] = value
                else:
                    self.last[path].resize(value.size, 0)
                    self.last[path][...] = value
        state_ending(self.last, ending)
        self.file.flush()
        self.last[layout.FINISHED][()] = 1
        self.file.flush()
        self._to_disk.finish(self.committed)
        try:
            self.file.close()
        except FAILURES:
            self.broken = True  # HDF5 has closed half of the file; using it again would crash
            raise

    def let_go(self, reason: str) -> None:
        """Write the mark of the end into space that already exists in the file. Leave everything else as a killed
        process would leave it.

        Readers see every committed frame.
        """
        try:
            state_words(self.last, ScanEnding("failed", reason=reason))
            self.last[layout.FINISHED][()] = 1
            for path in (layout.REASON, layout.STATUS, layout.FINISHED):
                self.last[path].flush()
        finally:  # otherwise HDF5 would write again what the disk rejected, now and at the end of the process
            with Path(os.devnull).open("r+b") as nowhere, suppress(*FAILURES):
                os.dup2(nowhere.fileno(), self._handle)
                self.file.close()

    def require_untouched(self) -> None:
        """Raise OSError if another program has truncated or deleted the file. HDF5 would not notice, and would continue
        to write.
        """
        now = os.fstat(self._handle)
        if now.st_nlink == 0 < self._before.st_nlink:  # if the file system supports hard links
            raise TouchedError(errno.ENOENT, "it was deleted")
        if now.st_size < self._before.st_size:
            raise TouchedError(errno.EIO, f"the file was cut from {self._before.st_size} to {now.st_size} bytes")

    def disk_error(self, what: str, error: Exception) -> DataError:
        """The error that says what could not be done, and which rows are safe."""
        if isinstance(error, TouchedError):
            return DataError(
                f"Another program changed {self._path} while the scan was writing it ({error.strerror}). "
                f"Some or all of the {self.committed} frames are lost. Copy the file, run `beamline "
                "recover` on the copy, and repeat the scan."
            )
        free = ""
        with suppress(OSError):  # the folder may have been moved
            free = f"; {size(shutil.disk_usage(self._path.parent).free)} are free on its disk"
        return DataError(
            f"Could not {what} {self._path} ({hdf5.reason(error)}){free}. The first {self.safe} frames are safe in "
            "this file: run `beamline recover` to make an ordinary scan file of these frames."
        )
