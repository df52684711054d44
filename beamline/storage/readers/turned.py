"""Frames that a file stores in another order of dimensions, such as sinograms [row, frame, col]."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.storage.hdf5 import bytes_unpacked


class TurnedFrames:
    """A dataset of three dimensions, read as [frame, row, col]."""

    def __init__(self, item: h5py.Dataset, order: tuple[int, int, int]) -> None:
        """`order`: which dimensions of `item` are frames, rows and columns."""
        self._item, self._order = item, order
        self.shape = tuple(item.shape[axis] for axis in order)
        self.dtype, self.ndim, self.name, self.file = item.dtype, 3, item.name, item.file

    @property
    def frame_bytes(self) -> int:
        """Bytes that are unpacked to read a frame."""
        return bytes_unpacked(self._item, self._order[0])

    def __len__(self) -> int:
        return int(self.shape[0])

    def __getitem__(self, wanted: tuple[slice, slice]) -> NDArray[Any]:
        stored = [slice(None)] * 3
        for axis, part in zip(self._order, wanted, strict=False):
            stored[axis] = part
        return np.asarray(self._item[tuple(stored)]).transpose(self._order)


def dimensions(axes: Sequence[str]) -> tuple[int, int, int] | None:
    """Which of three named dimensions are frames, rows and columns; None where the names do not tell.

    x, u or columns; y, v or rows; the third, whatever its name (theta, rotation_angle), are frames.
    """
    names = [axis.strip().lower() for axis in axes]
    cols = [i for i, name in enumerate(names) if name[:1] in ("x", "u") or name.startswith("col")]
    rows = [i for i, name in enumerate(names) if name[:1] in ("y", "v") or name.startswith("row")]
    if len(names) != 3 or len(cols) != 1 or len(rows) != 1:
        return None
    return 3 - cols[0] - rows[0], rows[0], cols[0]
