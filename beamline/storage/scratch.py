"""Scratch arrays in a file without a name, which vanishes however the process ends."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.text import size


def scratch_array(folder: Path, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Float32 zeros of this shape that lie on the disk of `folder`, as a memory map.

    Raises:
        DataError: the disk has not so much space.
    """
    wanted = 4 * int(np.prod(shape, dtype=np.int64))
    with tempfile.TemporaryFile(dir=folder) as file:  # the map keeps it open
        reserve(file.fileno(), wanted, folder)
        return np.memmap(file, np.float32, "r+" if os.fstat(file.fileno()).st_size == wanted else "w+", shape=shape)


def reserve(descriptor: int, wanted: int, folder: Path) -> None:
    """Take so many bytes for an open file in the folder where the system can. Missing space is then found now, not in
    the middle of the work.

    Raises:
        DataError: the disk has not so much space.
    """
    there, free = os.fstat(descriptor), shutil.disk_usage(folder).free
    taken = 512 * getattr(there, "st_blocks", (there.st_size + 511) // 512)
    refusal = (
        f"{folder} has {size(free)} free, and {size(wanted - taken)} more are needed while the volume is made. Write "
        "the output to another disk. Nothing was written."
    )
    if wanted - taken > free:
        raise DataError(refusal)
    if hasattr(os, "posix_fallocate"):
        try:
            os.posix_fallocate(descriptor, 0, wanted)
        except OSError as error:
            raise DataError(refusal) from error
