"""Files on a disk: Python file objects that HDF5 reads and writes, temporary arrays without a file name, and fsync in a
thread.
"""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
import threading
import time
from io import SEEK_CUR, SEEK_END, SEEK_SET, FileIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import to_disk
from beamline.core.text import size
from beamline.storage.superblock import Superblock, mend_checksum

# largest number of bytes of a write that is kept in memory because HDF5 may read it again; HDF5 reads larger writes
# (voxels) from its own cache
_KEPT = 2**20
_ENDLESS = 2**60  # bytes; larger than any file can become


class UnderHdf5:
    """A file object with the methods that HDF5 needs to read: position, length, bytes.

    HDF5 does not share data between two such objects, even if they belong to the same file.
    """

    def __init__(self, path: Path, mode: str, length: int = 0) -> None:
        self.path, self._file = path, FileIO(path, mode)
        self._position, self._size = 0, max(length, os.fstat(self._file.fileno()).st_size)

    def __del__(self) -> None:
        if file := vars(self).get("_file"):
            file.close()

    def __repr__(self) -> str:
        return str(self.path)  # HDF5 uses this text as the name of the file

    def seek(self, offset: int, whence: int = SEEK_SET) -> int:
        self._position = offset + {SEEK_SET: 0, SEEK_CUR: self._position, SEEK_END: self._size}[whence]
        return self._position

    def tell(self) -> int:
        return self._position

    def readinto(self, buffer: Any) -> int:
        """Read into a buffer. Bytes that were not written yet are zero."""
        out = memoryview(buffer).cast("B")
        self._read(self._position, out)
        return len(out)

    def read(self, n: int) -> bytes:
        """Never called: h5py requires that it exists, but calls `readinto`."""
        out = bytearray(n)
        self.readinto(out)
        return bytes(out)

    def flush(self) -> None:
        """Does nothing: no data are buffered here."""

    def close(self) -> None:
        self._file.close()

    def _read(self, offset: int, out: memoryview) -> None:
        """Read into `out` from byte offset `at`."""
        self._from_disk(offset, out)

    def _from_disk(self, offset: int, out: memoryview) -> None:
        got = 0
        try:
            self._file.seek(offset)
            while got < len(out) and (n := self._file.readinto(out[got:])):
                got += n
        finally:
            out[got:] = bytes(len(out) - got)


class GrowingFile(UnderHdf5):
    """A file that a program is writing, or was writing when it was killed. HDF5 sees it as a closed file.

    When HDF5 refreshes, it sees the present state of the file. Blocks that are half written are repaired in memory
    while they are read.
    """

    def __init__(self, path: Path, head: Superblock) -> None:
        super().__init__(path, "r", _ENDLESS)
        self._head = head.closed(_ENDLESS)

    def _read(self, offset: int, out: memoryview) -> None:
        super()._read(offset, out)
        head = self._head[offset : offset + len(out)]
        out[: len(head)] = head
        mend_checksum(offset, out)


class DiskFile(UnderHdf5):
    """A file that h5py writes to.

    HDF5 keeps chunks and metadata in memory and writes them when an object closes; h5py cannot raise an error there,
    and HDF5 may crash after a failed write. Therefore no method that HDF5 calls fails: the first error waits for
    `require_taken`, and nothing further is written. Until HDF5 has closed the file, it reads later writes from memory.
    """

    def __init__(self, path: Path, mode: Literal["x", "r+"]) -> None:
        super().__init__(path, "x+" if mode == "x" else "r+")
        self._error: BaseException | None = None
        self._since: list[tuple[int, bytes]] = []

    def _read(self, offset: int, out: memoryview) -> None:
        try:
            self._from_disk(offset, out)
        except BaseException as error:
            self.keep(error)
        for first_byte, data in self._since:
            first, end = max(first_byte, offset), min(first_byte + len(data), offset + len(out))
            if first < end:
                out[first - offset : end - offset] = data[first - first_byte : end - first_byte]

    def write(self, buffer: Any) -> int:
        data, put = memoryview(buffer).cast("B"), 0
        self._size = max(self._size, self._position + len(data))
        try:
            if self._error is None:
                self._file.seek(self._position)
                while put < len(data):
                    put += self._file.write(data[put:])
        except BaseException as error:  # includes a signal: HDF5 cannot pass it on
            self.keep(error)
        if self._error is not None and len(data) <= _KEPT:
            self._since.append((self._position, bytes(data)))
        return len(data)

    def truncate(self, size: int) -> int:
        self._size = size
        try:
            if self._error is None:
                self._file.truncate(size)
        except BaseException as error:
            self.keep(error)
        return size

    def keep(self, error: BaseException) -> None:
        """Record an error for `require_taken`, unless there is an earlier one."""
        self._error = self._error or error

    def require_taken(self) -> None:
        """Raise the first error recorded so far: OSError if the disk failed."""
        error = self._error
        if isinstance(error, OSError):  # errors of HDF5 itself have no number
            raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(self.path)) from error
        if error is not None:
            raise error

    def finish(self) -> None:
        """Wait until the file is on the disk. Raises OSError if the disk failed, or if the file has another length."""
        self.require_taken()
        to_disk(self._file.fileno())
        if (size := os.fstat(self._file.fileno()).st_size) != self._size:
            raise OSError(errno.EIO, f"it has {size} bytes of {self._size}", str(self.path))


