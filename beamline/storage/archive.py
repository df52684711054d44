"""archive: a compressed copy of a scan file, equal in everything to the raw one; whole and compared, or not at all.

The frames lie one a chunk, each compressed by itself; all else is copied as it is. Frames that the raw file draws from
others (a joined scan) become frames of the archive.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import h5py
import hdf5plugin
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import whole_file
from beamline.core.text import count, size, spans
from beamline.monitor.digest import checksum_of, has_checksum
from beamline.storage import hdf5
from beamline.storage.parts import joined_file_of
from beamline.storage.readers.open import open_scan
from beamline.storage.superblock import superblock
from beamline.storage.writers import layout
from beamline.storage.writers.to_disk import to_disk

CODECS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "blosc2": hdf5plugin.Blosc2("zstd", clevel=1, filters=hdf5plugin.Blosc2.BITSHUFFLE),
        "bitshuffle-zstd": hdf5plugin.Bitshuffle(cname="zstd", clevel=3),
        "bitshuffle-lz4": hdf5plugin.Bitshuffle(cname="lz4"),
    }
)
"""Lossless compressors, the first being the default."""

_IMAGE = 4096  # bytes from which a row of a dataset [frame, row, col] is an image
_SAMPLES = 4  # images that say how far a dataset can be compressed
_ROOM = 1.1  # free space over the size expected
_BLOCK = 2**24  # bytes that are compared at once

Progress = Callable[[int, int], None]
"""Is told how many of how many MB are done."""


@dataclass(frozen=True)
class Archived:
    """What was written, and compared with the raw file.

    Attributes:
        frames: in the file; raw_bytes: of the raw file, and of the files that it draws frames from.
        damaged: rows whose pixels differ from the checksum that was written with them, in the raw file already.
    """

    path: Path
    frames: int
    raw_bytes: int
    bytes: int
    damaged: tuple[int, ...]


def archive(
    scan: Path, out: Path, codec: str = "blosc2", *, keep_damaged: bool = False, progress: Progress | None = None
) -> Archived:
    """Write a compressed copy of an HDF5 scan, read every frame back from the closed file, and compare.

    The raw file is only read. The memory is that of a few frames.

    Args:
        codec: a name in CODECS.
        keep_damaged: frames that differ from their stored checksum are copied as they are, and so is the checksum.
        progress: counts the MB of images twice, when they are written and when they are compared.

    Raises:
        DataError: `out` exists; the scan is being written, a part of a joined scan, damaged or no HDF5 scan; the disk
            is too small; what was read back differs. Nothing is left of `out`, and the scan is untouched.
    """
    whole = _refuse(scan)
    with whole_file(out) as partial, hdf5.open_hdf5(scan) as raw, hdf5.readable(scan):
        stacks = _stacks(raw)
        _require_room(stacks, out, codec)
        told = _Told(progress, 2 * sum(stack.nbytes for stack in stacks))
        try:
            with hdf5.created(partial, layout.LIBVER) as file:
                copy = _Copy(codec, told)
                copy.group(raw["/"], file["/"])
                if copy.damaged and not keep_damaged:
                    raise _damaged(scan, copy.damaged)
                file.flush()
                to_disk(file.id.get_vfd_handle())
        except OSError as error:
            raise DataError(f"{out} could not be written ({hdf5.reason(error)}). Nothing is left of it.") from error
        _forget(partial)
        with hdf5.open_hdf5(partial) as file:
            differs = next(_differences(raw, file, copy.checksums, told), "")
        if differs:
            raise DataError(
                f"{out} does not give back what was written: {differs} differs. The disk, or the memory, is faulty. "
                f"Nothing is left of it, and {scan} is untouched."
            )
        sources = {scan, *(scan.parent / name for stack in stacks for name in _drawn_from(stack))}
        raw_bytes = sum(path.stat().st_size for path in sources)
    return Archived(out, whole, raw_bytes, out.stat().st_size, tuple(sorted(copy.damaged)))


def _refuse(scan: Path) -> int:
    """DataError where the scan is not one to archive; else how many frames it has."""
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
    return frames


def _damaged(scan: Path, rows: set[int]) -> DataError:
    return DataError(
        f"{count(len(rows), 'frame')} of {scan} differ from the checksums that were written with them: "
        f"{spans(sorted(rows))}. Look for a good copy, or archive them as they are (--keep-damaged); `recon` leaves "
        "them out either way. Nothing was written."
    )


class _Told:
    """Counts the bytes of images, and tells how many of how many MB are done."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._done, self._total = progress, 0, total

    def image(self, image: NDArray[Any]) -> None:
        self._done += image.nbytes
        if self._progress is not None:
            self._progress(math.ceil(self._done / 1e6), math.ceil(self._total / 1e6))


