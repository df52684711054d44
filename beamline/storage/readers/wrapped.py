"""WrappedSource: a scan that reads another one; a subclass changes what differs, as CroppedSource the columns."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import ConfigError
from beamline.storage.flag_legend import FrameFlags
from beamline.storage.readers.base import WHOLE, ScanSource
from drivers.base.frame import Frame


class WrappedSource(ScanSource):
    """All of `base`. A subclass has `read` and what differs; its `_update` sets `image_key`, `angles`, `exposures`."""

    def __init__(self, base: ScanSource) -> None:
        self._base = base
        self.path, self.format, self.shape, self.dtype = base.path, base.format, base.shape, base.dtype
        self.quantity, self.pixel_size_mm, self.energy_kev = base.quantity, base.pixel_size_mm, base.energy_kev
        self.cone, self.axis_col = base.cone, base.axis_col

    def _update(self) -> None:
        """Take over the present frames of `base`."""
        base = self._base
        self.image_key, self.angles, self.exposures = base.image_key, base.angles, base.exposures

    def refresh(self) -> int:
        self._base.refresh()
        self._update()
        return int(self.image_key.size)

    def close(self) -> None:
        self._base.close()


for _name, _value in vars(ScanSource).items():  # all that may change, also what is added to it
    if isinstance(_value, property):
        setattr(WrappedSource, _name, property(attrgetter(f"_base.{_name}")))


class CroppedSource(WrappedSource):
    """A ScanSource of some columns of `base`; columns, such as the axis and regions of flags, count from the first."""

    def __init__(self, base: ScanSource, cols: tuple[int, int]) -> None:
        """Crop `base` to columns `cols`, the last not included.

        Raises:
            ConfigError: they do not lie in the detector.
        """
        first, end = cols
        if not 0 <= first < end <= base.shape[1]:
            raise ConfigError(f"--cols {first}:{end} do not lie in the detector's 0:{base.shape[1]}.")
        super().__init__(base)
        self.cols, self.shape = cols, (base.shape[0], end - first)
        self.axis_col = None if base.axis_col is None else base.axis_col - first
        self._update()

    @property
    def _cols(self) -> slice:
        assert self.cols is not None
        return slice(*self.cols)

    @property
    def flags(self) -> FrameFlags | None:
        flags = self._base.flags
        if flags is None or flags.regions is None:
            return flags
        regions = flags.regions.copy()
        regions[..., 2:] -= np.where(regions[..., :1] < 0, 0, self._cols.start)  # below 0: no region
        return replace(flags, regions=regions)

    @property
    def shifts(self) -> NDArray[np.float64] | None:
        return self._base.shifts

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        return self._base.read(frames, rows)[..., self._cols]

    def frames(self, first: int = 0) -> Iterator[Frame]:
        return (replace(frame, counts=frame.counts[:, self._cols]) for frame in self._base.frames(first))