def scratch_array(folder: Path, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """A float32 array of zeros of this shape, memory-mapped from a file in `folder`.

    Raises:
        DataError: the disk does not have enough free space.
    """
    wanted = 4 * int(np.prod(shape, dtype=np.int64))
    with tempfile.TemporaryFile(dir=folder) as file:  # the memory map keeps the file open
        reserve(file.fileno(), wanted, folder)
        return np.memmap(file, np.float32, "r+" if os.fstat(file.fileno()).st_size == wanted else "w+", shape=shape)


def reserve(descriptor: int, wanted: int, folder: Path) -> None:
    """Allocate `wanted` bytes for an open file in the folder, if the operating system supports it. Missing disk space
    is then noticed now, and not during the work.

    Raises:
        DataError: the disk does not have enough free space.
    """
    status, free = os.fstat(descriptor), shutil.disk_usage(folder).free
    taken = 512 * getattr(status, "st_blocks", (status.st_size + 511) // 512)
    still_needed = size(wanted - taken)
    refusal = (
        f"Write the output to another disk: {folder} has {size(free)} free, and {still_needed} more are needed "
        "during the reconstruction. Nothing was written."
    )
    if wanted - taken > free:
        raise DataError(refusal)
    if hasattr(os, "posix_fallocate"):
        try:
            os.posix_fallocate(descriptor, 0, wanted)
        except OSError as error:
            raise DataError(refusal) from error


SECONDS = 1.0  # least time in s between two calls

_PATIENCE = 60.0  # s that each of the last calls may take


class ToDisk:
    """Calls `to_disk` in a thread, one call at a time, so that a writer need not wait for the disk.

    The thread is a daemon: a disk that hangs does not keep the program from ending.

    Attributes:
        failed: True if the disk failed in a call.
        rows: number of rows that were in the file before the last successful call.
    """

    def __init__(self, handle: int) -> None:
        self._handle = handle
        self._thread: threading.Thread | None = None
        self._error: OSError | None = None
        self.rows = 0
        self._begun = time.monotonic()

    @property
    def failed(self) -> bool:
        return self._error is not None

    def __call__(self, rows: int) -> None:
        """Start a call, unless one is running or started less than SECONDS ago.

        Raises:
            OSError: the disk failed in an earlier call.
        """
        if self._error is not None:
            raise self._error
        under_way = self._thread is not None and self._thread.is_alive()
        if under_way or time.monotonic() - self._begun < SECONDS:
            return
        self._begun = time.monotonic()
        self._thread = self._call(rows)
        self._thread.start()

    def finish(self, rows: int) -> None:
        """Wait until everything is on the disk.

        Raises:
            OSError: the disk failed, or one of the last calls took more than a minute.
        """
        for last in (self._thread, self._call(rows)):
            if last is None:
                continue
            if not last.ident:
                last.start()
            last.join(_PATIENCE)
            if last.is_alive():
                self._error = OSError(errno.ETIMEDOUT, f"the disk has accepted no data for {_PATIENCE:.0f} s")
            if self._error is not None:
                raise self._error

    def _call(self, rows: int) -> threading.Thread:
        def run() -> None:
            try:
                to_disk(self._handle)
            except OSError as error:
                self._error = error
            else:
                self.rows = rows

        return threading.Thread(target=run, name="to disk", daemon=True)
