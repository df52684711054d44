"""Angles and references from outside the scan file: read, and laid on frames only where they fit.

Darks and flats are an array, TIFFs, or an HDF5 file of their own, as httomo, i12 and Savu have.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray
from tifffile import natural_sorted

from beamline.core.errors import DataError
from beamline.core.files import text_in
from beamline.plan.plan import from_text
from beamline.storage import datasets, hdf5
from beamline.storage.datasets import require_real
from beamline.storage.foreign_zarr import holds_arrays, open_array_file
from beamline.storage.frame_table import FrameTable
from beamline.storage.readers.base import Quantity, ScanSource
from beamline.storage.readers.dxchange import open_exchange
from beamline.storage.readers.frames import Frames
from beamline.storage.readers.nexus import find
from beamline.storage.readers.nxtomo import open_nxtomo
from beamline.storage.readers.stacks import FrameStack, StacksSource, angles_at, as_frames, dataset_at
from beamline.storage.readers.tiff import (
    DECODERS,
    UNREADABLE,
    images_among,
    is_untyped,
    no_image,
    open_tiff,
    read_image,
)
from beamline.storage.readers.transforms import real_type, type_wrapped, unsigned
from drivers.base.frame import FrameKind

Angles = Path | str | ArrayLike
"""A file, or FILE::NAME of a column or a dataset, in degrees unless it states a unit; or an array in radians."""
_ANGLE = re.compile(r"angle|theta|rotation|omega|phi|degree|\bdeg\b|°", re.IGNORECASE)  # in the name of a column
_UNIT = re.compile(r"[\[(]([^\])]+)[\])]$|[ _](deg|degrees?|m?rad|radians?)$", re.IGNORECASE)  # at its end
_VALUE = re.compile(r"[-+]?(\.?\d|nan\b|inf\b)", re.IGNORECASE)  # what no name of a column begins with


def load_angles(angles: Angles, unit: str | None = None) -> NDArray[np.float64]:
    """Radians from a file, or from an array in radians.

    Args:
        unit: "deg" or "rad", whatever the file says; None: as it says.

    Raises:
        DataError: they cannot be read, or several lists could be meant.
    """
    if not isinstance(angles, Path | str):
        return np.atleast_1d(np.asarray(angles, np.float64))
    name, _, where = (str(angles), "", "") if Path(angles).exists() else str(angles).partition("::")
    path = Path(name)
    if (arrays := holds_arrays(path)) or (path.is_file() and hdf5.is_hdf5(path)):
        with hdf5.readable(path):
            return angles_at(path, where.replace("\\", "/"), unit, "degrees" if arrays else "")
    try:
        return parse_angles(text_in(path), str(path), where, unit)
    except OSError as error:
        raise DataError(f"The angles in {path} cannot be read ({hdf5.reason(error)}).") from error


def parse_angles(content: str, name: str, column: str = "", unit: str | None = None) -> NDArray[np.float64]:
    """Radians from text in degrees (see `plan.from_text`), or from a column of a table, as `load_angles` has it.

    Args:
        name: where the text came from.
    """
    try:
        text, stated = _column(content.splitlines(), column)
        if (factor := datasets.factor_of(unit or stated, datasets.ANGLE_UNITS)) is None:
            raise ValueError(f"the unit of its angles is {stated!r}; say --angles-unit deg or rad")
        return from_text(text, unknown=True) * (factor / datasets.DEGREE)
    except ValueError as error:
        table = ". Of a table, FILE::COLUMN is one column: its name, or its number from 0" * (
            "column" in str(error) or "its angle" in str(error)
        )
        raise DataError(f"{name}: {error}{table}.") from error


def _column(lines: list[str], wanted: str) -> tuple[str, str]:
    """The text of one column of a table, a line for each of the table, and its unit.

    Args:
        wanted: its name, or its number from 0 on; "": the only one that is named after angles. Names stand in the first
            line, which may be a comment. A text without them is one list, in degrees.
    """
    filled = [number for number, line in enumerate(lines) if line.strip()] or [0]
    head, last = (lines[filled[end]].strip() if lines else "" for end in (0, -1))
    bare = head.lstrip("# ")
    mark = next((mark for mark in (";", "\t", ",", None) if len(last.split(mark)) == len(bare.split(mark)) > 1), "\n")
    names = [cell.strip(' "') for cell in bare.split(mark)]
    titled = not any(map(_VALUE.match, names)) and (len(names) > 1 or (head == bare and bool(_ANGLE.search(bare))))
    if not (titled or wanted):
        return "\n".join(lines), "deg"
    chosen = [n for n, title in enumerate(names) if titled and (title == wanted if wanted else _ANGLE.search(title))]
    chosen = chosen or ([int(wanted)] if wanted.isdecimal() else [])
    if len(chosen) != 1 or chosen[0] >= len(names):
        held = ", ".join(names) if titled else f"{len(names)} without names"
        raise ValueError(f"its columns are {held}; expected one that is named after angles")
    for number, line in enumerate(lines):
        cells = [] if line.lstrip()[:1] in ("", "#") or (titled and number == filled[0]) else line.split(mark)
        lines[number] = (cells + [""] * len(names))[chosen[0]].strip(' "') or "(empty)" * bool(cells)
    unit = _UNIT.search(names[chosen[0]]) if titled else None
    return "\n".join(lines), (unit[1] or unit[2]).strip() if unit else "deg"


def select_rows(angles: NDArray[np.float64], rows: str) -> NDArray[np.float64]:
    """Select rows "a:b" of the angles, counted from 0, b excluded; either may be left out."""
    match = re.fullmatch(r"(\d*):(\d*)", rows.strip())
    if match is None:
        raise DataError(
            f"--angle-rows {shlex.quote(rows)} is not of the form A:B, from 0 and B not included, such as 10:101."
        )
    first = int(match[1] or 0)
    last = int(match[2] or angles.size)
    if not 0 <= first < last <= angles.size:
        raise DataError(f"--angle-rows {rows} is out of range: the file has {angles.size} angles.")
    return angles[first:last]


def assign(
    source: ScanSource, angles: NDArray[np.float64], name: str, *, of_views: bool = False
) -> NDArray[np.float64]:
    """Assign an angle in radians to each frame of a source, NaN where unknown.

    There is one angle for each projection; or one for each number of a series of files, where some are lost; or one for
    each frame, where the order of all frames is known. A log that holds nan for each dark and flat tells it, too. A log
    whose steps are equal from end to end has no rows of darks and flats, for which a stage stands.

    Args:
        name: where the angles come from, for messages.
        of_views: the angles are those of projections alone.

    Raises:
        DataError: the angles fit none of these. It names the rows that are surely those of the projections, if any are.
    """
    n, projections = len(source.table), source.table.views
    spread = np.full(n, np.nan)
    if angles.size == projections.size:
        spread[projections] = angles
        return spread
    numbers = source.table.numbers
    if numbers is not None and not of_views and _count_all(numbers, angles.size):
        return np.asarray(angles[numbers - numbers.min()])
    series = None if numbers is None else numbers[projections]
    all_frames = angles.size == n and not of_views
    if all_frames and source.in_order:
        return angles
    if series is not None and _count_all(series, angles.size) and (not all_frames or _in_equal_steps(angles)):
        spread[projections] = angles[series - series.min()]
        return spread
    if all_frames and int(np.isfinite(angles).sum()) == projections.size:
        spread[projections] = angles[np.isfinite(angles)]
        return spread
    raise DataError(_misfit(source, angles, name, series))


def _count_all(numbers: NDArray[np.int64], n: int) -> bool:
    """Whether the numbers of files, no two of them the same, go from the first to the last of n."""
    return bool(numbers.min() >= 0 and np.ptp(numbers) + 1 == n and np.unique(numbers).size == numbers.size)


def _in_equal_steps(angles: NDArray[np.float64]) -> bool:
    """Whether no step is half as long again, or half as short, as the typical one."""
    steps = np.diff(angles)
    typical = float(np.median(steps))
    return bool((np.abs(steps - typical) < abs(typical) / 2).all())


def _misfit(source: ScanSource, angles: NDArray[np.float64], name: str, series: NDArray[np.int64] | None) -> str:
    n, frames = source.table.views.size, len(source.table)
    if angles.size < n:
        message = f"{name} has {angles.size} angles for {n} projections, so that {n - angles.size} have none"
    elif angles.size == frames:
        message = (
            f"{name} has {angles.size} angles, one for each frame, and {source.path} does not say when its darks and "
            f"flats were taken"
        )
    else:
        message = f"{name} has {angles.size} angles, but there are {n} projections among {frames} frames"
    if series is not None and (gaps := source.attributes.get("missing_numbers")):
        message += (
            f". The numbers of the files go from {series.min()} to {series.max()} and leave out {gaps}: of "
            f"{np.ptp(series) + 1} angles, one for each number, each image would get its own"
        )
    elif series is not None and n < angles.size != frames:
        lost = angles.size - n
        message += (
            f". The numbers of the files go from {series.min()} to {series.max()} without a gap: of a series of "
            f"{angles.size}, the first {lost} or the last {lost} may be lost"
        )
    if angles.size < n:
        return f"{message}. Is it cut off, or of another scan? Give one angle for each projection, in their order."
    if angles.size in source.shape:
        order = ("row,view,col", "row,col,view")[source.shape.index(angles.size)]
        message += f". If each image is a sinogram of {angles.size} views, say --order {order}; if not, say"
    else:
        message += ". Say"
    message += f" with --angle-rows A:B which {n} belong to the projections (from 0, B not included)"
    window = evenly_spaced_window(angles, n)
    if window is not None:
        low, high = np.degrees(angles[list(window)])
        message += (
            f"; --angle-rows {window[0]}:{window[1] + 1} takes the {n} neighbours in the most equal steps, "
            f"from {low:.4f} to {high:.4f} degrees"
        )
    return message + "."


def evenly_spaced_window(angles: NDArray[np.float64], n: int) -> tuple[int, int] | None:
    """First and last row of the n consecutive rows with the most equal steps; None if the choice is ambiguous.

    A scan's angle log often holds the darks and flats as well, at a standing stage. If the steps go on beyond these
    rows, other rows would do as well: then views were lost, and nothing tells which.
    """
    if n < 3 or angles.size <= n or not np.isfinite(angles).all():
        return None
    steps = np.diff(angles)
    windows = np.lib.stride_tricks.sliding_window_view(steps, n - 1)
    medians = np.median(windows, axis=1)
    moving = np.flatnonzero(medians != 0)
    if moving.size == 0:
        return None
    uneven = np.abs(windows - medians[:, None]).max(axis=1)[moving] / np.abs(medians[moving])
    first = int(moving[np.argmin(uneven)])
    beside = np.concatenate((steps[first - 1 : first] if first else [], steps[first + n - 1 : first + n]))
    if (np.abs(beside - medians[first]) < np.abs(medians[first]) / 2).any():
        return None
    return first, first + n - 1


Images = Path | str | NDArray[Any]
"""A TIFF, a folder of images, an HDF5 file, .npy, .npz or Zarr (`FILE::DATASET` where it has several), an array
[frame, row, col], or a whole number, the counts of every pixel, unless a file has it as its name."""

_EXCHANGE = {FrameKind.DARK: "exchange/data_dark", FrameKind.FLAT: "exchange/data_white"}
_LISTED = 8  # datasets that an error names


def load_images(images: Images, kind: FrameKind, shape: tuple[int, int] | None = None) -> NDArray[Any]:
    """Read reference frames [frame, row, col] into memory.

    In an HDF5 file they are the dataset that is named, or the frames of this kind by its image_key, or those of Data
    Exchange, or the only images of this shape.

    Args:
        kind: DARK or FLAT.
        shape: (rows, cols) of the scan's frames; None: any.

    Raises:
        DataError: they cannot be read, are no images, or several could be meant.
    """
    if not isinstance(images, Path | str):
        return _stack(np.asarray(images), "The array of reference frames")
    name, _, dataset = str(images).partition("::")
    path = Path(name)
    if name.isdecimal() and shape is not None and not path.exists():
        return np.full((1, *shape), int(name), np.min_scalar_type(int(name)))
    if holds_arrays(path):
        with closing(open_array_file(path)) as arrays, hdf5.readable(path):
            return _in_rows(_read(path, dataset_at(arrays, dataset)), shape)
    if path.is_file() and hdf5.is_hdf5(path):
        with hdf5.open_hdf5(path) as file, hdf5.readable(path):
            return _in_rows(_of_hdf5(path, file, dataset.replace("\\", "/"), kind, shape), shape)
    if dataset:
        raise DataError(f"{path} is not an HDF5 file, so that it has no dataset {dataset}.")
    return _in_rows(_of_images(path), shape)


def _in_rows(images: NDArray[Any], shape: tuple[int, int] | None) -> NDArray[Any]:
    """References of a detector of one row, [frame, col], as frames of one row."""
    lines = shape is not None and len(images) == shape[0] == 1 < images.shape[1] and images.shape[2] == shape[1]
    return images.swapaxes(0, 1) if lines else images


def _of_images(path: Path) -> NDArray[Any]:
    files = [path]
    if path.is_dir():
        names = [item.name for item in path.iterdir()]
        files = [path / name for name in natural_sorted(images_among(names))]
        if not files:
            raise DataError(no_image(path, names))
    try:
        decoders = [DECODERS.get(file.suffix.lower(), read_image) for file in files]
        if untyped := decoders[0] is read_image:
            with open_tiff(files[0]) as tif:
                untyped = is_untyped(tif)
        parts = [decoder(file) for decoder, file in zip(decoders, files, strict=True)]
        stack = np.concatenate([part[None] if part.ndim == 2 else part for part in parts])
    except UNREADABLE as error:
        wanted = "" if isinstance(error, OSError) and error.errno else " as images of one shape, nor as HDF5"
        raise DataError(f"The reference frames in {path} cannot be read{wanted} ({hdf5.reason(error)}).") from error
    return _stack(stack, str(path), untyped)


def _of_hdf5(path: Path, file: h5py.File, dataset: str, kind: FrameKind, shape: tuple[int, int] | None) -> NDArray[Any]:
    if dataset:
        return _read(path, dataset_at(file, dataset))
    for places in find(file):
        keys = np.ravel(datasets.values_of(places.image_key))
        if (keys == kind).any():
            return _of_scan(open_nxtomo(path, own_angles=False, data=str(places.data.name)), kind)
    exchange = datasets.dataset(file, _EXCHANGE[kind])
    if exchange is not None and datasets.dataset(file, "exchange/data") is not None:
        return _of_scan(open_exchange(path, own_angles=False), kind)
    if exchange is not None:
        return _read(path, exchange)
    candidates = [item for item in _images(file) if shape is None or item.shape[-2:] == shape]
    if len(candidates) == 1:
        return _read(path, candidates[0])
    listed = (candidates or [*_images(file)])[:_LISTED]
    shapes = ", ".join(f"{item.name} ({' x '.join(map(str, item.shape))})" for item in listed)
    wanted = "images" if shape is None else f"images of {shape[0]} x {shape[1]} pixels"
    option = f"--{kind.name.lower()}s"
    if candidates:
        raise DataError(f"{path} holds several datasets of {wanted}: {shapes}. Name one: {option} FILE::DATASET.")
    raise DataError(f"{path} holds no {wanted} for {option}" + (f"; it has {shapes}." if shapes else "."))


def _of_scan(source: ScanSource, kind: FrameKind) -> NDArray[Any]:
    """Frames of a kind as the reader of their format gives them, mirrored and turned as the file says."""
    with source:
        return _stack(source.read(source.table.of_kind(kind)), str(source.path))


def _images(file: h5py.File) -> Iterator[h5py.Dataset]:
    """Every dataset that may be images, once, also behind links."""
    return (item for item in datasets.arrays_in(file, (2, 3, 4)) if min(item.shape[-2:]) > 1)


def _read(path: Path, item: Any) -> NDArray[Any]:
    if lost := datasets.missing_links(item):
        raise DataError(f"{path} draws {item.name} from {lost[0]}, which is not there or differs.")
    frames = as_frames(item)
    if frames.ndim != 3:
        raise DataError(f"{item.name} in {path} is {item.shape}; expected images [frame, row, col].")
    datasets.require_possible(frames)
    out = np.empty(frames.shape, frames.dtype)
    datasets.read_frames(frames, np.arange(len(frames)), slice(None), out)
    return _stack(out, f"{item.name} in {path}")


def _stack(images: NDArray[Any], name: str, untyped: bool = False) -> NDArray[Any]:
    require_real(images.dtype, name)
    if (dtype := real_type(images, False) if untyped else type_wrapped(images)) is not None:
        images = unsigned(images, dtype)
    return images[None] if images.ndim == 2 else images


_REFERENCES = (FrameKind.DARK, FrameKind.FLAT)


def overlaid(
    base: ScanSource,
    *,
    darks: NDArray[Any] | None = None,
    flats: NDArray[Any] | None = None,
    quantity: Quantity | None = None,
) -> ScanSource:
    """A scan with references in front: darks, flats, then the frames of `base`.

    If darks (flats) are given, those of `base` become INVALID: they stay in place, unused. Added flats are valid for
    all parts of the scan. All frames have one dtype, as of one camera.

    Args:
        darks, flats: [frame, row, col].

    Raises:
        DataError: shapes or counts do not fit.
    """
    given = {kind: images for kind, images in zip(_REFERENCES, (darks, flats), strict=True) if images is not None}
    for kind, images in given.items():
        if images.ndim != 3 or images.shape[1:] != base.shape or len(images) == 0:
            raise DataError(
                f"The --{kind.name.lower()}s are {images.shape}; expected [frame, row, col] with frames of "
                f"{base.shape} as in {base.path}."
            )
    if base.quantity == "unknown" and base.table.has(*{*_REFERENCES} - {*given}):
        quantity = quantity or "counts"
    base = Frames(
        base,
        quantity=quantity or base.quantity,
        table=lambda known: known.without(known.of_kind(*given)),
    )
    if not given:
        return base
    stacks = [FrameStack(kind, f"--{kind.name.lower()}s", images) for kind, images in given.items()]
    front = StacksSource(base.path, ExitStack(), stacks, format=base.format, facts={})

    def of_all_parts(table: FrameTable) -> FrameTable:
        starts = np.where((table.part_starts > len(front.table)) & (flats is None), table.part_starts, 0)
        return replace(table, part_starts=np.unique(starts))

    return Frames(front, base, in_order=base.in_order, checksummed=base.checksummed, table=of_all_parts)
