"""Slices of a volume file of any size: by the scales of a file that has them, else with the help of a coarse copy."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from beamline.page.tiles import TileRegion, bin_mean
from beamline.storage import hdf5
from beamline.storage.volumes.base import VolumeScale

F32 = NDArray[np.float32]
HELD = 2**29
"""Bytes of the copy of a volume: all of it, or every n-th slice, binned by n."""
_AT_ONCE = 2**26  # bytes of a volume that are read before the first picture
_READ = 2**28  # bytes of a file with scales that are read for one slice, at most
_SAMPLE = 2_000_000  # values that show the histogram as well as all do
_Piece = tuple[NDArray[Any], TileRegion, int]


class VolumeSlices(Protocol):
    """Slices of a volume. All calls come from one thread (HDF5)."""

    @property
    def bin(self) -> int:
        """Binning of slices across y and x, however far one zooms in."""

    @property
    def ready(self) -> float:
        """The share of the copy that has been read."""

    def read_more(self) -> bool:
        """Read one more slice of the copy; False: there is no more."""

    def part(self, axis: int, index: int, region: TileRegion) -> _Piece:
        """A part of a slice with at least what the region shows; the region of this part, and its binning."""

    def sample(self) -> NDArray[Any]:
        """Values that stand for all, flat; all of them where they are few."""


def slices_of(path: Path, values: Any, held: int) -> VolumeSlices:
    """Slices of the voxels in a file."""
    if isinstance(values, VolumeScale) and 4 * math.prod((values, *values.coarser)[-1].shape) <= held:
        return ScaledSlices(values)
    return CopiedSlices(path, values, held)


class ScaledSlices:
    """Of a file with scales: the one that a tile needs, or a coarser one where that takes reading more than `_READ`."""

    bin, ready = 1, 1.0

    def __init__(self, finest: VolumeScale) -> None:
        self._scales = [(scale, _steps(finest.shape, scale.shape)) for scale in (finest, *finest.coarser)]

    def read_more(self) -> bool:
        return False

    def part(self, axis: int, index: int, region: TileRegion) -> _Piece:
        sides = [i for i in range(3) if i != axis]
        n_rows, n_cols = (self._scales[0][0].shape[i] for i in sides)
        shown = region.inside((n_rows, n_cols))
        square = [(scale, steps) for scale, steps in self._scales if steps[sides[0]] == steps[sides[1]]]
        fine = sum(steps[sides[0]] <= shown.binning() for _, steps in square)
        for scale, steps in square[fine - 1 :]:
            bin_, at = steps[sides[0]], min(index // steps[axis], scale.shape[axis] - 1)
            first, end = [at] * 3, [at + 1] * 3
            for i, edges in zip(sides, shown.slices, strict=True):
                first[i] = min(edges.start // bin_, scale.shape[i] - 1)
                end[i] = min(-(-edges.stop // bin_), scale.shape[i])
            if _bytes_read(scale, axis, first, end) <= _READ:
                break
        rows, cols = ((first[i] * bin_, end[i] * bin_) for i in sides)
        return scale.box(_place(first), _place(end)).squeeze(axis), TileRegion(*rows, *cols), bin_

    def sample(self) -> NDArray[Any]:
        coarsest, _ = self._scales[-1]
        values = coarsest.box((0, 0, 0), coarsest.shape).reshape(-1)
        return values[:: max(1, values.size // _SAMPLE)]


class CopiedSlices:
    """Of a file whose slices across y and x are spread over all of it: these come from a copy, those across z from
    the file. The copy is read a slice at a time, first a few from all over the volume, then those between them."""

    def __init__(self, path: Path, values: Any, held: int) -> None:
        self._path, self._values = path, values
        self.bin = math.ceil((4 * math.prod(values.shape) / held) ** (1 / 3))
        shape = [-(-n // self.bin) for n in values.shape]
        self._copy = np.empty(shape, np.float32)
        self._filled = np.zeros(shape[0], bool)
        spread = sorted(range(shape[0]), key=lambda z: -(z & -z or 2 * shape[0]))  # 0, the halves, the quarters ...
        self._waiting = iter(spread)
        for _ in range(max(1, _AT_ONCE // (4 * math.prod(values.shape[1:])))):
            self.read_more()

    @property
    def ready(self) -> float:
        return float(self._filled.mean())

    def read_more(self) -> bool:
        z = next(self._waiting, None)
        if z is None:
            return False
        self._copy[z] = bin_mean(self._read(z * self.bin), (self.bin, self.bin))
        self._filled[z] = True
        return True

    def part(self, axis: int, index: int, region: TileRegion) -> _Piece:
        rows, cols = (n for i, n in enumerate(self._values.shape) if i != axis)
        shown, whole = region.inside((rows, cols)), TileRegion(0, rows, 0, cols)
        if axis == 0:
            return self._read(index)[shown.slices], shown, 1
        known = np.flatnonzero(self._filled)
        nearest = known[np.searchsorted((known[1:] + known[:-1]) / 2, np.arange(self._filled.size))]
        values = self._copy.take(index // self.bin, axis)[nearest]
        return (values[shown.slices], shown, 1) if self.bin == 1 else (values, whole, self.bin)

    def sample(self) -> NDArray[Any]:
        step = max(1, math.isqrt(int(self._filled.sum()) * self._copy[0].size // _SAMPLE))
        return self._copy[:, ::step, ::step][self._filled].reshape(-1)

    def _read(self, z: int) -> F32:
        with hdf5.readable(self._path):
            return np.asarray(self._values[z : z + 1][0], np.float32)


def _place(index: list[int]) -> tuple[int, int, int]:
    z, y, x = index
    return z, y, x


def _steps(finest: tuple[int, ...], shape: tuple[int, ...]) -> tuple[int, ...]:
    """Voxels of the finest scale in one, along each axis: powers of two, as `OmeZarr` writes them."""
    return tuple(2 ** round(math.log2(n / m)) for n, m in zip(finest, shape, strict=True))


def _bytes_read(scale: VolumeScale, axis: int, first: list[int], end: list[int]) -> int:
    """Of a box that is one voxel thick: chunks as a whole, or across z one plane of each."""
    chunks = [-(-b // n) - a // n for a, b, n in zip(first, end, scale.chunk, strict=True)]
    planes = 1 if axis or scale.whole_chunks else scale.chunk[0]
    return math.prod(chunks) * scale.dtype.itemsize * math.prod(scale.chunk) // planes
