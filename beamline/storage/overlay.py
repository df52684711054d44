"""Overlay: a file for HDF5 whose writes stay in memory until all of them are carried out.

What lies beyond the present end of the file is written first, so that a full disk is found while the file is as it was:
overwriting bytes takes no room. Then the file is marked as being written, the bytes that differ are written, and the
head comes last. Whatever stops this leaves a file whose blocks are the old or the new ones, all of them with what they
refer to: readers take it for one of a writer that died, and `recover` ends it.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from beamline.core.errors import DataError
from beamline.core.files import to_disk
from beamline.core.text import size
from beamline.storage.disk_file import UnderHdf5
from beamline.storage.superblock import SIZE, Superblock, made_whole

_PAGE = 4096  # bytes: a change within one of these reaches the disk in one piece, as far as any does


class PartlyChangedError(DataError):
    """A disk error occurred when part of the file had been changed."""


class Overlay(UnderHdf5):
    """A file with later writes in memory on top, for h5py.File(overlay). Torn blocks are repaired.

    Args:
        length: of the file in bytes; bytes beyond its end are zero.
    """

    def __init__(self, path: Path, length: int = 0) -> None:
        super().__init__(path, "r", length)
        self._there = os.fstat(self._file.fileno()).st_size
        self._pages: dict[int, bytearray] = {}

    def copy(self) -> Self:
        """A copy of the overlay; later writes go to only one of the two."""
        made = type(self)(self.path, self._size)
        made._pages = {page: bytearray(data) for page, data in self._pages.items()}
        return made

    def _read(self, at: int, out: memoryview) -> None:
        self._from_disk(at, out)
        end = at + len(out)
        for page in _pages(at, end) if self._pages else ():
            if page in self._pages:
                begin = page * _PAGE
                first, last = max(at, begin), min(end, begin + _PAGE)
                out[first - at : last - at] = self._pages[page][first - begin : last - begin]
        if (mended := made_whole(at, out)) is not None:
            self.put(*mended)

    def write(self, data: Any) -> int:
        given = bytes(data)
        self.put(self._at, given)
        return len(given)

    def put(self, at: int, data: bytes) -> None:
        """Write these bytes at this offset."""
        end = at + len(data)
        for page in _pages(at, end):
            begin = page * _PAGE
            if page not in self._pages:
                self._pages[page] = self._on_disk(page)
            first, last = max(at, begin), min(end, begin + _PAGE)
            self._pages[page][first - begin : last - begin] = data[first - at : last - at]
        self._size = max(self._size, end)

    def truncate(self, length: int | None = None) -> int:
        self._size = self._at if length is None else length
        return self._size

    @property
    def head(self) -> Superblock:
        """Superblock of the file including the writes."""
        self.seek(0)
        return Superblock(self.read(SIZE), self._there)

    @property
    def room(self) -> int:
        """Bytes by which the file grows; it never becomes shorter."""
        return max(0, self._size - self._there)

    @property
    def changed(self) -> bool:
        """Whether the writes differ from the content of the disk."""
        return bool(self.room or self._differing())

    def carry_out(self) -> None:
        """Write the changes to the file.

        Raises:
            DataError: its disk has no room or does not take it; the file is as it was.
            PartlyChangedError: the disk failed later.
        """
        if not self.changed:
            return
        if (free := shutil.disk_usage(self.path.parent).free) < self.room:
            raise DataError(
                f"{self.path} needs {size(self.room)} on its disk to be changed, {size(free)} are free. Nothing was "
                "changed."
            )
        longer = False
        try:
            with self.path.open("r+b", buffering=0) as file:
                for page in sorted(self._pages):
                    begin = max(page * _PAGE, self._there)
                    _put(file, begin, self._pages[page][begin - page * _PAGE : max(0, self._size - page * _PAGE)])
                if self.room:
                    file.truncate(self._size)
                to_disk(file.fileno())
                longer = True
                self._change(file)
        except OSError as error:
            why = error.strerror or str(error)
            if longer:
                raise PartlyChangedError(
                    f"{self.path} is changed only in part: its disk refused the rest ({why}). Its frames "
                    f"are safe. Mend the disk, then run `beamline recover` on it."
                ) from error
            with suppress(OSError):
                os.truncate(self.path, self._there)
            raise DataError(f"{self.path} cannot be made longer ({why}). Its content is unchanged.") from error

    def _change(self, file: Any) -> None:
        before = Superblock(bytes(self._on_disk(0)[:SIZE]), self._there)
        after, last = self.head.head, self._differing()
        if not before.open_for_writing:
            _put(file, 0, before.marked().head)
            to_disk(file.fileno())
        for at, data in last:
            skipped = max(0, SIZE - at)
            _put(file, at + skipped, data[skipped:])
        to_disk(file.fileno())
        _put(file, 0, after)
        to_disk(file.fileno())

    def _differing(self) -> list[tuple[int, bytes]]:
        """Bytes, within the present length of the file, that differ from the disk's, page by page."""
        differing = []
        for page in sorted(self._pages):
            begin, old, new = page * _PAGE, self._on_disk(page), self._pages[page]
            at = [i for i in range(min(_PAGE, self._there - begin)) if old[i] != new[i]]
            if at:
                differing.append((begin + at[0], bytes(new[at[0] : at[-1] + 1])))
        return differing

    def _on_disk(self, page: int) -> bytearray:
        out = bytearray(_PAGE)
        self._from_disk(page * _PAGE, memoryview(out))
        return out


def _pages(begin: int, end: int) -> range:
    return range(begin // _PAGE, -(-end // _PAGE))


def _put(file: Any, at: int, data: bytes | bytearray) -> None:
    file.seek(at)
    while data:
        data = data[file.write(data) :]
