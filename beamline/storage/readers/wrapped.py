"""WrappedSource: a scan that reads others; a subclass changes what differs: columns, or frames of several files."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.storage.flag_legend import TODAY, FrameFlags
from beamline.storage.readers.base import WHOLE, Attributes, ScanSource, TakesTooLongError, frame_indices
from drivers.base.frame import Frame, FrameKind

_T = TypeVar("_T")
UNPACKED, _READ = 2**28, 2**30  # bytes of a frame in a file, and of those read at once, to describe a scan


_BY_FRAME = ("currents", "energies", "times", "shifts", "aside_mm")
_OWN = {"facts", "unreadable", "stated_shifts", "stated_ending", *_BY_FRAME}
_COPIED = [name for name in ScanSource.__annotations__ if name not in _OWN]


class WrappedSource(ScanSource):
    """Forwards to `base`. A subclass overrides what differs; its `_update` sets `image_key`, `angles`, `exposures`."""

    def __init__(self, base: ScanSource) -> None:
        self._base = base
        for name in _COPIED:
            setattr(self, name, getattr(base, name))

    def _update(self) -> None:
        """Take over the present frames of `base`."""
        base = self._base
        self.image_key, self.angles, self.exposures = base.image_key, base.angles, base.exposures

    def of_frames(self, known: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Values [frame, ...] of `base` for the frames of this scan; None if unknown."""
        return known

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        return self._base.read(frames, rows)

    def refresh(self) -> int:
        self._base.refresh()
        self._update()
        return int(self.image_key.size)

    def _frames_of_base(self, first: int) -> Iterator[Frame]:
        """Frames of `base`, whose rows are those of this scan."""
        for frame in self._base.frames(first):
            self.unreadable = {**self.unreadable, **self._base.unreadable}
            yield frame

    def close(self) -> None:
        self._base.close()


def _of_frames(name: str) -> Callable[[WrappedSource], NDArray[np.float64] | None]:
    """A property of the frames of `base`, for those of a scan that wraps it."""

    def known(self: WrappedSource) -> NDArray[np.float64] | None:
        values = getattr(self._base, name)
        return None if values is None else self.of_frames(values)

    return known


for _name, _value in vars(ScanSource).items():  # all that may change, also what is added to it
    if isinstance(_value, property):
        setattr(WrappedSource, _name, property(attrgetter(f"_base.{_name}")))
for _name in _BY_FRAME:
    setattr(WrappedSource, _name, property(_of_frames(_name)))


class BriefSource(WrappedSource):
    """Forwards to `base`, for callers that only describe it: raises TakesTooLongError if `over` returns True before a
    read, or if a read would take long or much memory. The order of dimensions or the chunks of a file can make any
    frame cost all of it.
    """

    def __init__(self, base: ScanSource, over: Callable[[], bool]) -> None:
        super().__init__(base)
        self._over = over

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        n = frame_indices(frames, int(self.image_key.size)).size * len(range(self.shape[0])[rows])
        if self._over() or self.frame_bytes > UNPACKED or n * self.shape[1] * self.dtype.itemsize > _READ:
            raise TakesTooLongError(
                "Not all frames were looked at that show what is wrong with a scan: it would take too long. `beamline "
                "validate` looks at them."
            )
        return super().read(frames, rows)


class CroppedSource(WrappedSource):
    """A ScanSource of some columns of `base`; column numbers, such as the axis and regions of flags, count from the
    first of them.
    """

    def __init__(self, base: ScanSource, cols: tuple[int, int]) -> None:
        """Crop `base` to columns `cols`, the last not included.

        Raises:
            ConfigError: they do not lie in the detector.
        """
        first, end = cols
        if not 0 <= first < end <= base.shape[1]:
            raise ConfigError(f"--cols {first}:{end} is out of range: the detector has columns 0:{base.shape[1]}.")
        super().__init__(base)
        self.cols, self.shape = cols, (base.shape[0], end - first)
        self.axis_col = None if base.axis_col is None else base.axis_col - first
        self._cols = slice(first, end)

    @property
    def flags(self) -> FrameFlags | None:
        flags = self._base.flags
        if flags is None or flags.regions is None:
            return flags
        regions = flags.regions.copy()
        regions[..., 2:] -= np.where(regions[..., :1] < 0, 0, self._cols.start)  # below 0: no region
        return replace(flags, regions=regions)

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        return self._base.read(frames, rows)[..., self._cols]

    def frames(self, first: int = 0) -> Iterator[Frame]:
        return (replace(frame, counts=frame.counts[:, self._cols]) for frame in self._frames_of_base(first))