class _Place(NamedTuple):
    """Of an object in its file."""

    file: int
    address: int


def _place(item: h5py.HLObject) -> _Place:
    info = h5py.h5o.get_info(item.id)
    return _Place(info.fileno, info.addr)


class _Copy:
    """Copies a file group by group.

    Attributes:
        checksums: CRC-32 of each image, by the path of its dataset.
        damaged: rows of our frames that differ from the checksum that the raw file has of them.
    """

    def __init__(self, codec: str, told: _Told) -> None:
        self._codec, self._told = CODECS[codec], told
        self._paths: dict[_Place, str] = {}
        self.checksums: dict[str, list[int]] = {}
        self.damaged = set[int]()

    def group(self, source: h5py.Group, target: h5py.Group) -> None:
        """All that is in a group; what has several names in the raw file has them in the copy."""
        self._paths[_place(source)] = target.name
        _copy_attributes(source, target)
        for name in source:
            link = source.get(name, getlink=True)
            if not isinstance(link, h5py.HardLink):
                target[name] = link
                continue
            item = source[name]
            if (known := self._paths.get(_place(item))) is not None:
                target[name] = target.file[known]
                continue
            self._paths[_place(item)] = f"{target.name.rstrip('/')}/{name}"
            if isinstance(item, h5py.Group):
                self.group(item, target.create_group(name))
            elif _is_stack(item):
                self._stack(item, target, name)
            else:
                source.copy(name, target)

    def _stack(self, source: h5py.Dataset, target: h5py.Group, name: str) -> None:
        made = target.create_dataset(
            name, source.shape, source.dtype, chunks=(1, *source.shape[1:]), maxshape=source.maxshape,
            fillvalue=source.fillvalue, **self._codec,
        )  # fmt: skip
        _copy_attributes(source, made)
        said = _stored_checksums(source)
        checksums = self.checksums[source.name] = []
        for row, image in enumerate(_images(source)):
            made[row] = image
            checksums.append(checksum_of(image))
            if said is not None and not has_checksum(image, int(said[row])):
                self.damaged.add(row)
            self._told.image(image)


def _stored_checksums(stack: h5py.Dataset) -> NDArray[Any] | None:
    """Those that were written with our frames; None of other images."""
    ours = layout.COMMITTED in stack.file and _place(stack) == _place(stack.file[layout.DATA])
    return stack.file["/entry/digest/checksum"][()] if ours else None


def _is_stack(item: h5py.HLObject) -> bool:
    """It holds images, and not those of another dataset of its file."""
    if not isinstance(item, h5py.Dataset) or item.shape is None or item.ndim != 3 or item.dtype.kind not in "iuf":
        return False
    if item.is_virtual:
        return bool(_drawn_from(item))
    return math.prod(item.shape[1:]) * item.dtype.itemsize >= _IMAGE


def _drawn_from(item: h5py.HLObject) -> list[str]:
    """The other files whose values it shows as its own."""
    if not (isinstance(item, h5py.Dataset) and item.is_virtual):
        return []
    return [source.file_name for source in item.virtual_sources() if source.file_name != "."]


