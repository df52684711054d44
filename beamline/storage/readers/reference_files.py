"""Darks and flats that a caller names: an array, TIFFs, or an HDF5 file of their own, as httomo, i12 and Savu have."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from tifffile import natural_sorted

from beamline.core.errors import DataError
from beamline.storage import hdf5
from beamline.storage.hdf5 import require_real
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.dxchange import open_exchange
from beamline.storage.readers.nexus import find
from beamline.storage.readers.nxtomo import NXtomoSource
from beamline.storage.readers.stacks import dataset_at
from beamline.storage.readers.tiff import SUFFIXES, UNREADABLE, is_hidden, read_image
from beamline.storage.readers.wrapped import type_wrapped, unsigned
from drivers.base.frame import FrameKind

Images = Path | str | NDArray[Any]
"""A TIFF, a folder of TIFFs, an HDF5 file (`FILE::DATASET` where it has several), or an array [frame, row, col]."""

_EXCHANGE = {FrameKind.DARK: "exchange/data_dark", FrameKind.FLAT: "exchange/data_white"}
_LISTED = 8  # datasets that an error names


def load_images(images: Images, kind: FrameKind, shape: tuple[int, int] | None = None) -> NDArray[Any]:
    """Reference frames [frame, row, col], all in memory.

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
    if path.is_file() and hdf5.is_hdf5(path):
        with hdf5.open_hdf5(path) as file, hdf5.readable(path):
            return _of_hdf5(path, file, dataset.replace("\\", "/"), kind, shape)
    if dataset:
        raise DataError(f"{path} is no HDF5 file, so that it has no dataset {dataset}.")
    return _of_tiffs(path)


def _of_tiffs(path: Path) -> NDArray[Any]:
    files = [path]
    if path.is_dir():
        names = natural_sorted(item.name for item in path.iterdir() if item.suffix.lower() in SUFFIXES)
        files = [path / name for name in names if not is_hidden(name)]
    if not files:
        raise DataError(f"{path} holds no .tif or .tiff file.")
    try:
        parts = [read_image(file) for file in files]
        stack = np.concatenate([part[None] if part.ndim == 2 else part for part in parts])
    except UNREADABLE as error:
        wanted = "" if isinstance(error, OSError) and error.errno else " as TIFFs of one shape, nor as HDF5"
        raise DataError(f"The reference frames in {path} cannot be read{wanted} ({hdf5.reason(error)}).") from error
    return _stack(stack, str(path))


def _of_hdf5(path: Path, file: h5py.File, dataset: str, kind: FrameKind, shape: tuple[int, int] | None) -> NDArray[Any]:
    if dataset:
        return _read(path, dataset_at(file, dataset))
    for places in find(file):
        keys = np.ravel(hdf5.values_of(places.image_key))
        if (keys == kind).any():
            return _of_scan(NXtomoSource(path, own_angles=False, data=str(places.data.name)), kind)
    exchange = hdf5.dataset(file, _EXCHANGE[kind])
    if exchange is not None and hdf5.dataset(file, "exchange/data") is not None:
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
        return _stack(source.read(np.flatnonzero(source.image_key == kind)), str(source.path))


def _images(file: h5py.File) -> Iterator[h5py.Dataset]:
    """Every dataset that may be images, once, also behind links."""
    return (item for item in hdf5.images_in(file) if min(item.shape[-2:]) > 1)


def _read(path: Path, item: h5py.Dataset, rows: NDArray[np.intp] | None = None) -> NDArray[Any]:
    if lost := hdf5.missing_links(item):
        raise DataError(f"{path} draws {item.name} from {lost[0]}, which is not there or differs.")
    if item.ndim not in (2, 3):
        raise DataError(f"{item.name} in {path} is {item.shape}; expected images [frame, row, col].")
    if item.ndim == 2:
        return _stack(item[()], f"{item.name} in {path}")
    hdf5.require_possible(item)
    rows = np.arange(len(item)) if rows is None else rows
    out = np.empty((rows.size, *item.shape[1:]), item.dtype)
    hdf5.read_frames(item, rows.astype(np.int64), slice(None), out)
    return _stack(out, f"{item.name} in {path}")


def _stack(images: NDArray[Any], name: str) -> NDArray[Any]:
    require_real(images.dtype, name)
    if (dtype := type_wrapped(images)) is not None:
        images = unsigned(images, dtype)
    return images[None] if images.ndim == 2 else images
