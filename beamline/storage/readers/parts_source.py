"""PartsSource: the frames of several files of one scan as one; the last of them may still grow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.storage.flag_legend import TODAY, FrameFlags
from beamline.storage.readers.base import WHOLE, Attributes, ScanSource, frame_indices


class PartsSource(ScanSource):
    """A ScanSource of the frames of `earlier`, which have ended, and then of `last`, whose path and facts it has.

    Row numbers, such as the row that a frame replaces, count from the first frame of all files.
    """

    def __init__(self, earlier: Sequence[ScanSource], last: ScanSource) -> None:
        """Put them together; DataError where frames are of another shape or type. It closes all of them."""
        self._sources = (*earlier, last)
        for source in earlier:
            if (source.shape, source.dtype, source.quantity) != (last.shape, last.dtype, last.quantity):
                raise DataError(
                    f"{source.path} has {source.quantity} of {source.dtype} {source.shape}, {last.path} "
                    f"{last.quantity} of {last.dtype} {last.shape}: they are no parts of one scan."
                )
        self.path, self.format, self.shape, self.dtype = last.path, last.format, last.shape, last.dtype
        self.quantity, self.pixel_size_mm, self.energy_kev = last.quantity, last.pixel_size_mm, last.energy_kev
        self.axis_col, self.cone = last.axis_col, last.cone
        self._earlier_flags = [_as_of_today(source) for source in earlier]
        self._update()

    def _update(self) -> None:
        sources = self._sources
        self._firsts = np.cumsum([0, *(source.image_key.size for source in sources)])
        self.image_key = np.concatenate([source.image_key for source in sources])
        self.angles = np.concatenate([source.angles for source in sources])
        self.exposures = np.concatenate([source.exposures for source in sources])

    @property
    def attributes(self) -> Attributes:
        return self._sources[-1].attributes

    @property
    def flags(self) -> FrameFlags | None:
        parts = [*self._earlier_flags, _as_of_today(self._sources[-1])]
        bits = np.concatenate([part.bits for part in parts])
        scores = [part.scores for part in parts if part.scores is not None]
        regions = [part.regions for part in parts if part.regions is not None]
        whole = len(scores) == len(regions) == len(parts)
        return FrameFlags(bits, TODAY, *((np.concatenate(scores), np.concatenate(regions)) if whole else ()))

    @property
    def replaces(self) -> NDArray[np.int64] | None:
        if all(source.replaces is None for source in self._sources):
            return None
        rows = []
        for source, first in zip(self._sources, self._firsts[:-1], strict=True):
            known = np.full(source.image_key.size, -1) if source.replaces is None else source.replaces
            rows.append(np.where(known < 0, -1, known + first))
        return np.concatenate(rows)

    @property
    def part_starts(self) -> NDArray[np.int64]:
        return np.concatenate(
            [s.part_starts + first for s, first in zip(self._sources, self._firsts[:-1], strict=True)]
        )

    @property
    def checksummed(self) -> bool:
        return all(source.checksummed for source in self._sources)

    @property
    def altered(self) -> frozenset[int]:
        pairs = zip(self._sources, self._firsts[:-1], strict=True)
        return frozenset(int(row + first) for source, first in pairs for row in source.altered)

    @property
    def damaged(self) -> frozenset[int]:
        pairs = zip(self._sources, self._firsts[:-1], strict=True)
        return frozenset(int(row + first) for source, first in pairs for row in source.damaged)

    @property
    def finished(self) -> bool:
        return self._sources[-1].finished

    @property
    def row_period(self) -> float | None:
        return self._sources[-1].row_period

    @property
    def plan(self) -> Mapping[str, Any]:
        return self._sources[-1].plan

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        indices = frame_indices(frames, self.image_key.size)
        of = np.searchsorted(self._firsts, indices, "right") - 1
        if indices.size and (of == of[0]).all():
            return self._sources[of[0]].read(indices - self._firsts[of[0]], rows)
        out = np.empty((indices.size, len(range(self.shape[0])[rows]), self.shape[1]), self.dtype)
        for i in np.unique(of):
            out[of == i] = self._sources[i].read(indices[of == i] - self._firsts[i], rows)
        return out

    def refresh(self) -> int:
        self._sources[-1].refresh()
        self._update()
        return int(self.image_key.size)

    def close(self) -> None:
        for source in self._sources:
            source.close()


def _as_of_today(source: ScanSource) -> FrameFlags:
    """Its flags by the legend of today; none where no monitor looked at it."""
    flags, n = source.flags, source.image_key.size
    if flags is not None and flags.legend == TODAY:
        return flags
    return FrameFlags(np.zeros(n, np.uint64), TODAY) if flags is None else flags.of_today()