class TurnedSource(WrappedSource):
    """A ScanSource of the frames of `base` rotated by a quarter turn: a horizontal rotation axis becomes vertical.

    What was the last column is the first row. Any rows take reading whole frames.
    """

    def __init__(self, base: ScanSource) -> None:
        """Raises DataError for an emission and for a scan with flags: both have a vertical axis."""
        super().__init__(base)
        if base.emission is not None or base.flags is not None:
            raise DataError(f"{base.path} is a scan with a vertical rotation axis. Leave out --horizontal-axis.")
        self.shape, self.axis_col = (base.shape[1], base.shape[0]), None
        if base.row_pitch_mm is not None:
            self.pixel_size_mm, self.row_pitch_mm = base.row_pitch_mm, base.pixel_size_mm

    @property
    def shifts(self) -> NDArray[np.float64] | None:
        known = self._base.shifts
        return None if known is None else np.stack([known[:, 1], -known[:, 0]], axis=1)

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        return np.ascontiguousarray(np.rot90(self._base.read(frames), axes=(1, 2))[:, rows])

    def frames(self, first: int = 0) -> Iterator[Frame]:
        return (
            replace(frame, counts=np.ascontiguousarray(np.rot90(frame.counts))) for frame in self._frames_of_base(first)
        )


class KeyedSource(WrappedSource):
    """A ScanSource whose kinds of frames are assigned by the caller, or which has only the frames of one energy."""

    def __init__(self, base: ScanSource, kinds: str) -> None:
        """Take `kinds` such as "darks=0:5,flats=5:10+95:100,views=10:95": rows of the scan, ends not included.

        Without views all other frames are projections, else invalid. "energy=20" makes frames of other energies
        invalid, by the file.

        Raises:
            DataError: they are no such text, lie outside the scan, or the file states no such energy.
        """
        super().__init__(base)
        words = [word.strip() for word in kinds.split(",")]
        named = [word for word in words if not word.startswith(_ENERGY)]
        self._keys = _stated_keys(",".join(named), int(base.image_key.size)) if named else base.image_key.copy()
        for word in words:
            if word.startswith(_ENERGY):
                self.energy_kev, others = _of_one_energy(base, word)
                self._keys[others] = FrameKind.INVALID
        if base.quantity == "unknown" and base.dtype.kind in "ui" and {*self._keys.tolist()} >= {1, 2}:
            self.quantity = "counts"
        self._update()

    def _update(self) -> None:
        super()._update()
        self.image_key = self._keys


def _stated_keys(kinds: str, n: int) -> NDArray[np.int32]:
    """The kind of each of n frames by what the caller says."""
    stated, named = np.full(n, -1), _ranges(kinds, n)
    for kind, first, end in named:
        if (stated[first:end] >= 0).any():
            raise DataError(f"--frames {kinds} names frame {first + int((stated[first:end] >= 0).argmax())} twice.")
        stated[first:end] = kind
    others = FrameKind.INVALID if any(kind is FrameKind.PROJECTION for kind, *_ in named) else FrameKind.PROJECTION
    return np.where(stated < 0, others, stated).astype(np.int32)


