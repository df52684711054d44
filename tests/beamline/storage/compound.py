"""Writes OLE compound files (MS-CFB, version 3), as a .txrm is one: streams of bytes in storages."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SECTOR, MINI, CUTOFF = 512, 64, 4096
FREE, END, FAT = 0xFFFFFFFF, 0xFFFFFFFE, 0xFFFFFFFD
STORAGE, STREAM, ROOT = 1, 2, 5


class _Chains:
    """Sectors of one size, and for each the next of its chain."""

    def __init__(self, size: int) -> None:
        self.size, self.content, self.following = size, bytearray(), list[int]()

    def add(self, data: bytes) -> int:
        """The first sector of new data; END for none."""
        n = -(-len(data) // self.size)
        first = len(self.following)
        self.content += data.ljust(n * self.size, b"\0")
        self.following += [*range(first + 1, first + n), END] if n else []
        return first if n else END


def write_compound(path: Path, streams: Mapping[str, bytes]) -> Path:
    """A file with these streams, named `storage/stream`; of fewer than 7 MB, which need no DIFAT sectors."""
    sectors, minis, entries = _Chains(SECTOR), _Chains(MINI), list[list[Any]]()
    tree: dict[str, Any] = {}
    for name, data in streams.items():
        *storages, last = name.split("/")
        place = tree
        for storage in storages:
            place = place.setdefault(storage, {})
        place[last] = data

    def add(name: str, item: Any) -> int:
        index = len(entries)
        entries.append([name, STREAM, FREE, FREE, FREE, END, 0])  # kind, left, right, child, start, size
        if isinstance(item, dict):
            entries[index][1], entries[index][4] = STORAGE, balanced([add(*each) for each in item.items()])
        else:
            small = len(item) < CUTOFF
            entries[index][5:] = (minis if small else sectors).add(item), len(item)
        return index

    def balanced(found: list[int]) -> int:
        """The middle one, with those before and after it as its branches: a search tree by length, then by name."""
        if not found:
            return FREE
        found = sorted(found, key=lambda i: (len(entries[i][0]), entries[i][0].upper()))
        middle = len(found) // 2
        entries[found[middle]][2:4] = balanced(found[:middle]), balanced(found[middle + 1 :])
        return found[middle]

    entries.append(["Root Entry", ROOT, FREE, FREE, FREE, END, 0])
    entries[0][4] = balanced([add(*each) for each in tree.items()])
    entries[0][5:] = sectors.add(bytes(minis.content)), len(minis.content)
    n_mini = -(-len(minis.following) * 4 // SECTOR)
    mini_fat = sectors.add(_words(minis.following, n_mini * SECTOR))
    directory = sectors.add(b"".join(_entry(*entry) for entry in entries))
    n = len(sectors.following)
    n_fat = next(k for k in range(1, 110) if k * SECTOR // 4 >= n + k)
    fat = _words([*sectors.following, *[FAT] * n_fat], n_fat * SECTOR)
    head = struct.pack(
        "<8s16xHHHHH6xIIIIIIIIII", bytes.fromhex("d0cf11e0a1b11ae1"), 0x3E, 3, 0xFFFE, 9, 6,
        0, n_fat, directory, 0, CUTOFF, mini_fat, n_mini, END, 0, n,
    )  # fmt: skip
    head += _words(list(range(n + 1, n + n_fat)), SECTOR - len(head))
    path.write_bytes(head + bytes(sectors.content) + fat)
    return path


def _words(values: list[int], size: int) -> bytes:
    return struct.pack(f"<{len(values)}I", *values).ljust(size, b"\xff")


def _entry(name: str, kind: int, left: int, right: int, child: int, start: int, size: int) -> bytes:
    text = name.encode("utf-16-le") + b"\0\0"
    return struct.pack("<64sHBBIII16xI16xIQ", text, len(text), kind, 1, left, right, child, 0, start, size)
