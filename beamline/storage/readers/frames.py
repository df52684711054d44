"""Frames: a scan made of the frames of others, such as its parts, or what comes before them; with changed pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.storage.flag_legend import FrameFlags
from beamline.storage.readers.base import WHOLE, ScanSource, frame_indices

Read = Callable[..., NDArray[Any]]
"""What `ScanSource.read` is: pixels [frame, row, col] of some frames and rows."""
Pixels = Callable[[Read, slice | ArrayLike, slice], NDArray[Any]]
"""Pixels of some frames and rows, from those that the first argument reads."""
_Sizes = NDArray[np.int64]
_AT_REFRESH = ("image_key", "angles", "exposures")
BY_FRAME = ("currents", "energies", "times", "shifts", "aside_mm")
_OF_FRAMES = (*_AT_REFRESH, *BY_FRAME)
_AT_PRESENT = {"unreadable", "facts", "stated_shifts", "stated_ending", "pass_ends", "decisions", *_OF_FRAMES}
_COPIED = {*ScanSource.__annotations__} - _AT_PRESENT


class Frames(ScanSource):
    """The frames of some sources, one source after the other. What is not of single frames is that of the last source.

    Row numbers, such as the row that a frame replaces, count from the first frame of all.
    """

    def __init__(self, *sources: ScanSource, pixels: Pixels | None = None, **own: Any) -> None:
        """Take over the present frames of `sources`, which are closed with it.

        Args:
            pixels: how they come from those of the sources; None: as they are.
            own: attributes that differ: each a value, or a function of what the sources say.
        """
        self._sources, self._pixels, self._own = sources, pixels, own
        for name in _COPIED:
            setattr(self, name, getattr(sources[-1], name))
        self.dtype = np.result_type(*(source.dtype for source in sources))
        self.numbers = self.numbers if len(sources) == 1 else None
        vars(self).update({name: value for name, value in own.items() if name in _COPIED})
        self._update()

    def _update(self) -> None:
        self._sizes = np.array([source.image_key.size for source in self._sources])
        for name in _AT_REFRESH:
            setattr(self, name, self.known(name))

    def known(self, name: str) -> Any:
        """The present value of an attribute."""
        each = [getattr(source, name) for source in self._sources]
        join, own = _JOINED.get(name), self._own.get(name)
        value = each[-1] if join is None or len(each) == 1 else join(each, self._sizes)
        return own(value) if callable(own) else value if own is None else own

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        return self._read(frames, rows) if self._pixels is None else self._pixels(self._read, frames, rows)

    def _read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        if len(self._sources) == 1:
            return self._sources[0].read(frames, rows)
        indices, ends = frame_indices(frames, self.image_key.size), np.cumsum(self._sizes)
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
        return int(self.image_key.size)

    def close(self) -> None:
        for source in self._sources:
            source.close()


def _column(each: Sequence[NDArray[Any] | None], sizes: _Sizes) -> NDArray[Any] | None:
    """Values [frame, ...] of all sources, NaN of those that state none; None where none does."""
    beyond = next((values.shape[1:] for values in each if values is not None), None)
    if beyond is None:
        return None
    filled = [np.full((n, *beyond), np.nan) if v is None else v for v, n in zip(each, sizes, strict=True)]
    return np.concatenate(filled)


def _replaced(each: Sequence[NDArray[np.int64] | None], sizes: _Sizes) -> NDArray[np.int64] | None:
    if all(rows is None for rows in each):
        return None
    filled = [np.full(n, -1) if rows is None else rows for rows, n in zip(each, sizes, strict=True)]
    return np.concatenate([np.where(rows < 0, -1, rows + n) for rows, n in _after(filled, sizes)])


def _after(each: Sequence[Any], sizes: _Sizes) -> Iterator[tuple[Any, int]]:
    """The sources, each with the number of frames before it."""
    return zip(each, (np.cumsum(sizes) - sizes).tolist(), strict=True)


_JOINED: dict[str, Callable[[Any, _Sizes], Any]] = {
    **dict.fromkeys((*_OF_FRAMES, "triggers", "framestamps"), _column),
    "replaces": _replaced,
    **dict.fromkeys(
        ("part_starts", "pass_ends"), lambda each, sizes: np.concatenate([rows + n for rows, n in _after(each, sizes)])
    ),
    **dict.fromkeys(
        ("altered", "damaged"), lambda each, sizes: frozenset(r + n for s, n in _after(each, sizes) for r in s)
    ),
    "flags": FrameFlags.joined,
    "decisions": lambda each, sizes: sum(each, ()),
    "checksummed": lambda each, sizes: all(each),
}
"""How what several sources say becomes one value; else it is that of the last."""
_PROPERTIES = (name for name, value in vars(ScanSource).items() if isinstance(value, property))
for _name in (*BY_FRAME, "pass_ends", "decisions", *_PROPERTIES):
    setattr(Frames, _name, property(partial(Frames.known, name=_name)))
