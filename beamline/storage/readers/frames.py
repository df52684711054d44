"""Frames: a scan composed of the frames of other scans, for example of its parts. Pixels and the table may be
changed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.storage.frame_table import FrameTable
from beamline.storage.readers.base import WHOLE, ScanSource, frame_indices

Read = Callable[..., NDArray[Any]]
"""The type of `ScanSource.read`: returns the pixels [frame, row, col] of some frames and rows."""
Pixels = Callable[[Read, slice | ArrayLike, slice], NDArray[Any]]
"""A function that returns changed pixels of some frames and rows. Its first argument reads the original pixels."""
Change = Callable[[FrameTable], FrameTable]
_COPIED = {*ScanSource.__annotations__} - {"table", "unreadable", "facts", "stated_ending", "decisions"}


class Frames(ScanSource):
    """The frames of several sources, one after the other; facts of the whole scan are those of the last source.

    Row numbers, such as the row that a frame replaces, are counted from the first frame of the first source.
    """

    def __init__(
        self, *sources: ScanSource, pixels: Pixels | None = None, table: Change | None = None, **own: Any
    ) -> None:
        """Combine the present frames of `sources`. Closing this scan closes the sources.

        Args:
            pixels: function that computes the pixels from those of the sources; None: pixels are unchanged.
            table: function that computes the table from the joined table of the sources; None: the table is unchanged.
            own: attributes with other values than in the sources: each is a value, or a function of the value in the
                sources.
        """
        self._sources, self._pixels, self._change, self._own = sources, pixels, table, own
        for name in _COPIED:
            setattr(self, name, getattr(sources[-1], name))
        self.dtype = np.result_type(*(source.dtype for source in sources))
        vars(self).update({name: value for name, value in own.items() if name in _COPIED})
        self._update()

    def _update(self) -> None:
        self._sizes = np.array([len(source.table) for source in self._sources])
        joined = FrameTable.concat([source.table for source in self._sources])
        self.table = joined if self._change is None else self._change(joined)

    def known(self, name: str) -> Any:
        """The current value of an attribute."""
        each = [getattr(source, name) for source in self._sources]
        join, own = _JOINED.get(name), self._own.get(name)
        value = each[-1] if join is None or len(each) == 1 else join(each, self._sizes)
        return own(value) if callable(own) else value if own is None else own

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        return self._read(frames, rows) if self._pixels is None else self._pixels(self._read, frames, rows)

    def _read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        if len(self._sources) == 1:
            return self._sources[0].read(frames, rows)
        indices, ends = frame_indices(frames, len(self.table)), np.cumsum(self._sizes)
        of, firsts = np.searchsorted(ends, indices, "right"), ends - self._sizes
        if indices.size and (of == of[0]).all():
            return self._sources[of[0]].read(indices - firsts[of[0]], rows).astype(self.dtype, copy=False)
        out = np.empty((indices.size, len(range(self.shape[0])[rows]), self.shape[1]), self.dtype)
        for i in np.unique(of):
            out[of == i] = self._sources[i].read(indices[of == i] - firsts[i], rows)
        return out

    def refresh(self) -> int:
        self._sources[-1].refresh()
        self._update()
        return len(self.table)

    def close(self) -> None:
        for source in self._sources:
            source.close()


_JOINED: dict[str, Callable[[Any, NDArray[np.int64]], Any]] = {
    "damaged": lambda each, sizes: frozenset(
        row + n for rows, n in zip(each, np.cumsum(sizes) - sizes, strict=True) for row in rows
    ),
    "decisions": lambda each, sizes: sum(each, ()),
    "checksummed": lambda each, sizes: all(each),
}
"""How the values of several sources are combined to one value. Attributes that are not listed have the value of the
last source.
"""
_PROPERTIES = (name for name, value in vars(ScanSource).items() if isinstance(value, property))
for _name in ("decisions", *_PROPERTIES):
    setattr(Frames, _name, property(partial(Frames.known, name=_name)))
