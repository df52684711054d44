"""Tiles: parts of a picture, binned to the screen's resolution and packed as 16-bit numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST = 1024
"""Pixels that a tile has along an axis, at most."""
_GREATEST = 65535


@dataclass(frozen=True)
class TileRegion:
    """Half-open rows and columns of a picture."""

    first_row: int
    last_row: int
    first_col: int
    last_col: int

    def inside(self, shape: tuple[int, int]) -> TileRegion:
        """Its part inside a picture of this shape; at least one pixel."""
        rows, cols = shape
        first_row, first_col = min(max(self.first_row, 0), rows - 1), min(max(self.first_col, 0), cols - 1)
        last_row, last_col = min(max(self.last_row, first_row + 1), rows), min(max(self.last_col, first_col + 1), cols)
        return TileRegion(first_row, last_row, first_col, last_col)

    @property
    def slices(self) -> tuple[slice, slice]:
        return slice(self.first_row, self.last_row), slice(self.first_col, self.last_col)

    def binning(self) -> int:
        """The smallest binning that leaves at most MOST pixels along each axis."""
        return max(1, -(-max(self.last_row - self.first_row, self.last_col - self.first_col) // MOST))


def bin_mean(pixels: NDArray[Any], factors: tuple[int, int]) -> NDArray[np.float32]:
    """Means of blocks of pixels, rows x columns; those left over at the last row and column are means of fewer."""
    if factors == (1, 1):
        return pixels.astype(np.float32)
    starts = [np.arange(0, n, factor) for n, factor in zip(pixels.shape, factors, strict=True)]
    sums = np.add.reduceat(np.add.reduceat(pixels.astype(np.float32), starts[0], 0), starts[1], 1)
    counts = [np.minimum(factor, n - first) for n, factor, first in zip(pixels.shape, factors, starts, strict=True)]
    return np.asarray(sums / np.outer(*counts), np.float32)


@dataclass(frozen=True, eq=False)
class PackedValues:
    """Values as u2 [row, col]: a value is offset + scale * number; 65535 stands for one that is not finite."""

    numbers: NDArray[np.uint16]
    offset: float
    scale: float


def pack(values: NDArray[np.float32]) -> PackedValues:
    """Values with 65534 steps from their least to their greatest."""
    finite = np.isfinite(values)
    low, high = (float(values[finite].min()), float(values[finite].max())) if finite.any() else (0.0, 0.0)
    scale = (high - low) / (_GREATEST - 1) or 1.0
    numbers = np.rint((np.where(finite, values, low) - np.float32(low)) / np.float32(scale))
    return PackedValues(np.where(finite, np.clip(numbers, 0, _GREATEST - 1), _GREATEST).astype("<u2"), low, scale)
