"""Structure of an HDF5 file: checks its objects and the other files that it refers to, before any of them is opened.

HDF5 opens whatever a link names. It would wait for ever for a pipe, or while it reads the names of deeply nested
groups.

Functions on the shape, type and position of voxels raise ValueError. The reader of a format turns it into a DataError
with the path.
"""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np

from beamline.core.errors import DataError
from beamline.core.files import require_regular

MOST_OBJECTS, DEEPEST = 50_000, 64
CLAIMED = 1e9  # bytes
# h5py's text for a circle of links, which cannot be followed
_DAMAGED = (OSError, RuntimeError, LookupError, TypeError, ValueError)


def require_harmless(file: h5py.File) -> None:
    """Raise DataError for a file that it is not safe to read.

    A file is unsafe in any of these cases: it has more objects or deeper groups than any scan; it refers to a path that
    is not a regular file; it states more data than it contains; its values are plain bytes in another file.
    """
    path = Path(file.filename)
    for name in dict.fromkeys(_names(file, path)):
        # HDF5 looks for the linked file in three places: under the path as written, relative to this file, and by its
        # name alone next to this file.
        for place in (Path(name), path.parent / name, path.parent / Path(name).name):
            if place.is_dir():
                continue
            try:
                require_regular(place)
            except OSError as error:
                raise DataError(
                    f"{path} has a link to {name}, which does not occur in scans ({error.strerror}). Nothing was read."
                ) from error


def _names(file: h5py.File, path: Path) -> Iterator[str]:
    """Yields the other files to which links and datasets refer."""
    groups, known = [(h5py.h5g.open(file.id, b"/"), 0)], set[tuple[int, int]]()
    while groups:
        group, depth = groups.pop()
        names = [*group]
        if len(known) + len(names) > MOST_OBJECTS or depth > DEEPEST:
            raise DataError(
                f"{path} has more than {MOST_OBJECTS} objects, or groups more than {DEEPEST} levels deep: the file "
                "is neither a scan nor a volume. Nothing was read."
            )
        for name in names:
            with suppress(*_DAMAGED):
                kind = group.links.get_info(name).type
                if kind == h5py.h5l.TYPE_EXTERNAL:
                    yield os.fsdecode(group.links.get_val(name)[0])
                if kind != h5py.h5l.TYPE_HARD:
                    continue
                info = h5py.h5o.get_info(group, name)
                if (info.fileno, info.addr) in known:
                    continue
                known.add((info.fileno, info.addr))
                if info.type == h5py.h5o.TYPE_GROUP:
                    groups.append((h5py.h5g.open(group, name), depth + 1))
                elif info.type == h5py.h5o.TYPE_DATASET:
                    dataset = h5py.h5d.open(group, name)
                    properties = dataset.get_create_plist()
                    _refuse_claim(dataset, properties, f"{path}: {name.decode('utf-8', 'replace')}")
                    if properties.get_layout() == h5py.h5d.VIRTUAL:
                        yield from (other for other, _ in drawn_on(properties) if other != ".")


