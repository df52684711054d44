"""Torn blocks: parts of an HDF5 file that a kill left half written, made whole while HDF5 reads them.

A kill may end a write where two pages of the file system's memory meet. The block is then new up to there, and old
after it. Each field is the new or the old one, and both are right. Only the checksum, at the block's end, is not.
(HDF5 file format specification 3.0: object headers IV.A, extensible arrays VII.D.)
"""

from __future__ import annotations

from beamline.storage.superblock import lookup3

_PAGE = 4096  # bytes; larger pages end where some of these do
_HEADER = b"OHDR\2"
_OF_ITS_LENGTH = (b"EAHD\0", b"EAIB\0", b"EASB\0", b"EADB\0")  # HDF5 asks for as many bytes as these have
_TIMES, _PHASES = 0x20, 0x10  # flags of an object header: it has these fields


def made_whole(at: int, read: memoryview) -> tuple[int, bytes] | None:
    """Give a torn block the checksum of what is in it: in `read`, the bytes from `at` on that HDF5 asked for.

    Returns:
        where in the file the checksum is, and the right one. None: no block across the end of a page begins at `at`,
        or its checksum is right.
    """
    size = block_size(read)
    if not 8 < size <= len(read) or at // _PAGE == (at + size - 1) // _PAGE:
        return None
    right = lookup3(bytes(read[: size - 4]))
    if read[size - 4 : size] == right:
        return None
    read[size - 4 : size] = right
    return at + size - 4, right


def block_size(read: memoryview) -> int:
    """Bytes of the block that begins here, with its checksum; 0 for anything else."""
    kind = bytes(read[:5])
    if kind in _OF_ITS_LENGTH:
        return len(read)
    if kind != _HEADER or len(read) < 34:
        return 0
    flags = read[5]
    first, width = 6 + 16 * bool(flags & _TIMES) + 4 * bool(flags & _PHASES), 1 << (flags & 3)
    return first + width + int.from_bytes(read[first : first + width], "little") + 4