def _stacks(raw: h5py.File) -> list[h5py.Dataset]:
    """Every dataset of images, once. DataError where a link leads to another file, which a copy would still need."""
    names: list[str] = []
    raw.visit_links(names.append)  # an error within a visit would end h5py
    found: dict[_Place, h5py.Dataset] = {}
    for name in names:
        link = raw.get(name, getlink=True)
        item = raw[name] if isinstance(link, h5py.HardLink) else None
        if item is not None and _is_stack(item):
            if lost := hdf5.missing_links(item):
                raise DataError(f"{raw.filename} draws its frames from {lost[0]}, which is not there or differs.")
            found[_place(item)] = item
        elif others := [link.filename] if isinstance(link, h5py.ExternalLink) else _drawn_from(item):
            raise DataError(
                f"{raw.filename} draws {name} from {others[0]} by a link; an archive would still need that file. "
                "`beamline ingest` makes one file of both. Nothing was written."
            )
    return [*found.values()]


def _images(stack: h5py.Dataset) -> Iterator[NDArray[Any]]:
    """Each image, in memory that the next one takes."""
    image = np.empty((1, *stack.shape[1:]), stack.dtype)
    for row in range(len(stack)):
        hdf5.read_frames(stack, np.array([row]), slice(None), image)
        yield image[0]


def _require_room(stacks: list[h5py.Dataset], out: Path, codec: str) -> None:
    """DataError where the disk has less than the images are expected to take, going by some of each."""
    wanted = 0.0
    with h5py.File.in_memory() as tried:
        for i, stack in enumerate(stacks):
            rows = np.unique(np.linspace(0, len(stack) - 1, min(len(stack), _SAMPLES)).astype(int))
            kept = tried.create_dataset(
                str(i), (rows.size, *stack.shape[1:]), stack.dtype, chunks=(1, *stack.shape[1:]), **CODECS[codec]
            )
            for k, row in enumerate(rows):
                kept[k] = stack[row]
            wanted += len(stack) * kept.id.get_storage_size() / max(rows.size, 1)
    free = shutil.disk_usage(out.parent).free
    if free < _ROOM * wanted:
        raise DataError(
            f"{out.parent} has {size(free)} free, and about {size(_ROOM * wanted)} are needed. Name a file on another "
            "disk. Nothing was written."
        )


def _forget(path: Path) -> None:
    """Have the system read the file from the disk from now on, not from its memory, where it can be told so."""
    if hasattr(os, "posix_fadvise"):
        with path.open("rb") as file:
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def _differences(raw: h5py.File, file: h5py.File, checksums: Mapping[str, list[int]], told: _Told) -> Iterator[str]:
    """What the two files do not have in common: images by their checksums, other datasets by their values."""
    for path, expected in checksums.items():
        for row, (image, checksum) in enumerate(zip(_images(file[path]), expected, strict=True)):
            told.image(image)
            if checksum_of(image) != checksum:
                yield f"image {row} of {path}"
    names: list[str] = []
    raw.visit(names.append)  # each object once, by one of its names
    for name in ("/", *names):
        item, copied = raw[name], file.get(name)
        if type(item) is not type(copied) or not _same_attributes(item, copied):
            yield name
        elif isinstance(item, h5py.Dataset) and not _is_stack(item) and not item.is_virtual:
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
    return bool((a == b).all()) if a.dtype.hasobject else a.tobytes() == b.tobytes()


def _copy_attributes(source: h5py.HLObject, target: h5py.HLObject) -> None:
    """With their types and shapes as they are."""
    for name in source.attrs:
        given = source.attrs.get_id(name)
        made = h5py.h5a.create(target.id, name.encode(), given.get_type(), given.get_space())
        if given.get_space().get_simple_extent_type() != h5py.h5s.NULL:
            values = np.empty(given.shape, given.dtype)
            given.read(values)
            made.write(values)
