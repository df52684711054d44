"""Scans that are read differently from how they are stored: some columns only, other kinds or pixel types, or the
frames of several files.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.storage.frame_table import FrameTable
from beamline.storage.readers.base import WHOLE, ScanSource, TakesTooLongError, frame_indices
from beamline.storage.readers.frames import Frames, Read
from drivers.base.frame import FrameKind

UNPACKED, _READ = 2**28, 2**30  # bytes of a frame in a file, and of those read at once, to describe a scan


def brief_source(base: ScanSource, over: Callable[[], bool]) -> ScanSource:
    """The scan for callers that only describe it: raises TakesTooLongError if `over` returns True before a read, or if
    a read would need much time or memory.

    The order of dimensions or the chunks of a file can make reading any frame as expensive as reading all.
    """

    def pixels(read: Read, frames: slice | ArrayLike, rows: slice) -> NDArray[Any]:
        n = frame_indices(frames, len(base.table)).size * len(range(base.shape[0])[rows])
        if over() or base.frame_bytes > UNPACKED or n * base.shape[1] * base.dtype.itemsize > _READ:
            raise TakesTooLongError(
                "Not all frames that may show a fault of the scan were checked, because it would take "
                "too long. `beamline validate` checks them all."
            )
        return read(frames, rows)

    return Frames(base, pixels=pixels)


def cropped(base: ScanSource, cols: tuple[int, int]) -> ScanSource:
    """Columns `cols` of a scan, the last not included; column numbers, such as the axis and regions of flags, count
    from the first of them.

    Raises:
        ConfigError: they do not lie in the detector.
    """
    first, end = cols
    if not 0 <= first < end <= base.shape[1]:
        raise ConfigError(f"--cols {first}:{end} is out of range: the detector has columns 0:{base.shape[1]}.")

    def moved(table: FrameTable) -> FrameTable:
        if (flags := table.flags) is None:
            return table
        there = flags.regions[..., :1] >= 0  # below 0: no region
        regions = flags.regions - np.where(there, [0, 0, first, first], 0).astype(np.int32)
        return replace(table, flags=replace(flags, regions=regions))

    return Frames(
        base,
        pixels=lambda read, frames, rows: read(frames, rows)[..., first:end],
        cols=cols,
        shape=(base.shape[0], end - first),
        axis_col=None if base.axis_col is None else base.axis_col - first,
        central_ray=None if base.central_ray is None else (base.central_ray[0], base.central_ray[1] - first),
        table=moved,
    )


_TURNED = (
    "The frames are rotated by 90 degrees, so that the last column becomes the first row. If the camera "
    "was rotated the other way, the volume is the mirror image of the sample."
)


def turned(base: ScanSource) -> ScanSource:
    """A scan with its frames rotated by 90 degrees: a horizontal rotation axis becomes vertical.

    The last column becomes the first row. Reading any rows requires reading whole frames.

    Raises:
        DataError: a scan with flags, which has a vertical axis.
    """
    if base.table.flags is not None:
        raise DataError(f"Omit --horizontal-axis: {base.path} is a scan with a vertical rotation axis.")
    sizes = (base.pixel_size_mm, None) if base.row_pitch_mm is None else (base.row_pitch_mm, base.pixel_size_mm)
    return Frames(
        base,
        pixels=lambda read, frames, rows: np.ascontiguousarray(np.rot90(read(frames), axes=(1, 2))[:, rows]),
        shape=base.shape[::-1],
        attributes=lambda known: {**known, "turned": _TURNED},
        axis_col=None,
        central_ray=None
        if base.central_ray is None
        else (base.shape[1] - 1 - base.central_ray[1], base.central_ray[0]),
        pixel_size_mm=sizes[0],
        row_pitch_mm=sizes[1],
        table=lambda known: known if known.shifts is None else replace(known, shifts=known.shifts[:, ::-1] * [1, -1]),
    )


def with_kinds(base: ScanSource, kinds: str) -> ScanSource:
    """A scan whose kinds of frames the caller states, or which has only the frames of one energy.

    Args:
        kinds: such as "darks=0:5,flats=5:10+95:100,views=10:95", rows of the scan, ends not included. Without "views"
            all other frames are projections, with it they are invalid. "none=30:38" alone makes these invalid, and the
            others keep their kind. "energy=20" makes frames of other energies invalid, according to the file.

    Raises:
        DataError: the text is wrong, rows are outside the scan, or the file states no such energy.
    """
    words, own = [word.strip() for word in kinds.split(",")], dict[str, Any]()
    named = [word for word in words if not word.startswith(_ENERGY)]
    keys = _stated_keys(",".join(named), base.table.kinds) if named else base.table.kinds.copy()
    for word in words:
        if word.startswith(_ENERGY):
            own["energy_kev"], others = _of_one_energy(base, word)
            keys[others] = FrameKind.INVALID
    if base.quantity == "unknown" and base.dtype.kind in "ui" and {*keys.tolist()} >= {1, 2}:
        own["quantity"] = "counts"
    return Frames(base, table=lambda known: replace(known, kinds=keys), **own)


def kinds_and_views(frames: str | None) -> tuple[str | None, slice | None]:
    """The kinds and the projections that --frames names, as "darks=0:5,flats=5:10,0::2" does; None: it names none."""
    words = [] if frames is None else frames.split(",")
    matches = [_VIEWS.fullmatch(word) for word in words]
    taken = [slice(*(int(number) if number else None for number in match.groups())) for match in matches if match]
    if len(taken) != 1:
        return frames, None
    return ",".join(word for word, match in zip(words, matches, strict=True) if not match) or None, taken[0]


def selected(base: ScanSource, views: slice) -> ScanSource:
    """Some projections of a scan, counted from 0 without darks and flats; the others are invalid frames.

    If the number of darks (flats) is a multiple of the step, they were taken in turn like the projections, so those of
    the same turn are selected, also counted from 0. Otherwise all of them are used.

    Raises:
        DataError: no projection is left.
    """
    table, n, out = base.table, base.table.views.size, list[NDArray[np.int64]]()
    first, end, step = views.indices(n)
    if first >= end:
        raise DataError(
            f"--frames selects no projection: {base.path} has {n} of them, counted from 0 without darks and flats."
        )
    for kind in (FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION):
        rows = table.of_kind(kind)
        in_turn = slice(first % step, None, step) if rows.size % step == 0 else WHOLE
        out.append(np.delete(rows, views if kind is FrameKind.PROJECTION else in_turn))
    return Frames(base, table=lambda known: known.without(np.concatenate(out)))


def only_omits(kinds: str | None) -> bool:
    """True if the caller states no kinds of frames, only that some are left out."""
    return kinds is not None and all(word.strip().startswith(("none=", _ENERGY)) for word in kinds.split(","))


def _stated_keys(kinds: str, known: NDArray[np.int32]) -> NDArray[np.int32]:
    """The kind of each frame from the caller, or the known kinds if the caller only leaves frames out."""
    stated, named = np.full(known.size, -1), _ranges(kinds, known.size)
    for kind, first, end in named:
        if (stated[first:end] >= 0).any():
            raise DataError(f"--frames {kinds} names frame {first + int((stated[first:end] >= 0).argmax())} twice.")
        stated[first:end] = kind
    others = FrameKind.INVALID if any(kind is FrameKind.PROJECTION for kind, *_ in named) else FrameKind.PROJECTION
    return np.where(stated < 0, known if only_omits(kinds) else others, stated).astype(np.int32)


def _of_one_energy(source: ScanSource, word: str) -> tuple[float, NDArray[np.bool_]]:
    """keV of "energy=20", and the frames of other energies."""
    try:
        kev = float(word.removeprefix(_ENERGY))
    except ValueError:
        raise DataError(f"--frames {word}: expected a number in keV, such as energy=20.") from None
    known = source.table.energies
    if known is None:
        raise DataError(f"Omit --frames {word}: {source.path} does not state the energy of each frame.")
    others = np.abs(known - kev) > _SAME_ENERGY * kev
    if not (np.isfinite(known) & ~others).any():
        raise DataError(f"--frames {word}: no frame of {source.path} has this energy; {in_words(known)}.")
    return kev, others


def in_words(energies: NDArray[np.float64]) -> str:
    """How many frames have which energy, such as "45 at 20 keV and 45 at 30 keV"."""
    parts = frames_by_energy(energies)
    listed = [f"{n} at {kev:.6g} keV" for kev, n in parts[:_LISTED]]
    listed += [f"and more up to {parts[-1][0]:.6g} keV"] if len(parts) > _LISTED else []
    return ", ".join(listed)


def frames_by_energy(energies: NDArray[np.float64]) -> list[tuple[float, int]]:
    """(keV, number of frames) of each energy; energies within a part in ten thousand are the same."""
    known = np.sort(energies[np.isfinite(energies)])
    parts = np.split(known, np.flatnonzero(np.diff(known) > _SAME_ENERGY * known[:-1]) + 1)
    return [(float(np.median(part)), int(part.size)) for part in parts if part.size]


_ENERGY = "energy="
_SAME_ENERGY = 1e-4  # as a monochromator repeats one
_LISTED = 6  # energies in a sentence
_VIEWS = re.compile(r"\s*(-?\d{1,9})?:(-?\d{1,9})?(?::([1-9]\d{0,8})?)?\s*")  # a slice of Python
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
                    f"--frames {kinds}: {word.strip()!r} is not one of {', '.join(_KINDS)} with frames of "
                    f"0:{n}. Expected, for example, darks=0:5,flats=5:10+95:100, none=30:38+61:62 for "
                    "frames to leave out (counted from 0 in the order of the scan, which `beamline info` "
                    "shows), or 0::2 for every second projection."
                )
            ranges.append((_KINDS[name], first, end))
    return ranges


def as_unsigned(base: ScanSource, dtype: np.dtype[Any]) -> ScanSource:
    """A scan whose pixels are read as their true type: unsigned counts that were stored as signed ones, or reals that
    were stored as whole numbers.
    """
    wrapped = f"int{8 * dtype.itemsize} that overflowed"
    what = "real numbers, judging by their bits, because the TIFF has no SampleFormat" if dtype.kind == "f" else wrapped
    fact = f"{what}, read as {dtype}"
    return Frames(
        base,
        pixels=lambda read, frames, rows: unsigned(read(frames, rows), dtype),
        dtype=dtype,
        attributes=lambda known: {**known, "pixels": fact},
    )


def unsigned(images: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """The same bits as unsigned counts."""
    if images.dtype.itemsize == dtype.itemsize:
        return images.view(dtype)
    return (images & np.iinfo(dtype).max).astype(dtype)


def real_type(images: NDArray[Any]) -> np.dtype[Any] | None:
    """The real type of integers [..., col] that are the bits of real numbers; None if they are integers.

    Real numbers of one quantity are close together in their bits. Integers look like this only if nearly all of them
    are within four per cent of the range of their type, around a quarter or three quarters of the range.
    """
    size = images.dtype.itemsize
    if images.dtype.kind != "u" or size < 4 or images.shape[-1] < 2:
        return None
    dtype = np.dtype(f"{images.dtype.byteorder}f{size}")
    with np.errstate(invalid="ignore"):
        reals = images.view(dtype).astype(np.float64)
    known = np.abs(reals[np.isfinite(reals) & (reals != 0)])
    typical = float(np.median(known)) if known.size else 0.0
    near = (known > typical / _OCTAVES) & (known < typical * _OCTAVES)
    real = 1 / _OCTAVES**2 < typical < _OCTAVES**2 and near.sum() > _NEARLY_ALL * (images != 0).sum()
    return dtype if real else None


_OCTAVES = 2.0**20  # a quantity of an image spans less, and its median in any unit lies within its square from 1
_NEARLY_ALL = 0.99  # of the pixels that are not 0: a few are defective


def type_wrapped(images: NDArray[Any]) -> np.dtype[Any] | None:
    """The unsigned type for signed integers [..., col] in which the sign bit belongs to the count; None if they are
    signed.

    Images are smooth. If counts exceed the largest value of the signed type, neighbouring pixels differ by the whole
    range of the type, but not if the pixels are read as unsigned. If all counts exceed this value, all of them look
    negative, which is impossible for an intensity. Values that are negative because of noise around 0, or that mark
    pixels without data by one value, have not overflowed. Four bytes may contain values of two, if a file has
    projections as int16 next to flats as uint16.
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


