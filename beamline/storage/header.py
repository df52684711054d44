"""Header: the shape, type and place of a foreign file's voxels, checked before any of them is read.

Each function raises ValueError, which the reader of a format turns into a DataError with the path.
"""

from __future__ import annotations

import math
import os
import re
import sys
from typing import Any, BinaryIO

import numpy as np

PACKED = 1e5
"""No file of images holds so many times its own size: zeros come to 1000 times (deflate), and 20 000 (Zstandard)."""
_REAL = re.compile(r"[<>=|]?(u1|i1|[uif][248])|u?int(8|16|32|64)|float(16|32|64)")
_LONGEST, _MOST = 2**31, 2**60  # voxels along a side, and bytes in all: far beyond any volume


def shape_of(said: Any, what: str = "shape") -> tuple[int, int, int]:
    """Three whole numbers from 1 on, as [z, y, x] of a volume or of a chunk."""
    sides = tuple(said) if isinstance(said, list | tuple) else ()
    if len(sides) != 3 or any(isinstance(n, bool) or not isinstance(n, int | np.integer) for n in sides):
        raise ValueError(f"its {what} is {_brief(said)}; expected three whole numbers")
    if not all(1 <= n < _LONGEST for n in sides) or math.prod(map(int, sides)) > _MOST:
        raise ValueError(
            f"its {what} is {_brief(said)}; expected numbers from 1 to 2^31 - 1, and a volume of at most 2^60 bytes"
        )
    z, y, x = map(int, sides)
    return z, y, x


def numbers_of(said: Any, n: int, what: str) -> tuple[float, ...]:
    """A tuple of `n` finite numbers."""
    if not isinstance(said, list) or len(said) != n or not all(_is_number(each) for each in said):
        raise ValueError(f"its {what} is {_brief(said)}; expected {n} numbers")
    return tuple(map(float, said))


def _is_number(said: Any) -> bool:
    return isinstance(said, int | float) and not isinstance(said, bool) and abs(said) <= sys.float_info.max


def dtype_of(said: Any) -> np.dtype[Any]:
    """A type of real numbers of 1 to 8 bytes, little-endian."""
    if not isinstance(said, str) or _REAL.fullmatch(said) is None:
        raise ValueError(f"its voxels are {_brief(said)}; expected real numbers")
    return np.dtype(said).newbyteorder("<")


def require_held(shape: tuple[int, int, int], dtype: np.dtype[Any], begin: int, stored: int) -> None:
    """Raise ValueError unless the file stores all voxels from byte `begin` on."""
    needed = math.prod(shape) * dtype.itemsize
    if begin < 0 or begin + needed > stored:
        raise ValueError(
            f"its header states {' x '.join(map(str, shape))} voxels from byte {begin} on, but it has {stored} bytes"
        )


def require_npy(file: BinaryIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of an .npy; ValueError unless the file has all its values. Its position stays."""
    at, stored = file.tell(), os.fstat(file.fileno()).st_size
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    needed = file.tell() + math.prod(map(int, shape)) * dtype.itemsize
    file.seek(at)
    if any(n < 0 for n in shape) or needed > stored:
        raise ValueError(f"its header states the shape {_brief(shape)} of {dtype}, but it has {stored} bytes")
    return shape, dtype


def _brief(said: Any) -> str:
    text = repr(said) if not isinstance(said, int) else str(said) if abs(said) < 10**30 else "a huge number"
    return text if len(text) <= 60 else f"{text[:57]}..."