def _of_one_energy(source: ScanSource, word: str) -> tuple[float, NDArray[np.bool_]]:
    """keV of "energy=20", and the frames of other energies."""
    try:
        kev = float(word.removeprefix(_ENERGY))
    except ValueError:
        raise DataError(f"--frames {word}: expected a number of keV, such as energy=20.") from None
    known = source.energies
    if known is None:
        raise DataError(f"--frames {word}: {source.path} states no energy of each frame. Leave it out.")
    others = np.abs(known - kev) > _SAME_ENERGY * kev
    if not (np.isfinite(known) & ~others).any():
        raise DataError(f"--frames {word}: no frame of {source.path} has this energy; {in_words(known)}.")
    return kev, others


def in_words(energies: NDArray[np.float64]) -> str:
    """How many frames have which energy, such as "45 at 20 keV and 45 at 30 keV"."""
    parts = of_energies(energies)
    listed = [f"{n} at {kev:.6g} keV" for kev, n in parts[:_LISTED]]
    listed += [f"and more up to {parts[-1][0]:.6g} keV"] if len(parts) > _LISTED else []
    return ", ".join(listed)


def of_energies(energies: NDArray[np.float64]) -> list[tuple[float, int]]:
    """(keV, number of frames) of each energy; energies within a part in ten thousand are the same."""
    known = np.sort(energies[np.isfinite(energies)])
    parts = np.split(known, np.flatnonzero(np.diff(known) > _SAME_ENERGY * known[:-1]) + 1)
    return [(float(np.median(part)), int(part.size)) for part in parts if part.size]


_ENERGY = "energy="
_SAME_ENERGY = 1e-4  # as a monochromator repeats one
_LISTED = 6  # energies in a sentence
_KINDS = {"darks": FrameKind.DARK, "flats": FrameKind.FLAT, "views": FrameKind.PROJECTION, "none": FrameKind.INVALID}


def _ranges(kinds: str, n: int) -> list[tuple[FrameKind, int, int]]:
    """Kind and rows [first, end) of each range in `kinds`; DataError for what is none."""
    ranges = []
    for word in kinds.split(","):
        name, _, places = word.strip().partition("=")
        for place in places.split("+"):
            match = re.fullmatch(r"\s*(\d{1,9})?:(\d{1,9})?\s*", place)
            first, end = (int(match[1] or 0), int(match[2] or n)) if match else (0, 0)
            if name not in _KINDS or not first < end <= n:
                raise DataError(
                    f"--frames {kinds}: {word.strip()!r} is none of {', '.join(_KINDS)} with frames of 0:{n}; expected "
                    "such as darks=0:5,flats=5:10+95:100. Frames are counted from 0 in the order of the scan."
                )
            ranges.append((_KINDS[name], first, end))
    return ranges


class UnsignedSource(WrappedSource):
    """A ScanSource of unsigned counts that `base` stores as a signed type, so that large counts appear negative."""

    def __init__(self, base: ScanSource, dtype: np.dtype[Any]) -> None:
        super().__init__(base)
        self.dtype = dtype

    @property
    def attributes(self) -> Attributes:
        return {**self._base.attributes, "pixels": f"int{8 * self.dtype.itemsize} that wrapped, read as {self.dtype}"}

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        return unsigned(self._base.read(frames, rows), self.dtype)


