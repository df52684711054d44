"""A format of scans."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.storage.frame_table import FrameTable
from beamline.storage.readers.base import WHOLE, ScanFormat, ScanSource, frame_indices
from drivers.base.frame import FrameKind


class NpyStack(ScanSource):
    """Frames of an .npy; the caller brings the angles."""

    format = "npy_stack"

    def __init__(self, path: Path) -> None:
        self.path, self._data = path, np.load(path, allow_pickle=False)
        self.shape, self.dtype, self.facts = self._data.shape[1:], self._data.dtype, {}
        self.table = FrameTable.of(np.full(len(self._data), FrameKind.PROJECTION))

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        return self._data[frame_indices(frames, len(self._data)), rows]

    def close(self) -> None:
        pass


FORMAT = ScanFormat("an .npy stack", lambda path, _: path.suffix == ".npy", lambda path, _: NpyStack(path))
