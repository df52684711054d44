"""A compressed copy of a scan file with the same content; complete and compared, or not at all.

Each frame is a chunk, compressed by itself; everything else is copied unchanged. Frames that the raw file draws from
others (a joined scan) become frames of the archive.
"""

from __future__ import annotations

import math
import os
import sys
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np

from beamline.core.errors import DataError
from beamline.core.files import whole_file
from beamline.storage.datasets import copy_attributes, missing_links
from beamline.storage.hdf5 import created, is_hdf5, open_hdf5, readable, reason
from beamline.storage.readers.open import open_scan
from beamline.storage.writers.layout import LIBVER

_IMAGE = 4096  # bytes from which a row of a dataset [frame, row, col] is an image
_FILTERS: Mapping[str, Mapping[str, Any]] = {
    "blosc2": hdf5plugin.Blosc2("zstd", clevel=1, filters=hdf5plugin.Blosc2.BITSHUFFLE),
    "bitshuffle-zstd": hdf5plugin.Bitshuffle(cname="zstd", clevel=3),
    "bitshuffle-lz4": hdf5plugin.Bitshuffle(cname="lz4"),
}


@dataclass(frozen=True)
class Archived:
    """The written copy. `sources`: the raw file, then those that it draws frames from; `raw_bytes`: of all of them."""

    path: Path
    frames: int
    sources: tuple[Path, ...]
    raw_bytes: int
    bytes: int


def archive(
    scan: Path, out: Path, codec: str = "blosc2", progress: Callable[[int, int], object] = lambda mb, of: None
) -> Archived:
    """Write a compressed copy of an HDF5 scan, read every frame back from the closed file, and compare.

    The raw file is only read. The memory is that of a few frames.

    Args:
        progress: gets how many of how many MB of images are done, first written, then compared.

    Raises:
        DataError: `out` exists; the scan is being written or no HDF5 scan; a copy would lack what it draws from other
            files. The disk is full, or what was read back differs. Nothing is left of `out`, the scan is untouched.
    """
    if scan.exists() and not (scan.is_file() and is_hdf5(scan)):
        raise DataError(f"{scan} is not an HDF5 scan. `beamline ingest` converts it to one. Nothing was written.")
    with open_scan(scan) as source:
        if not source.finished:
            raise DataError(
                f"{scan} is being written. Let the scan end, or run `beamline recover`. Nothing was written."
            )
        frames = int(source.image_key.size)
    with whole_file(out) as partial, open_hdf5(scan) as raw, readable(scan):
        copy = _CompressedCopy(codec, 2 * _image_bytes(raw["/"]), progress)
        try:
            with created(partial, LIBVER) as file:
                copy.group(raw["/"], file["/"])
        except OSError as error:
            raise DataError(f"{out} could not be written ({reason(error)}). Nothing is left of it.") from error
        drop_from_cache(partial)
        with open_hdf5(partial) as file:
            if differs := next(copy.differences(raw, file), ""):
                raise DataError(
                    f"{out} does not give back what was written: {differs} differs. The disk, or the memory, is "
                    f"faulty. Nothing is left of it, and {scan} is untouched."
                )
        sources = (
            scan,
            *dict.fromkeys(scan.parent / name for path in copy.checksums for name in _other_files(raw[path])),
        )
    return Archived(out, frames, sources, sum(path.stat().st_size for path in sources), out.stat().st_size)


def drop_from_cache(path: Path) -> None:
    """Make the system read the file from the disk, not from its cache, if that is possible."""
    if sys.platform == "linux":
        with path.open("rb") as file:
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


