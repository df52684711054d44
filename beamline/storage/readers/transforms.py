"""Scans that are read in another form than they are stored: only some columns, other kinds of frames or pixel types, or
the frames of several files.
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

UNPACKED, _READ = 2**28, 2**30  # most bytes of one frame, and of all frames, that are read to describe a scan


def brief_source(base: ScanSource, over: Callable[[], bool]) -> ScanSource:
    """The scan for callers that only describe it. A read raises TakesTooLongError if `over` returns True before it, or
    if it would need much time or memory.

    With some orders of dimensions, or some chunks, reading one frame takes as long as reading all frames.
    """

    def pixels(read: Read, frames: slice | ArrayLike, rows: slice) -> NDArray[Any]:
        n = frame_indices(frames, len(base.table)).size * len(range(base.shape[0])[rows])
        if over() or base.frame_bytes > UNPACKED or n * base.shape[1] * base.dtype.itemsize > _READ:
            raise TakesTooLongError(
                "Not all frames that may show a fault of the scan were checked, because this check would take too "
                "long. `beamline validate` checks all frames."
            )
        return read(frames, rows)

    return Frames(base, pixels=pixels)


def cropped(base: ScanSource, cols: tuple[int, int]) -> ScanSource:
    """The scan with only the columns (first, end) `cols`; `end` is not included. Column numbers, such as the axis and
    the regions of flags, are counted from the first of these columns.

    Raises:
        ConfigError: columns lie outside the detector.
    """
    first, end = cols
    if not 0 <= first < end <= base.shape[1]:
        n_cols = base.shape[1]
        raise ConfigError(f"--cols {first}:{end} is out of range: the detector has columns 0:{n_cols}.")

    def moved(table: FrameTable) -> FrameTable:
        if (flags := table.flags) is None:
            return table
        there = flags.regions[..., :1] >= 0  # a value below 0 means no region
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
        DataError: the scan has flags of the monitor, so its axis is vertical.
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
    """A scan with the kinds of frames that the caller states, or with only the frames of one energy.

    Args:
        kinds: rows of the scan by kind, such as "darks=0:5,flats=5:10+95:100,views=10:95"; ends are not included. All
            other frames are projections, or invalid if "views" is given. "none=30:38" alone makes these frames invalid,
            and all others keep their kinds. "energy=20" makes all frames invalid that have another energy according to
            the file.

    Raises:
        DataError: the text is wrong, rows lie outside the scan, or the file does not state this energy.
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
    """The kinds and the selected projections in the text of --frames, such as "darks=0:5,flats=5:10,0::2". None for the
    part that is missing.
    """
    words = [] if frames is None else frames.split(",")
    matches = [_VIEWS.fullmatch(word) for word in words]
    taken = [slice(*(int(number) if number else None for number in match.groups())) for match in matches if match]
    if len(taken) != 1:
        return frames, None
    return ",".join(word for word, match in zip(words, matches, strict=True) if not match) or None, taken[0]


def selected(base: ScanSource, views: slice) -> ScanSource:
    """A scan with only some of its projections, which are counted from 0 without darks and flats. All other projections
    become invalid frames.

    If the number of darks (or flats) is a multiple of the step, they were taken alternately like the projections. Then
    the darks (or flats) with the same positions are selected, also counted from 0. Otherwise all of them are used.

    Raises:
        DataError: no projection is selected.
    """
    table, n, out = base.table, base.table.views.size, list[NDArray[np.int64]]()
    first, end, step = views.indices(n)
    if first >= end:
        raise DataError(
            f"--frames selects no projection: {base.path} has {n} projections. --frames counts the projections from "
            "0, without darks and flats."
        )
    for kind in (FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION):
        rows = table.of_kind(kind)
        in_turn = slice(first % step, None, step) if rows.size % step == 0 else WHOLE
        out.append(np.delete(rows, views if kind is FrameKind.PROJECTION else in_turn))
    return Frames(base, table=lambda known: known.without(np.concatenate(out)))


def only_omits(kinds: str | None) -> bool:
    """True if the caller only leaves out frames and does not state their kinds."""
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
    """The energy in keV of a text such as "energy=20", and the frames with other energies."""
    try:
        kev = float(word.removeprefix(_ENERGY))
    except ValueError:
        raise DataError(f"--frames {word}: expected a number in keV, such as energy=20.") from None
    known = source.table.energies
    if known is None:
        raise DataError(f"Omit --frames {word}: {source.path} does not state the energy of each frame.")
    others = np.abs(known - kev) > _SAME_ENERGY * kev
    if not (np.isfinite(known) & ~others).any():
        raise DataError(
            f"--frames {word}: no frame of {source.path} has this energy. Projections at each energy: "
            f"{in_words(known)}."
        )
    return kev, others


def in_words(energies: NDArray[np.float64]) -> str:
    """Text with the number of frames at each energy, such as "45 at 20 keV and 45 at 30 keV"."""
    parts = frames_by_energy(energies)
    listed = [f"{n} at {kev:.6g} keV" for kev, n in parts[:_LISTED]]
    listed += [f"and more up to {parts[-1][0]:.6g} keV"] if len(parts) > _LISTED else []
    return ", ".join(listed)


