"""A scan in memory that notes what is read of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.storage.writers.rows import ScanEnding
from drivers.base.frame import Frame, FrameKind


def scan_of(
    darks: NDArray[Any], flats: NDArray[Any], views: NDArray[Any], angles: NDArray[np.float64], dtype: Any = np.uint16
) -> ArraySource:
    """Darks, flats and views [frame, row, col], of which the views have angles."""
    frames, before = np.concatenate([darks, flats, views]), len(darks) + len(flats)
    keys = [2] * len(darks) + [1] * len(flats) + [0] * len(views)
    return ArraySource(frames.astype(dtype), keys, np.r_[np.full(before, np.nan), angles])


def counted(views: NDArray[Any], angles: NDArray[np.float64], dtype: Any = np.uint16) -> ArraySource:
    """A dark of 100 counts, a flat of 20,000 more and these views."""
    dark = np.full((1, *views.shape[1:]), 100.0)
    return scan_of(dark, dark + 20_000, views, angles, dtype)


class ArraySource:
    """A ScanSource over arrays that notes what is read of it."""

    path = Path("array")
    format = "array"
    quantity = "counts"
    pixel_size_mm: float | None = None
    energy_kev: float | None = None
    axis_col: float | None = None
    central_ray: tuple[float, float] | None = None
    untyped = False
    cols: tuple[int, int] | None = None
    cone: tuple[float, float] | None = None
    row_pitch_mm: float | None = None
    in_order, numbers, frames_per_view = True, None, 1
    not_used: tuple[Any, ...] = ()
    attributes: dict[str, Any] = {}  # noqa: RUF012
    row_period: float | None = None
    flags: Any = None
    currents: NDArray[np.float64] | None = None
    unpack_bytes: int = 0
    energies: NDArray[np.float64] | None = None
    pixel_mask = None
    used: tuple[Any, ...] = ()
    replaces = None
    shifts: NDArray[np.float64] | None = None
    aside_mm: NDArray[np.float64] | None = None
    part_starts: NDArray[np.int64] = np.zeros(1, np.int64)
    pass_ends: NDArray[np.int64] = np.zeros(0, np.int64)
    checksummed = False
    altered: frozenset[int] = frozenset()
    damaged: frozenset[int] = frozenset()
    finished = True
    ending = ScanEnding()
    times = None
    plan: dict[str, Any] = {}  # noqa: RUF012
    unreadable: dict[int, str] = {}  # noqa: RUF012

    def __init__(
        self,
        data: NDArray[Any],
        keys: list[int],
        angles: NDArray[np.float64],
        exposures: NDArray[np.float64] | None = None,
    ) -> None:
        self._data = data
        self.exposures = np.full(len(data), np.nan) if exposures is None else exposures
        self.image_key, self.angles = np.array(keys, np.int32), angles
        self.shape, self.dtype = data.shape[1:], data.dtype
        self.frame_bytes, self.triggers, self.framestamps = data[0].nbytes, np.arange(len(data)), np.full(len(data), 7)
        self.was_read: list[tuple[list[int], int]] = []

    def read(self, frames: Any, rows: slice = slice(None)) -> NDArray[Any]:
        block = self._data[frames, rows]
        self.was_read.append((np.arange(len(self._data))[frames].tolist(), block.shape[1]))
        return block

    def refresh(self) -> int:
        return len(self._data)

    def frames(self, first: int = 0) -> Iterator[Frame]:
        for i in range(first, len(self._data)):
            kind, angle = FrameKind(int(self.image_key[i])), float(self.angles[i])
            yield Frame(self._data[i], kind, i, i, -1, angle, np.nan, float(self.exposures[i]))