class _CompressedCopy:
    """Copies a file group by group, then compares. `checksums`: CRC-32 of each image, by the path of its dataset."""

    def __init__(self, codec: str, total: int, progress: Callable[[int, int], object]) -> None:
        self._codec, self._total, self._progress, self._done = codec, total, progress, 0
        self._paths: dict[int, str] = {}  # by address in the raw file
        self.checksums: dict[str, list[int]] = {}

    def group(self, source: h5py.Group, target: h5py.Group) -> None:
        """Copy a group; an object with several names in the raw file keeps them in the copy."""
        self._paths[_address(source)] = target.name
        _refuse_references(source)
        copy_attributes(source, target)
        for name in source:
            link, path = source.get(name, getlink=True), f"{target.name.rstrip('/')}/{name}"
            if not isinstance(link, h5py.HardLink):
                if isinstance(link, h5py.ExternalLink):
                    raise _drawn(source.file, path, link.filename)
                target[name] = link
                continue
            item = source[name]
            known = self._paths.setdefault(_address(item), path)
            if known != path:
                target[name] = target.file[known]
            elif isinstance(item, h5py.Group):
                self.group(item, target.create_group(name))
            else:
                self._dataset(item, target, name)

    def _dataset(self, source: h5py.Dataset, target: h5py.Group, name: str) -> None:
        _refuse_references(source)
        if not _is_image_dataset(source):
            if others := [str(file) for file, *_ in source.external or ()] or _other_files(source):
                raise _drawn(source.file, source.name, others[0])
            source.parent.copy(source, target, name)
            return
        if lost := missing_links(source):
            raise DataError(f"{source.file.filename} draws its frames from {lost[0]}, which is not there or differs.")
        made = target.create_dataset(
            name, source.shape, source.dtype, chunks=(1, *source.shape[1:]), maxshape=source.maxshape,
            fillvalue=source.fillvalue, **_FILTERS[self._codec],
        )  # fmt: skip
        copy_attributes(source, made)
        checksums = self.checksums[made.name] = []
        for row in range(len(source)):
            image = source[row]
            made[row] = image
            checksums.append(self._checksum_of(image))

    def differences(self, raw: h5py.File, file: h5py.File) -> Iterator[str]:
        """The differences of the two files: images by their checksums, other datasets by their values."""
        for path, expected in self.checksums.items():
            for row, checksum in enumerate(expected):
                if self._checksum_of(file[path][row]) != checksum:
                    yield f"image {row} of {path}"
        names, images = list[str](), {path.lstrip("/") for path in self.checksums}
        raw.visit(names.append)  # each object once, by one of its names
        for name in ("/", *names):
            item, copied = raw[name], file.get(name)
            same = type(item) is type(copied) and _same(dict(item.attrs), dict(copied.attrs))
            if same and isinstance(item, h5py.Dataset) and name not in images:
                same = _same(item[()], copied[()])
            if not same:
                yield name

    def _checksum_of(self, image: Any) -> int:
        self._done += image.nbytes
        self._progress(math.ceil(self._done / 1e6), math.ceil(self._total / 1e6))
        return zlib.crc32(np.ascontiguousarray(image).data)


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_same(one[key], other[key]) for key in one)
    if isinstance(one, h5py.Empty):
        return bool(one == other)
    a, b = np.asarray(one), np.asarray(other)
    if (a.dtype, a.shape) != (b.dtype, b.shape):
        return False
    if not a.dtype.hasobject:
        return a.tobytes() == b.tobytes()
    return bool(one == other) if not a.ndim else all(map(_same, a.ravel(), b.ravel()))


def _image_bytes(raw: h5py.Group) -> int:
    sizes: list[int] = []
    raw.visititems(lambda name, item: sizes.append(item.nbytes) if _is_image_dataset(item) else None)
    return sum(sizes)


def _is_image_dataset(item: h5py.HLObject) -> bool:
    """Whether the dataset holds images itself, not those of another dataset of its file."""
    if not isinstance(item, h5py.Dataset) or item.shape is None or item.ndim != 3 or item.dtype.kind not in "iuf":
        return False
    if item.is_virtual:
        return bool(_other_files(item))
    wide = math.prod(item.shape[1:]) * item.dtype.itemsize >= _IMAGE
    return wide and len(item) > 0 and item.dtype.itemsize <= 8 and not item.external


def _other_files(item: h5py.Dataset) -> list[str]:
    """The other files whose values a virtual dataset shows as its own."""
    return [source.file_name for source in item.virtual_sources() if source.file_name != "."] if item.is_virtual else []


def _drawn(raw: h5py.File, name: str, other: str) -> DataError:
    return DataError(
        f"{raw.filename} draws {name} from {other}; an archive would still need that file. `beamline ingest` makes one "
        "file of both. Nothing was written."
    )


def _refuse_references(item: h5py.HLObject) -> None:
    """References are addresses, which a copy does not keep."""
    dtypes = [item.attrs.get_id(name).dtype for name in item.attrs]
    dtypes += [item.dtype] if isinstance(item, h5py.Dataset) else []
    if any(map(_is_reference, dtypes)):
        raise DataError(
            f"{item.file.filename}: {item.name} holds references to other objects of the file, which a copy would not "
            "keep. Keep the raw file. Nothing was written."
        )


def _is_reference(dtype: np.dtype[Any]) -> bool:
    parts = [field[0] for field in dtype.fields.values()] if dtype.fields else []
    parts += [part for part in (h5py.check_vlen_dtype(dtype), dtype.base) if isinstance(part, np.dtype)]
    return h5py.check_ref_dtype(dtype) is not None or any(_is_reference(part) for part in parts if part is not dtype)


def _address(item: h5py.HLObject) -> int:
    return int(h5py.h5o.get_info(item.id).addr)