def unsigned(images: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """The same bits as unsigned counts."""
    if images.dtype.itemsize == dtype.itemsize:
        return images.view(dtype)
    return (images & np.iinfo(dtype).max).astype(dtype)


def type_wrapped(images: NDArray[Any]) -> np.dtype[Any] | None:
    """The unsigned type for signed integers [..., col] in which the sign bit belongs to the count; None if they are
    signed.

    Images are smooth: where counts pass the end of the signed type, neighbours differ by all of its range, and read
    without a sign they do not. Counts that are all beyond the end are negative, which no light is. What is negative by
    noise around 0, or marks pixels without data by one value, has not wrapped. Four bytes may hold those of two, where
    a file has views as int16 beside flats as uint16.
    """
    if images.dtype.kind != "i" or images.dtype.itemsize > 4 or images.shape[-1] < 2:
        return None
    negative = images[images < 0]
    if negative.size == 0 or negative.min() == negative.max():
        return None
    size = images.dtype.itemsize
    if size == 4 and images.min() >= -(2**15) and images.max() < 2**16:
        size = 2
    dtype = np.dtype(f"{images.dtype.byteorder}u{size}")
    counts = unsigned(images, dtype)
    signed, plain = (np.abs(np.diff(some.astype(np.int64), axis=-1)).sum() for some in (images, counts))
    return dtype if plain < signed or (plain == signed and np.median(images) < 0) else None


class PartsSource(WrappedSource):
    """A ScanSource of the frames of `earlier`, which are complete, and then of `last`, whose path and metadata it has.

    Row numbers, such as the row that a frame replaces, count from the first frame of all files.
    """

    def __init__(self, earlier: Sequence[ScanSource], last: ScanSource, path: Path | None = None) -> None:
        """Put them together; DataError where frames are of another shape or type. It closes all of them.

        Args:
            path: of the scan, where somebody said that the files are one, taken without a pause; None: they are parts,
                between which beam and camera may have changed.
        """
        self._sources, self._one = (*earlier, last), path is not None
        for source in earlier:
            if (source.shape, source.dtype, source.quantity) != (last.shape, last.dtype, last.quantity):
                raise DataError(
                    f"{source.path} has {source.quantity} of {source.dtype} {source.shape}, {last.path} "
                    f"{last.quantity} of {last.dtype} {last.shape}: they are no parts of one scan."
                )
        super().__init__(last)
        self.path, self.in_order = path or last.path, all(source.in_order for source in self._sources)
        self.numbers = None
        self._earlier_flags = [_as_of_today(source) for source in earlier]
        self._update()

    def _update(self) -> None:
        self._firsts = np.cumsum([0, *(source.image_key.size for source in self._sources)])
        for name in ("image_key", "angles", "exposures"):
            setattr(self, name, np.concatenate([getattr(source, name) for source in self._sources]))

    def of_frames(self, known: NDArray[np.float64]) -> None:
        return None

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
        known = [source.replaces for source in self._sources]
        if all(rows is None for rows in known):
            return None
        none = (np.full(source.image_key.size, -1) for source in self._sources)
        filled = [own if rows is None else rows for own, rows in zip(none, known, strict=True)]
        return np.concatenate([np.where(rows < 0, -1, rows + first) for first, rows in self._each(filled)])

    @property
    def part_starts(self) -> NDArray[np.int64]:
        if self._one:
            return np.zeros(1, np.int64)
        return np.concatenate([rows + first for first, rows in self._each(s.part_starts for s in self._sources)])

    @property
    def checksummed(self) -> bool:
        return all(source.checksummed for source in self._sources)

    @property
    def altered(self) -> frozenset[int]:
        each = self._each(source.altered for source in self._sources)
        return frozenset(int(row + first) for first, rows in each for row in rows)

    @property
    def damaged(self) -> frozenset[int]:
        each = self._each(source.damaged for source in self._sources)
        return frozenset(int(row + first) for first, rows in each for row in rows)

    def _each(self, of_sources: Iterable[_T]) -> Iterator[tuple[int, _T]]:
        """With the first row of each file."""
        return zip(self._firsts[:-1], of_sources, strict=True)

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        indices = frame_indices(frames, self.image_key.size)
        of = np.searchsorted(self._firsts, indices, "right") - 1
        if indices.size and (of == of[0]).all():
            return self._sources[of[0]].read(indices - self._firsts[of[0]], rows)
        out = np.empty((indices.size, len(range(self.shape[0])[rows]), self.shape[1]), self.dtype)
        for i in np.unique(of):
            out[of == i] = self._sources[i].read(indices[of == i] - self._firsts[i], rows)
        return out

    def close(self) -> None:
        for source in self._sources:
            source.close()


def _as_of_today(source: ScanSource) -> FrameFlags:
    """Its flags by the legend of today; none where no monitor looked at it."""
    flags, n = source.flags, source.image_key.size
    if flags is not None and flags.legend == TODAY:
        return flags
    return FrameFlags(np.zeros(n, np.uint64), TODAY) if flags is None else flags.of_today()
