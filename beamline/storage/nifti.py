"""NIfTI-1: a volume from a .nii or .nii.gz file, as medical scans have it.

Cox et al., "A (sort of) new image data format standard: NIfTI-1", Human Brain Mapping 25, 2004; offsets are those of
its 348-byte header. Only single files (magic "n+1"), real numbers and three axes are read; the orientation of the
patient is not: the volume comes as [z, y, x] in the order in which it is stored.
"""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError

HEADER = 348
DTYPES = MappingProxyType(
    {2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4", 1024: "i8", 1280: "u8"}
)
LENGTHS = MappingProxyType({0: 1.0, 1: 1e3, 2: 1.0, 3: 1e-3})
"""mm of a metre, a millimetre, a micrometre, by xyzt_units; nothing said is taken for mm."""


def read_nifti(path: Path) -> tuple[NDArray[np.generic], tuple[float, float, float]]:
    """The volume [z, y, x], its values scaled as the header says, and mm from voxel to voxel along (z, y, x).

    Values are float32 where the header scales them, and of the file's type (in the machine's byte order) where not.

    Raises:
        DataError: it is no such file, or is cut short.
    """
    try:
        with gzip.open(path) if path.name.lower().endswith(".gz") else path.open("rb") as file:
            return _volume(path, file)
    except (OSError, EOFError, zlib.error) as error:
        raise DataError(f"{path} cannot be read as NIfTI ({error}).") from error
    except (MemoryError, OverflowError, ValueError) as error:
        raise DataError(f"{path} cannot be read as NIfTI: its header asks for more than there can be.") from error


def _volume(path: Path, file: BinaryIO | gzip.GzipFile) -> tuple[NDArray[np.generic], tuple[float, float, float]]:
    header = file.read(HEADER)
    order = "<" if header[:4] == struct.pack("<i", HEADER) else ">"
    if len(header) < HEADER or header[:4] != struct.pack(f"{order}i", HEADER) or header[344:348] != b"n+1\0":
        raise DataError(f"{path} is no single-file NIfTI-1 (its header says {header[:4]!r} and {header[344:348]!r}).")
    dims = struct.unpack_from(f"{order}8h", header, 40)
    code, bits = struct.unpack_from(f"{order}2h", header, 70)
    sizes = struct.unpack_from(f"{order}8f", header, 76)
    offset, slope, intercept = struct.unpack_from(f"{order}3f", header, 108)
    if code not in DTYPES or bits != 8 * np.dtype(DTYPES[code]).itemsize:
        raise DataError(f"{path} holds values of type {code} with {bits} bits; real numbers of 8 to 64 bits are read.")
    if not (3 <= dims[0] <= 7 and min(dims[1:4]) >= 1 and all(n == 1 for n in dims[4 : dims[0] + 1])):
        raise DataError(f"{path} has the axes {dims[1 : max(dims[0], 0) + 1]}; a volume has three.")
    if not (math.isfinite(offset) and offset >= HEADER and all(math.isfinite(d) and d != 0 for d in sizes[1:4])):
        raise DataError(f"{path}: voxels of {sizes[1:4]}, values from byte {offset:g} on: the header is damaged.")
    if (unit := header[123] & 7) not in LENGTHS:
        raise DataError(f"{path}: lengths in unit {unit} of xyzt_units; 1, 2 and 3 (m, mm, um) are known.")
    nx, ny, nz = dims[1:4]
    dtype = np.dtype(f"{order}{DTYPES[code]}")
    n = nx * ny * nz * dtype.itemsize
    file.seek(int(offset))
    data = file.read(n)
    if len(data) < n:
        raise DataError(f"{path} ends after {len(data)} of the {n} bytes of its {nz} x {ny} x {nx} voxels.")
    values = np.frombuffer(data, dtype).reshape(nz, ny, nx)
    z, y, x = (abs(size) * LENGTHS[unit] for size in sizes[3:0:-1])
    if not math.isfinite(slope) or slope == 0 or (slope == 1 and intercept == 0):
        return values.astype(dtype.newbyteorder("=")), (z, y, x)
    with np.errstate(over="ignore", invalid="ignore"):  # what is beyond float32 is infinite, and its user's to refuse
        return values.astype(np.float32) * np.float32(slope) + np.float32(intercept), (z, y, x)