def _refuse_claim(dataset: Any, properties: Any, what: str) -> None:
    """Raise DataError if a dataset states more data than any compression could make of the stored bytes. Also if its
    values are plain bytes in another file, because this could be any file that the user may read.
    """
    if properties.get_external_count():
        other_file = os.fsdecode(properties.get_external(0)[0])
        raise DataError(
            f"{what} has its values in {other_file}, which is not an HDF5 file and is not read. Copy the values into "
            "the dataset. Nothing was read."
        )
    chunk, shape = properties.get_chunk() if properties.get_layout() == h5py.h5d.CHUNKED else (), dataset.shape or ()
    sides = [-(-side // across) * across for side, across in zip(shape, chunk, strict=True)] if chunk else shape
    n, piece = (math.prod(each) * dataset.dtype.itemsize for each in (sides, chunk))
    if (n < CLAIMED and piece <= _LARGE) or properties.get_layout() == h5py.h5d.VIRTUAL:
        return
    if n > PACKED * (stored := dataset.get_storage_size()) or is_blank(n, stored, piece):
        claimed_gb = n / 1e9
        raise DataError(f"{what} states {claimed_gb:.3g} GB, but only {stored} bytes are stored. Nothing was read.")


def drawn_on(properties: Any) -> Iterator[tuple[str, str]]:
    """(file, dataset) of each source of a virtual dataset; "." is the file that contains the virtual dataset."""
    for i in range(min(properties.get_virtual_count(), MOST_OBJECTS)):
        yield plain_name(properties.get_virtual_filename(i)), plain_name(properties.get_virtual_dsetname(i))


def plain_name(written: str) -> str:
    """The name of a source of a virtual dataset; %% becomes %. Raises DataError for %b, which stands for a number to be
    filled in.
    """
    if "%b" in written.replace("%%", ""):
        raise DataError(
            f"A virtual dataset refers to a numbered series of files, {written}, which is not supported. Copy the "
            "values to an ordinary dataset. Nothing was read."
        )
    return written.replace("%%", "%")


PACKED = 1e5
"""Largest ratio of data to stored bytes. No file of images exceeds it: zeros have a ratio of 1000 with deflate, and of
20 000 with Zstandard.
"""
_BLANK, _LARGE = 500, 2**28
_REAL = re.compile(r"[<>=|]?(u1|i1|[uif][248])|u?int(8|16|32|64)|float(16|32|64)")
_LONGEST, _MOST = 2**31, 2**60  # most voxels along a side, and most bytes in total; far above any volume


def is_blank(unpacked: int, stored: int, piece: int) -> bool:
    """True if images in large chunks use less than a 500th of their bytes in the file.

    Shot noise of one count in a hundred pixels needs 0.08 bits per pixel of 16 bits, a 200th. Data that are packed more
    closely are not an image, and may have been made to fill the memory.
    """
    return piece > _LARGE and unpacked > _BLANK * stored


def shape_of(value: Any, what: str = "shape") -> tuple[int, int, int]:
    """The shape [z, y, x] of a volume or of a chunk: three integers of at least 1. Raises ValueError for anything
    else.
    """
    sides = tuple(value) if isinstance(value, list | tuple) else ()
    if len(sides) != 3 or any(isinstance(n, bool) or not isinstance(n, int | np.integer) for n in sides):
        raise ValueError(f"the {what} is {_brief(value)}; expected three integers")
    if not all(1 <= n < _LONGEST for n in sides) or math.prod(map(int, sides)) > _MOST:
        raise ValueError(
            f"the {what} is {_brief(value)}; expected numbers from 1 to 2^31 - 1, and a volume of at most 2^60 bytes"
        )
    z, y, x = map(int, sides)
    return z, y, x


def numbers_of(value: Any, n: int, what: str) -> tuple[float, ...]:
    """A tuple of `n` finite numbers. Raises ValueError for anything else."""
    if not isinstance(value, list) or len(value) != n or not all(_is_number(each) for each in value):
        raise ValueError(f"the {what} is {_brief(value)}; expected {n} numbers")
    return tuple(map(float, value))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def dtype_of(value: Any) -> np.dtype[Any]:
    """The little-endian type of real numbers with 1 to 8 bytes. Raises ValueError for any other type."""
    if not isinstance(value, str) or _REAL.fullmatch(value) is None:
        raise ValueError(f"its voxels are {_brief(value)}; expected real numbers")
    return np.dtype(value).newbyteorder("<")


def require_held(shape: tuple[int, int, int], dtype: np.dtype[Any], begin: int, stored: int) -> None:
    """Raise ValueError unless the file has all voxels from byte `begin` on."""
    needed = math.prod(shape) * dtype.itemsize
    if begin < 0 or begin + needed > stored:
        shape_text = " x ".join(map(str, shape))
        raise ValueError(f"the header states {shape_text} voxels from byte {begin} on, but the file has {stored} bytes")


def require_npy(file: BinaryIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of an .npy; raises ValueError unless the file has all its values. The file position is kept."""
    start, stored = file.tell(), os.fstat(file.fileno()).st_size
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    needed = file.tell() + math.prod(map(int, shape)) * dtype.itemsize
    file.seek(start)
    if any(n < 0 for n in shape) or needed > stored:
        raise ValueError(f"the header states the shape {_brief(shape)} of {dtype}, but the file has {stored} bytes")
    return shape, dtype


def _brief(value: Any) -> str:
    text = repr(value) if not isinstance(value, int) else str(value) if abs(value) < 10**30 else "a huge number"
    return text if len(text) <= 60 else f"{text[:57]}..."
