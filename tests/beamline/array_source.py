"""A scan in memory that records which of its parts a reader reads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.storage.frame_table import FrameTable
from beamline.storage.readers.base import Quantity, ScanSource
from beamline.storage.writers.rows import ScanEnding


def scan_of(
    darks: NDArray[Any], flats: NDArray[Any], views: NDArray[Any], angles: NDArray[np.float64], dtype: Any = np.uint16
) -> ArraySource:
    """A scan of darks, flats and projections [frame, row, col]; the projections have angles."""
    frames, before = np.concatenate([darks, flats, views]), len(darks) + len(flats)
    keys = [2] * len(darks) + [1] * len(flats) + [0] * len(views)
    return ArraySource(frames.astype(dtype), keys, np.r_[np.full(before, np.nan), angles])


def counted(views: NDArray[Any], angles: NDArray[np.float64], dtype: Any = np.uint16) -> ArraySource:
    """A scan with a dark of 100 counts, a flat that is 20,000 counts brighter, and these projections."""
    dark = np.full((1, *views.shape[1:]), 100.0)
    return scan_of(dark, dark + 20_000, views, angles, dtype)


class ArraySource(ScanSource):
    """A scan of counts in arrays that records what is read."""

    path, format = Path("array"), "array"
    quantity: Quantity = "counts"
    finished, checksummed, ending = True, False, ScanEnding()
    damaged: frozenset[int] = frozenset()
    frame_bytes = 0

    def __init__(
        self,
        data: NDArray[Any],
        keys: list[int],
        angles: NDArray[np.float64],
        exposures: NDArray[np.float64] | None = None,
    ) -> None:
        self._data, n = data, len(data)
        self.table = FrameTable.of(keys, angles, exposures, triggers=np.arange(n), framestamps=np.full(n, 7))
        self.shape, self.dtype, self.facts = data.shape[1:], data.dtype, {}
        self.frame_bytes = data[0].nbytes
        self.was_read: list[tuple[list[int], int]] = []

    def state(self, **columns: Any) -> None:
        """Replace columns of the frame table."""
        self.table = replace(self.table, **columns)

    def read(self, frames: Any, rows: slice = slice(None)) -> NDArray[Any]:
        block = self._data[frames, rows]
        self.was_read.append((np.arange(len(self._data))[frames].tolist(), block.shape[1]))
        return block

    def close(self) -> None:
        pass
