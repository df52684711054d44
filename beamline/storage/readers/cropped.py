"""CroppedSource: a scan as a detector with some of its columns would have taken it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import ConfigError
from beamline.storage.flag_legend import FrameFlags
from beamline.storage.readers.base import WHOLE, Attributes, ScanSource
from drivers.base.frame import Frame


class CroppedSource(ScanSource):
    """A ScanSource of some columns of `base`; columns, such as the axis and regions of flags, count from the first."""

    def __init__(self, base: ScanSource, cols: tuple[int, int]) -> None:
        """Crop `base` to columns `cols`, the last not included.

        Raises:
            ConfigError: they do not lie in the detector.
        """
        first, end = cols
        if not 0 <= first < end <= base.shape[1]:
            raise ConfigError(f"--cols {first}:{end} do not lie in the detector's 0:{base.shape[1]}.")
        self._base, self.cols = base, cols
        self.path, self.format, self.dtype = base.path, base.format, base.dtype
        self.shape = base.shape[0], end - first
        self.quantity, self.pixel_size_mm, self.energy_kev = base.quantity, base.pixel_size_mm, base.energy_kev
        self.cone, self.axis_col = base.cone, None if base.axis_col is None else base.axis_col - first
        self._update()

    @property
    def _cols(self) -> slice:
        assert self.cols is not None
        return slice(*self.cols)

    def _update(self) -> None:
        base = self._base
        self.image_key, self.angles, self.exposures = base.image_key, base.angles, base.exposures

    @property
    def flags(self) -> FrameFlags | None:
        flags = self._base.flags
        if flags is None or flags.regions is None:
            return flags
        regions = flags.regions.copy()
        regions[..., 2:] -= np.where(regions[..., :1] < 0, 0, self._cols.start)  # below 0: no region
        return replace(flags, regions=regions)

    @property
    def attributes(self) -> Attributes:
        return self._base.attributes

    @property
    def currents(self) -> NDArray[np.float64] | None:
        return self._base.currents

    @property
    def replaces(self) -> NDArray[np.int64] | None:
        return self._base.replaces

    @property
    def part_starts(self) -> NDArray[np.int64]:
        return self._base.part_starts

    @property
    def checksummed(self) -> bool:
        return self._base.checksummed

    @property
    def altered(self) -> frozenset[int]:
        return self._base.altered

    @property
    def damaged(self) -> frozenset[int]:
        return self._base.damaged

    @property
    def finished(self) -> bool:
        return self._base.finished

    @property
    def row_period(self) -> float | None:
        return self._base.row_period

    @property
    def plan(self) -> Mapping[str, Any]:
        return self._base.plan

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        return self._base.read(frames, rows)[..., self._cols]

    def frames(self, first: int = 0) -> Iterator[Frame]:
        return (replace(frame, counts=frame.counts[:, self._cols]) for frame in self._base.frames(first))

    def refresh(self) -> int:
        n = self._base.refresh()
        self._update()
        return n

    def close(self) -> None:
        self._base.close()
