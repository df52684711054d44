"""Reads low-level blocks of HDF5: the first 48 bytes of a file, and blocks that are half written because the process
was killed.

The superblock states whether the file is being written and how many bytes it has. If the process is killed, a write may
end at the boundary of two pages of memory. The block is then new before this boundary and old after it. Each field has
either its new or its old value, and both are valid. Only the checksum at the end of the block is wrong. (Specification
3.0: object headers IV.A, extensible arrays VII.D.)

Superblocks of versions 2 and 3 at the beginning of the file (HDF5 file format specification 3.0, II.A). Fields:
signature 8, version 1, sizes 2, flags 1, base address 8, extension 8, end of file 8, root group 8, checksum 4 bytes,
little-endian.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

SIZE = 48
_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_FLAGS, _END, _CHECKSUM = 11, slice(28, 36), slice(44, 48)
_GROWS = 4
_WORD = 0xFFFFFFFF

_PAGE = 4096  # bytes; the boundaries of larger pages are also boundaries of these
_HEADER = b"OHDR\2"
_OF_ITS_LENGTH = (b"EAHD\0", b"EAIB\0", b"EASB\0", b"EADB\0")  # HDF5 reads blocks with this number of bytes
_TIMES, _PHASES = 0x20, 0x10  # flags of an object header: which fields it has


@dataclass(frozen=True)
class Superblock:
    """The superblock of an HDF5 file: its bytes, its fields, and the size of the file."""

    head: bytes
    size: int

    @property
    def open_for_writing(self) -> bool:
        """True if a program is writing the file, or was killed while writing it."""
        return self.head[_FLAGS] != 0

    @property
    def grows(self) -> bool:
        """True if the file is written in such a way that others can read it at the same time (SWMR)."""
        return bool(self.head[_FLAGS] & _GROWS)

    @property
    def missing(self) -> int:
        """Number of bytes that are missing at the end of the file according to the superblock."""
        return max(0, self.end - self.size)

    @property
    def end(self) -> int:
        """Length of the file in bytes according to the superblock."""
        return int.from_bytes(self.head[_END], "little")

    def closed(self, end: int) -> bytes:
        """The superblock that the file would have if it had been closed with `end` bytes."""
        head = bytearray(self.head)
        head[_FLAGS] = 0
        head[_END] = end.to_bytes(8, "little")
        head[_CHECKSUM] = lookup3(bytes(head[: _CHECKSUM.start]))
        return bytes(head)


def superblock(path: Path) -> Superblock | None:
    """The superblock of a file. None unless the file begins with a complete superblock of a supported version, with
    addresses of eight bytes.
    """
    with path.open("rb") as file:
        head = file.read(SIZE)
    if len(head) < SIZE or head[:8] != _SIGNATURE or head[8] not in (2, 3) or head[9] != 8:
        return None
    return Superblock(head, path.stat().st_size) if head[_CHECKSUM] == lookup3(head[: _CHECKSUM.start]) else None


def marked_as_being_written(path: Path) -> bool:
    """True if the file is marked as being written: a program is writing it, or was killed while writing it."""
    head = superblock(path)
    return head is not None and head.open_for_writing


def mend_checksum(offset: int, read: memoryview) -> None:
    """Repair the checksum of a block that is half written because the process was killed or the power failed. `read`
    contains the bytes from position `at` on that HDF5 has requested. On either side of the end of a memory page, each
    field has its new or its old value.
    """
    size = block_size(read)
    if 8 < size <= len(read) and offset // _PAGE != (offset + size - 1) // _PAGE:
        read[size - 4 : size] = lookup3(bytes(read[: size - 4]))


def block_size(read: memoryview) -> int:
    """Length in bytes, including the checksum, of the block that begins here; 0 if no known block begins here."""
    kind = bytes(read[:5])
    if kind in _OF_ITS_LENGTH:
        return len(read)
    if kind != _HEADER or len(read) < 34:
        return 0
    flags = read[5]
    first, width = 6 + 16 * bool(flags & _TIMES) + 4 * bool(flags & _PHASES), 1 << (flags & 3)
    return first + width + int.from_bytes(read[first : first + width], "little") + 4


def lookup3(data: bytes) -> bytes:
    """The checksum of HDF5's metadata (Jenkins 2006, `hashlittle` from 0)."""
    words = [int.from_bytes(data[i : i + 4], "little") for i in range(0, len(data), 4)]
    state = [0xDEADBEEF + len(data) & _WORD] * 3
    while words:
        state = [(x + word) & _WORD for x, word in zip(state, [*words, 0, 0][:3], strict=True)]
        words = words[3:]
        if words:
            for i, bits in enumerate((4, 6, 8, 16, 19, 4)):
                here, last, after = i % 3, (i + 2) % 3, (i + 1) % 3
                state[here] = ((state[here] - state[last]) & _WORD) ^ _turned(state[last], bits)
                state[last] = (state[last] + state[after]) & _WORD
    for i, bits in enumerate((14, 11, 25, 16, 4, 14, 24)):
        here, last = (i + 2) % 3, (i + 1) % 3
        state[here] = ((state[here] ^ state[last]) - _turned(state[last], bits)) & _WORD
    return state[2].to_bytes(4, "little")


def _turned(word: int, bits: int) -> int:
    return (word << bits | word >> (32 - bits)) & _WORD
