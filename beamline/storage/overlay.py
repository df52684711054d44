"""Overlay: a file for HDF5 whose writes stay in memory; the disk does not change."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from beamline.storage.disk_file import UnderHdf5
from beamline.storage.journal import FileChange, FileChanges
from beamline.storage.torn import made_whole

_PAGE = 4096  # bytes: a change within one of these reaches the disk in one piece, as far as any does


class Overlay(UnderHdf5):
    """Bytes of a file, covered by later writes in memory, for h5py.File(overlay).

    Args:
        changes: bytes that replace the file's.
        length: of the file in bytes; bytes beyond its end are zero.
    """

    def __init__(self, path: Path, changes: Sequence[FileChange] = (), length: int = 0) -> None:
        super().__init__(path, "r", length)
        self._there = os.fstat(self._file.fileno()).st_size
        self._pages: dict[int, bytearray] = {}
        for change in changes:
            self.put(change.at, change.new)

    def _read(self, at: int, out: memoryview) -> None:
        self._from_disk(at, out)
        end = at + len(out)
        for page in _pages(at, end) if self._pages else ():
            if page in self._pages:
                begin = page * _PAGE
                first, last = max(at, begin), min(end, begin + _PAGE)
                out[first - at : last - at] = self._pages[page][first - begin : last - begin]

    def write(self, data: Any) -> int:
        given = bytes(data)
        self.put(self._at, given)
        return len(given)

    def put(self, at: int, data: bytes) -> None:
        """Write these bytes there."""
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

    def changes(self) -> FileChanges:
        """Written bytes that differ from the disk's; the file never becomes shorter."""
        ranges = []
        for page in sorted(self._pages):
            begin, old, new = page * _PAGE, self._on_disk(page), self._pages[page]
            there = min(max(self._there - begin, 0), _PAGE)  # of this page; the file has nothing after it
            stop = min(max(self._size - begin, there), _PAGE)
            differ = [i for i in range(stop) if i >= there or old[i] != new[i]]
            if differ:
                first, last = differ[0], differ[-1] + 1
                ranges.append(FileChange(begin + first, bytes(old[first : min(last, there)]), bytes(new[first:last])))
        return FileChanges(self.path, max(self._there, self._size), tuple(ranges))

    def _on_disk(self, page: int) -> bytearray:
        out = bytearray(_PAGE)
        self._from_disk(page * _PAGE, memoryview(out))
        return out


class WholeBlocks(Overlay):
    """An overlay that makes torn blocks whole."""

    def _read(self, at: int, out: memoryview) -> None:
        super()._read(at, out)
        if (mended := made_whole(at, out)) is not None:
            self.put(*mended)


def _pages(begin: int, end: int) -> range:
    return range(begin // _PAGE, -(-end // _PAGE))