def frames_by_energy(energies: NDArray[np.float64]) -> list[tuple[float, int]]:
    """(keV, number of frames) for each energy. Energies that differ by less than a part in ten thousand count as the
    same.
    """
    known = np.sort(energies[np.isfinite(energies)])
    parts = np.split(known, np.flatnonzero(np.diff(known) > _SAME_ENERGY * known[:-1]) + 1)
    return [(float(np.median(part)), int(part.size)) for part in parts if part.size]


_ENERGY = "energy="
_SAME_ENERGY = 1e-4  # reproducibility of a monochromator
_LISTED = 6  # most energies that a sentence lists
_VIEWS = re.compile(r"\s*(-?\d{1,9})?:(-?\d{1,9})?(?::([1-9]\d{0,8})?)?\s*")  # a slice as in Python
_KINDS = {"darks": FrameKind.DARK, "flats": FrameKind.FLAT, "views": FrameKind.PROJECTION, "none": FrameKind.INVALID}


def _ranges(kinds: str, n: int) -> list[tuple[FrameKind, int, int]]:
    """Kind and rows [first, end) of each range in `kinds`. Raises DataError for a text that is not a range."""
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
    """A scan whose pixels are read as their true type: unsigned counts that were stored as signed integers, or real
    numbers that were stored as integers.
    """
    wrapped = f"int{8 * dtype.itemsize} that overflowed"
    what = "real numbers, as their bits show (the TIFF has no SampleFormat)" if dtype.kind == "f" else wrapped
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
    """The floating-point type, if integers [..., col] are in fact the bits of real numbers. None if they are integers.

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


_OCTAVES = 2.0**20  # the values of an image span a smaller range than this, whatever their unit is
_NEARLY_ALL = 0.99  # share of the nonzero pixels; a few may be defective


def type_wrapped(images: NDArray[Any]) -> np.dtype[Any] | None:
    """The unsigned type, if signed integers [..., col] are in fact unsigned counts that overflowed. None if they are
    signed.

    Images are smooth. If counts exceed the largest value of the signed type, neighbouring pixels differ by the whole
    range of the type. The difference disappears if the pixels are read as unsigned. If all counts exceed this value,
    all of them look negative, which is impossible for an intensity. Negative values may also be noise around 0, or a
    single value that marks pixels without data; these have not overflowed. A four-byte type may contain two-byte
    values, if a file has projections as int16 and flats as uint16.
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


WRAPPED = "wrapped-numbers"  # name of a rule
_END_PART, _A_ROW = 10, 0.1  # part of the range near an end; least number of edges per row
# Changes on the low side of an edge, as a share of those on the high side. Below this share, the low side is only
# readout noise, as behind a slit; otherwise both sides are light.
_ALIKE = 0.05
_SMOOTH = 3.0  # largest step across the end of the range in a smooth image, in changes next to the edge


def wrapped_edges(images: NDArray[Any], dtype: np.dtype[Any], flat: NDArray[Any] | None = None) -> int:
    """Number of edges in 16-bit counts [..., col] that go from one end of the range to the other. No optical image has
    such edges.

    An edge counts if two pixels on either side are in the same half of the range; hot pixels and zingers are thereby
    excluded. If nearly all pixels at the top of the range have the same value, they are saturated. The result is 0 if
    fewer than one in ten rows has an edge. If `flat` [..., col] is near the top of the range on both sides of an edge,
    an opaque object may have caused the edge. It then counts only if the image continues smoothly across the end of the
    range.
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
        neighbour_change = np.maximum(np.minimum(change[..., :-2], change[..., 2:]), 1)
        steps &= ~(lit[..., 1:-2] & lit[..., 2:-1]) | (whole - change[..., 1:-1] <= _SMOOTH * neighbour_change)
    edges = int(steps.sum())
    of_low, of_high = (np.where(side, change[..., 2:], change[..., :-2])[steps] for side in (above, ~above))
    most_equal = np.unique(counts[top], return_counts=True)[1].max(initial=0)
    if edges < _A_ROW * np.prod(images.shape[:-1]) or most_equal > 0.9 * top.sum():
        return 0
    return 0 if np.median(of_low) < _ALIKE * np.median(of_high) else edges


def in_parts(earlier: Sequence[ScanSource], last: ScanSource, path: Path | None = None) -> ScanSource:
    """A scan with the frames of `earlier`, which are complete, and then the frames of `last`. Path and metadata are
    those of `last`.

    Args:
        path: path of the scan, if the user stated that the files are one scan taken without a pause; None: the files
            are parts, between which beam and camera may have changed.

    Raises:
        DataError: frames have different shapes or types.
    """
    for source in earlier:
        if (source.shape, source.dtype, source.quantity) != (last.shape, last.dtype, last.quantity):
            raise DataError(
                f"{source.path} has {source.quantity} of {source.dtype} {source.shape}, but {last.path} has "
                f"{last.quantity} of {last.dtype} {last.shape}: the two files are not parts of one scan."
            )
    in_order = all(source.in_order for source in (*earlier, last))
    if path is None:
        return Frames(*earlier, last, in_order=in_order)
    one = np.zeros(1, np.int64)
    return Frames(*earlier, last, in_order=in_order, path=path, table=lambda known: replace(known, part_starts=one))
