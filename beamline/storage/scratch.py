"""Scratch arrays: in a file without a name, so that nothing of them stays, whatever ends the process."""

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
    wanted, free = 4 * int(np.prod(shape, dtype=np.int64)), shutil.disk_usage(folder).free
    refusal = f"{folder} needs {size(wanted)} for scratch, and {size(free)} are free. Write the output to another disk."
    if wanted > free:
        raise DataError(refusal)
    with tempfile.TemporaryFile(dir=folder) as file:  # the map keeps it open
        if hasattr(os, "posix_fallocate"):  # space that is not there is missed now, not in the middle of the work
            try:
                os.posix_fallocate(file.fileno(), 0, wanted)
            except OSError as error:
                raise DataError(refusal) from error
        return np.memmap(file, np.float32, "r+" if os.fstat(file.fileno()).st_size == wanted else "w+", shape=shape)