WRAPPED = "wrapped-numbers"  # a rule
_END_PART, _A_ROW = 10, 0.1  # a part of the range that is near its end; edges a row from which they are no zingers
_ALIKE = 0.05  # of the changes above an edge are below it, where both are light; behind a slit there is readout alone
_SMOOTH = 3.0  # times the least change beside an edge: the step across the end, where one smooth image continues there


def wrapped_edges(images: NDArray[Any], dtype: np.dtype[Any], flat: NDArray[Any] | None = None) -> int:
    """Number of edges in counts [..., col] of 16 bits from one end of the range to the other, which no optics makes.

    Two pixels on either side must be in their half of the range, which is not so for a hot pixel or a zinger. If nearly
    all pixels at the top of the range have the same value, they are saturated. 0 if fewer than one in ten rows has such
    an edge. If a `flat` [..., col] is near the top on both sides, something opaque makes such an edge, unless the step
    across the end is as smooth as its surroundings.
    """
    if dtype.kind not in "iu" or dtype.itemsize != 2 or images.shape[-1] < 4:
        return 0
    counts, whole = images.astype(np.int64) - np.iinfo(dtype).min, 2**16
    top, upper = counts >= whole - whole // _END_PART, counts >= whole // 2
    ends = np.where(top, 1, -1 * (counts < whole // _END_PART))
    steps = (ends[..., 1:-2] * ends[..., 2:-1] < 0) & (upper[..., :-3] == upper[..., 1:-2])
    steps &= upper[..., 2:-1] == upper[..., 3:]
    change, above = np.abs(np.diff(counts)), upper[..., 1:-2]
    if flat is not None:
        flat = flat - np.iinfo(dtype).min
        lit = flat >= whole - whole // _END_PART
        beside = np.maximum(np.minimum(change[..., :-2], change[..., 2:]), 1)
        steps &= ~(lit[..., 1:-2] & lit[..., 2:-1]) | (whole - change[..., 1:-1] <= _SMOOTH * beside)
    edges = int(steps.sum())
    of_low, of_high = (np.where(side, change[..., 2:], change[..., :-2])[steps] for side in (above, ~above))
    most = np.unique(counts[top], return_counts=True)[1].max(initial=0)
    if edges < _A_ROW * np.prod(images.shape[:-1]) or most > 0.9 * top.sum():
        return 0
    return 0 if np.median(of_low) < _ALIKE * np.median(of_high) else edges


def in_parts(earlier: Sequence[ScanSource], last: ScanSource, path: Path | None = None) -> ScanSource:
    """The frames of `earlier`, which are complete, and then of `last`, whose path and metadata the scan has.

    Args:
        path: path of the scan, if the user stated that the files are one scan taken without a pause; None: the files
            are parts, between which beam and camera may have changed.

    Raises:
        DataError: frames are of another shape or type.
    """
    for source in earlier:
        if (source.shape, source.dtype, source.quantity) != (last.shape, last.dtype, last.quantity):
            raise DataError(
                f"{source.path} has {source.quantity} of {source.dtype} {source.shape}, but {last.path} "
                f"has {last.quantity} of {last.dtype} {last.shape}: they are not parts of one scan."
            )
    in_order = all(source.in_order for source in (*earlier, last))
    if path is None:
        return Frames(*earlier, last, in_order=in_order)
    one = np.zeros(1, np.int64)
    return Frames(*earlier, last, in_order=in_order, path=path, table=lambda known: replace(known, part_starts=one))
