"""archive: a compressed copy of a scan file, equal in everything to the raw one; whole and compared, or not at all.

The frames lie one a chunk, each compressed by itself; all else is copied as it is. Frames that the raw file draws from
others (a joined scan) become frames of the archive.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from beamline.core.errors import DataError
from beamline.core.files import whole_file
from beamline.core.text import count, size, spans
from beamline.monitor.digest import checksum_of
from beamline.storage import hdf5
from beamline.storage.codecs import filter_of
from beamline.storage.compressed_copy import (
    CompressedCopy,
    ImageCounter,
    Progress,
    drawn_from,
    image_datasets,
    images,
    is_image_dataset,
)
from beamline.storage.parts import joined_file_of, other_parts
from beamline.storage.readers.open import open_scan
from beamline.storage.superblock import superblock
from beamline.storage.writers import layout

_SAMPLES = 4  # images that say how far a dataset can be compressed
_ROOM = 1.1  # free space over the size expected
_BLOCK = 2**24  # bytes that are compared at once


@dataclass(frozen=True)
class Archived:
    """What was written, and compared with the raw file.

    Attributes:
        frames: in the file.
        sources: the raw file, then those that it draws frames from; raw_bytes: of all of them.
        damaged: rows whose pixels differ from the checksum that was written with them, in the raw file already.
    """

    path: Path
    frames: int
    sources: tuple[Path, ...]
    raw_bytes: int
    bytes: int
    damaged: tuple[int, ...]


def archive(
    scan: Path, out: Path, codec: str = "blosc2", *, keep_damaged: bool = False, progress: Progress | None = None
) -> Archived:
    """Write a compressed copy of an HDF5 scan, read every frame back from the closed file, and compare.

    The raw file is only read. The memory is that of a few frames.

    Args:
        codec: a name in `codecs.CODECS`.
        keep_damaged: frames that differ from their stored checksum are copied as they are, and so is the checksum.
        progress: counts the MB of images twice, when they are written and when they are compared.

    Raises:
        DataError: `out` exists; the scan is being written, a part of a joined scan, damaged or no HDF5 scan. The disk
            is too small, or what was read back differs. Nothing is left of `out`, and the scan is untouched.
    """
    frames = _frames_of_archivable(scan)
    with whole_file(out) as partial, hdf5.open_hdf5(scan) as raw, hdf5.readable(scan):
        datasets = image_datasets(raw)
        _require_room(datasets, out, codec)
        counter = ImageCounter(progress, 2 * sum(dataset.nbytes for dataset in datasets))
        try:
            with hdf5.created(partial, layout.LIBVER) as file:
                copy = CompressedCopy(codec, counter, file.require_taken)
                copy.group(raw["/"], file["/"])
                if copy.damaged and not keep_damaged:
                    raise _damaged(scan, copy.damaged)
        except OSError as error:
            raise DataError(f"{out} could not be written ({hdf5.reason(error)}). Nothing is left of it.") from error
        _drop_from_cache(partial)
        with hdf5.open_hdf5(partial) as file:
            differs = next(_differences(raw, file, copy.checksums, counter), "")
        if differs:
            raise DataError(
                f"{out} does not give back what was written: {differs} differs. The disk, or the memory, is faulty. "
                f"Nothing is left of it, and {scan} is untouched."
            )
        parts = (scan.parent / name for dataset in datasets for name in drawn_from(dataset))
        sources = tuple(dict.fromkeys((scan, *parts)))
        raw_bytes = sum(path.stat().st_size for path in sources)
    return Archived(out, frames, sources, raw_bytes, out.stat().st_size, tuple(sorted(copy.damaged)))


def _frames_of_archivable(scan: Path) -> int:
    """How many frames the scan has; DataError where it is not one to archive."""
    if scan.exists() and not (scan.is_file() and hdf5.is_hdf5(scan)):
        raise DataError(f"{scan} is no HDF5 scan. `beamline ingest` makes one of it. Nothing was written.")
    head = superblock(scan) if scan.is_file() else None
    with open_scan(scan) as source:
        frames, finished = int(source.image_key.size), source.finished
    if not finished or (head is not None and head.open_for_writing):
        raise DataError(
            f"{scan} is being written, or its writer died. Let the scan end, or run `beamline recover` first. Nothing "
            "was written."
        )
    if (found := joined_file_of(scan)) is not None:
        joined, n = found
        raise DataError(f"{scan} is one of {n} parts of a scan. Archive all of it: {joined}. Nothing was written.")
    if others := other_parts(scan):
        raise DataError(
            f"{scan} is a part of a run that was resumed, as {others[0]} is, and its parts are not joined. "
            "`beamline recover RUN` joins them; then archive joined.h5. Nothing was written."
        )
    return frames


def _damaged(scan: Path, rows: set[int]) -> DataError:
    return DataError(
        f"{count(len(rows), 'frame')} of {scan} {'differs' if len(rows) == 1 else 'differ'} from what was written, by "
        f"the stored checksum: {spans(sorted(rows))}. Look for a good copy, or archive what there is (--keep-damaged); "
        "`recon` leaves damaged frames out either way. Nothing was written."
    )


def _require_room(datasets: list[h5py.Dataset], out: Path, codec: str) -> None:
    """DataError where the disk has less than the images are expected to take, going by some of each."""
    wanted = 0.0
    with h5py.File.in_memory() as tried:
        for i, dataset in enumerate(datasets):
            rows = np.unique(np.linspace(0, len(dataset) - 1, min(len(dataset), _SAMPLES)).astype(int))
            kept = tried.create_dataset(
                str(i),
                (rows.size, *dataset.shape[1:]),
                dataset.dtype,
                chunks=(1, *dataset.shape[1:]),
                **filter_of(codec),
            )  # fmt: skip
            for k, row in enumerate(rows):
                kept[k] = dataset[row]
            wanted += len(dataset) * kept.id.get_storage_size() / max(rows.size, 1)
    free = shutil.disk_usage(out.parent).free
    if free < _ROOM * wanted:
        raise DataError(
            f"{out.parent} has {size(free)} free, and about {size(_ROOM * wanted)} are needed. Name a file on another "
            "disk. Nothing was written."
        )


def _drop_from_cache(path: Path) -> None:
    """Have the system read the file from the disk from now on, not from its memory, where it can be told so."""
    if hasattr(os, "posix_fadvise"):
        with path.open("rb") as file:
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def _differences(
    raw: h5py.File, file: h5py.File, checksums: Mapping[str, list[int]], counter: ImageCounter
) -> Iterator[str]:
    """What the two files do not have in common: images by their checksums, other datasets by their values."""
    for path, expected in checksums.items():
        for row, (image, checksum) in enumerate(zip(images(file[path]), expected, strict=True)):
            counter.add(image)
            if checksum_of(image) != checksum:
                yield f"image {row} of {path}"
    names: list[str] = []
    raw.visit(names.append)  # each object once, by one of its names
    for name in ("/", *names):
        item, copied = raw[name], file.get(name)
        if type(item) is not type(copied) or not _same_attributes(item, copied):
            yield name
        elif isinstance(item, h5py.Dataset) and not is_image_dataset(item) and not item.is_virtual:
            alike = item.shape == copied.shape and item.dtype == copied.dtype
            if not (alike and _same_values(item, copied)):
                yield name


def _same_attributes(one: h5py.HLObject, other: h5py.HLObject) -> bool:
    return set(one.attrs) == set(other.attrs) and all(
        one.attrs.get_id(name).dtype == other.attrs.get_id(name).dtype and _same(one.attrs[name], other.attrs[name])
        for name in one.attrs
    )


def _same_values(one: h5py.Dataset, other: h5py.Dataset) -> bool:
    if not one.shape:
        return one.shape is None or _same(one[()], other[()])
    step = max(1, _BLOCK // max(1, math.prod(one.shape[1:]) * one.dtype.itemsize))
    return all(_same(one[i : i + step], other[i : i + step]) for i in range(0, len(one), step))


def _same(one: Any, other: Any) -> bool:
    a, b = np.asarray(one), np.asarray(other)
    if not a.dtype.hasobject:
        return a.tobytes() == b.tobytes()
    if a.dtype.names:
        return all(_same(a[name], b[name]) for name in a.dtype.names)
    if a.ndim:
        return a.shape == b.shape and all(_same(x, y) for x, y in zip(a.ravel(), b.ravel(), strict=True))
    return bool(a == b)
