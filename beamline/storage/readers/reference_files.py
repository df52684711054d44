"""Darks and flats from outside the scan file: an array, images, or a separate file, as in httomo and Savu."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from tifffile import natural_sorted

from beamline.core.errors import DataError
from beamline.storage import datasets, hdf5
from beamline.storage.array_file import holds_arrays, open_array_file
from beamline.storage.datasets import require_real
from beamline.storage.frame_table import FrameTable
from beamline.storage.readers.base import Quantity, ScanSource, Stated, frame_indices
from beamline.storage.readers.formats import references_in
from beamline.storage.readers.frames import Frames
from beamline.storage.readers.orders import as_frames
from beamline.storage.readers.stacks import FrameStack, StacksSource, dataset_at
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

Images = Path | str | NDArray[Any]
"""Where darks or flats come from. A TIFF, a folder of images, or an HDF5 file, .npy, .npz or Zarr (`FILE::DATASET` if
it has several datasets). An array [frame, row, col]. Or an integer: the counts of every pixel, unless a file with this
name exists.
"""


def stated_references(
    base: ScanSource, quantity: Stated | None, given: tuple[Images | None, Images | None], white: float | None
) -> tuple[Images | None, Images | None]:
    """The darks and flats that replace those of the scan. For transmission they are 0 and 1. None: those of the scan
    are used.

    Args:
        given: darks and flats that the caller gives.
        white: counts of the open beam from the settings file of the manufacturer.

    Raises:
        DataError: the values of the pixels cannot be transmission.
    """
    darks, flats = given
    empty_frame = np.zeros((1, *base.shape), base.dtype)
    if quantity != "transmission":
        if white is None or base.dtype.kind not in "ui":
            return given
        flats = np.full_like(empty_frame, white) if flats is None else flats
        return empty_frame if darks is None else darks, flats
    if darks is not None or flats is not None:
        raise DataError(
            "Omit --darks and --flats, because --quantity transmission means that the frames were "
            "already divided by flats."
        )
    if base.dtype.kind != "f":
        raise DataError(
            f"{base.path} has {base.dtype} pixels, but transmission is a real number from 0 to 1. If an integer such "
            "as 65535, or the counts of air next to the sample, represents a transmission of 1, leave out "
            "--quantity and give this integer as flat: --flats 65535 --darks 0."
        )
    return empty_frame, np.ones_like(empty_frame)


_EXCHANGE = {FrameKind.DARK: "exchange/data_dark", FrameKind.FLAT: "exchange/data_white"}
_LISTED = 8  # most datasets that an error names


def load_images(images: Images, kind: FrameKind, shape: tuple[int, int] | None = None) -> NDArray[Any]:
    """Read darks or flats [frame, row, col] into memory.

    In an HDF5 file, these are the first of the following that exists: the named dataset, the frames of this kind
    according to image_key, the frames of this kind in Data Exchange, or the only images of this shape.

    Args:
        kind: DARK or FLAT.
        shape: (rows, cols) of the scan's frames; None: any.

    Raises:
        DataError: the data cannot be read or are not images, or it is unclear which of several datasets is meant.
    """
    if not isinstance(images, Path | str):
        return _stack(np.asarray(images), "The array of reference frames")
    name, _, dataset = str(images).partition("::")
    path = Path(name)
    if name.isdecimal() and shape is not None and not path.exists():
        return np.full((1, *shape), int(name), np.min_scalar_type(int(name)))
    if holds_arrays(path):
        try:
            opened = open_array_file(path)
        except UNREADABLE as error:
            raise DataError(
                f"The reference frames in {path} cannot be read as arrays ({hdf5.reason(error)})."
            ) from error
        with closing(opened) as arrays, hdf5.readable(path):
            return _in_rows(_read(path, dataset_at(arrays, dataset)), shape)
    if path.is_file() and hdf5.is_hdf5(path):
        with hdf5.open_hdf5(path) as file, hdf5.readable(path):
            return _in_rows(_of_hdf5(path, file, dataset.replace("\\", "/"), kind, shape), shape)
    if dataset:
        raise DataError(f"{path} is not an HDF5 file, so it has no dataset {dataset}.")
    return _in_rows(_of_images(path), shape)


def _in_rows(images: NDArray[Any], shape: tuple[int, int] | None) -> NDArray[Any]:
    """Darks or flats of a detector with one row, [frame, col], as frames with one row."""
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
        wanted = "" if isinstance(error, OSError) and error.errno else " as images of one shape or as HDF5"
        raise DataError(f"The reference frames in {path} cannot be read{wanted} ({hdf5.reason(error)}).") from error
    return _stack(stack, str(path), untyped)


def _of_hdf5(path: Path, file: h5py.File, dataset: str, kind: FrameKind, shape: tuple[int, int] | None) -> NDArray[Any]:
    if dataset:
        return _read(path, dataset_at(file, dataset))
    if (scan := references_in(path, file, kind)) is not None:
        with scan:  # as the reader of this format returns them: mirrored and rotated as the file states
            return _stack(scan.read(scan.table.of_kind(kind)), str(path))
    exchange = datasets.dataset(file, _EXCHANGE[kind])
    if exchange is not None:
        return _read(path, exchange)
    if numbered := _numbered(file, kind, shape):
        return np.concatenate([_read(path, item) for _, item in sorted(numbered.items())])
    candidates = [item for item in _images(file) if shape is None or item.shape[-2:] == shape]
    if len(candidates) == 1:
        return _read(path, candidates[0])
    listed = (candidates or [*_images(file)])[:_LISTED]
    shapes = ", ".join(f"{item.name} ({' x '.join(map(str, item.shape))})" for item in listed)
    wanted = "images" if shape is None else f"images of {shape[0]} x {shape[1]} pixels"
    option = f"--{kind.name.lower()}s"
    if candidates:
        raise DataError(
            f"{path} contains several datasets of {wanted}: {shapes}. Name one of these datasets: "
            f"{option} FILE::DATASET."
        )
    raise DataError(f"{path} contains no {wanted} for {option}" + (f"; it has {shapes}." if shapes else "."))


def _numbered(file: h5py.File, kind: FrameKind, shape: tuple[int, int] | None) -> dict[int, h5py.Dataset]:
    """The images of one kind, by the number of the frame before which they were taken. BLISS and nabu store them under
    such numbers: /entry/flats/0 and /entry/flats/89.
    """
    named = [(str(item.name).rpartition("/"), item) for item in _images(file) if shape in (None, item.shape[-2:])]
    ours = [(of, number, item) for (of, _, number), item in named if number.isdecimal() and kind.name.lower() in of]
    return {int(number): item for _, number, item in ours} if len({of for of, *_ in ours}) == 1 else {}


def places_of_flats(images: Images | None, shape: tuple[int, int], n: int) -> NDArray[np.float64] | None:
    """When each of the flats in a file was taken, from 0 (first frame of the scan) to 1 (last of n frames). None: not
    stated.

    If the stored numbers exceed n, they also count other frames. The first flat is then assumed to be at the first
    frame.
    """
    if not isinstance(images, Path | str) or not Path(images).is_file() or not hdf5.is_hdf5(Path(images)):
        return None
    with hdf5.open_hdf5(Path(images)) as file, hdf5.readable(Path(images)):
        flats = sorted(_numbered(file, FrameKind.FLAT, shape).items())
        numbers = np.repeat([float(number) for number, _ in flats], [math.prod(item.shape[:-2]) for _, item in flats])
    if len(flats) > 1 and numbers[-1] <= n:
        return np.where(numbers < n - 1, numbers / n, 1.0)
    return (numbers - numbers[0]) / np.ptp(numbers) if len(flats) > 1 else None


def _images(file: h5py.File) -> Iterator[h5py.Dataset]:
    """Yields every dataset that may contain images. Links are followed, and each dataset is returned once."""
    return (item for item in datasets.arrays_in(file, (2, 3, 4)) if min(item.shape[-2:]) > 1)


def _read(path: Path, item: Any) -> NDArray[Any]:
    if lost := datasets.missing_links(item):
        linked_file = lost[0]
        raise DataError(
            f"{path} refers to data of {item.name} in {linked_file}, which does not exist or has another shape."
        )
    frames = as_frames(item)
    if frames.ndim != 3:
        raise DataError(f"{item.name} in {path} has the shape {item.shape}; expected images [frame, row, col].")
    datasets.require_possible(frames)
    out = np.empty(frames.shape, frames.dtype)
    datasets.read_frames(frames, np.arange(len(frames)), slice(None), out)
    return _stack(out, f"{item.name} in {path}")


def _stack(images: NDArray[Any], name: str, untyped: bool = False) -> NDArray[Any]:
    require_real(images.dtype, name)
    if (dtype := real_type(images) if untyped else type_wrapped(images)) is not None:
        images = unsigned(images, dtype)
    return images[None] if images.ndim == 2 else images


_REFERENCES = (FrameKind.DARK, FrameKind.FLAT)


def overlaid(
    base: ScanSource,
    *,
    darks: NDArray[Any] | None = None,
    flats: NDArray[Any] | None = None,
    quantity: Quantity | None = None,
    places: NDArray[np.float64] | None = None,
) -> ScanSource:
    """A scan with additional darks and flats at its beginning: darks, flats, then the frames of `base`.

    If darks (or flats) are given, the darks (or flats) of `base` become INVALID: they stay in the table but are not
    used. Added flats apply to all parts of the scan. All frames get the same dtype.

    Args:
        darks, flats: [frame, row, col].
        places: when each flat was taken, from 0 (first frame of the scan) to 1 (last frame); None: before the scan.

    Raises:
        DataError: the shapes or the numbers of frames do not fit.
    """
    given = {kind: images for kind, images in zip(_REFERENCES, (darks, flats), strict=True) if images is not None}
    for kind, images in given.items():
        if images.ndim != 3 or images.shape[1:] != base.shape or len(images) == 0:
            raise DataError(
                f"The --{kind.name.lower()}s have the shape {images.shape}; expected [frame, row, col] with frames of "
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

    whole = Frames(front, base, in_order=base.in_order, checksummed=base.checksummed, table=of_all_parts)
    if places is None or places.size != len(given[FrameKind.FLAT]):
        return whole
    place = np.r_[np.full(len(front.table), -1.0), np.arange(len(base.table))]
    place[len(front.table) - places.size : len(front.table)] = places * len(base.table) - 0.5
    order = np.argsort(place, kind="stable")
    return Frames(
        whole,
        pixels=lambda read, frames, rows: read(order[frame_indices(frames, order.size)], rows),
        table=lambda known: replace(known.take(order), part_starts=np.zeros(1, np.int64)),
    )
