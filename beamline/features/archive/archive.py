"""archive: a compressed copy of a scan file with the same content; complete and compared, or not at all.

Each frame is a chunk, compressed by itself; everything else is copied unchanged. Frames that the raw file draws from
others (a joined scan) become frames of the archive.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import hdf5plugin
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import whole_file
from beamline.core.text import count, spans
from beamline.monitor.digest import checksum_of, has_checksum
from beamline.storage import datasets, hdf5
from beamline.storage.readers.open import open_scan
from beamline.storage.rules.scan import altered_sentence, parts_joined
from beamline.storage.superblock import superblock
from beamline.storage.writers import layout

_IMAGE = 4096  # bytes from which a row of a dataset [frame, row, col] is an image
_BLOCK = 2**24  # bytes that are compared at once


Progress = Callable[[int, int], None]  # Gets how many of how many MB are done
CountImage = Callable[[NDArray[Any]], None]


def _counter(progress: Progress | None, total: int) -> CountImage:
    """Counts the bytes of images, and tells `progress` how many of how many MB are done."""
    done = 0

    def count_image(image: NDArray[Any]) -> None:
        nonlocal done
        done += image.nbytes
        if progress is not None:
            progress(math.ceil(done / 1e6), math.ceil(total / 1e6))

    return count_image


@dataclass(frozen=True)
class Archived:
    """The written copy, and its comparison with the raw file.

    Attributes:
        sources: the raw file, then the files that it draws frames from; raw_bytes: of all of them.
        damaged: rows whose pixels differ from the checksum that was written with them, in the raw file already.
        altered: rows of the frame log that differ from their checksum in the raw file already.
    """

    path: Path
    frames: int
    sources: tuple[Path, ...]
    raw_bytes: int
    bytes: int
    damaged: tuple[int, ...]
    altered: tuple[int, ...]


def archive(
    scan: Path, out: Path, codec: str = "blosc2", *, keep_damaged: bool = False, progress: Progress | None = None
) -> Archived:
    """Write a compressed copy of an HDF5 scan, read every frame back from the closed file, and compare.

    The raw file is only read. The memory is that of a few frames.

    Args:
        keep_damaged: frames and rows that differ from their stored checksums are copied as they are, with the
            checksums.
        progress: counts the MB of images twice, when they are written and when they are compared.

    Raises:
        DataError: `out` exists; the scan is being written, a part of a joined scan, damaged or no HDF5 scan. The disk
            is full, or what was read back differs. Nothing is left of `out`, and the scan is untouched.
    """
    frames, altered, damage = _frames_of_archivable(scan)
    if altered and not keep_damaged:
        raise DataError(f"{damage} To archive what there is: --keep-damaged. Nothing was written.")
    with whole_file(out) as partial, hdf5.open_hdf5(scan) as raw, hdf5.readable(scan):
        images = _image_datasets(raw)
        count_image = _counter(progress, 2 * sum(image.nbytes for image in images))
        try:
            with hdf5.created(partial, layout.LIBVER) as file:
                copy = _CompressedCopy(codec, count_image, file.require_taken)
                copy.group(raw["/"], file["/"])
                if copy.damaged and not keep_damaged:
                    raise _damaged(scan, copy.damaged)
        except OSError as error:
            raise DataError(f"{out} could not be written ({hdf5.reason(error)}). Nothing is left of it.") from error
        drop_from_cache(partial)
        if differs := _differs(raw, partial, copy.checksums, count_image):
            raise DataError(
                f"{out} does not give back what was written: {differs} differs. The disk, or the memory, is faulty. "
                f"Nothing is left of it, and {scan} is untouched."
            )
        parts = (scan.parent / name for image in images for name in _drawn_from(image))
        sources = tuple(dict.fromkeys((scan, *parts)))
        raw_bytes, compared = sum(path.stat().st_size for path in sources), partial.stat()
    if out.is_symlink() or not _is_compared(out, compared, scan, copy.checksums):
        raise DataError(f"{out} is not the file that was written and compared. Keep {scan}, which is untouched.")
    return Archived(out, frames, sources, raw_bytes, out.stat().st_size, tuple(sorted(copy.damaged)), altered)


def _frames_of_archivable(scan: Path) -> tuple[int, tuple[int, ...], str]:
    """The number of frames, and the altered ones, in words, too; DataError if the scan cannot be archived."""
    if scan.exists() and not (scan.is_file() and hdf5.is_hdf5(scan)):
        raise DataError(f"{scan} is not an HDF5 scan. `beamline ingest` converts it to one. Nothing was written.")
    head = superblock(scan) if scan.is_file() else None
    with open_scan(scan) as source:
        frames, finished, altered = int(source.image_key.size), source.finished, tuple(sorted(source.altered))
        damage, alone = altered_sentence(source) if altered else "", [part.message for part in parts_joined(source)]
    if not finished or (head is not None and head.open_for_writing):
        raise DataError(
            f"{scan} is being written, or its writer died. Let the scan end, or run `beamline recover` first. Nothing "
            "was written."
        )
    if alone:
        raise DataError(f"{scan} is not archived. {alone[0]} Nothing was written.")
    return frames, altered, damage


def _damaged(scan: Path, rows: set[int]) -> DataError:
    return DataError(
        f"{count(len(rows), 'frame')} of {scan} {'differs' if len(rows) == 1 else 'differ'} from what was written, by "
        f"the stored checksum: {spans(sorted(rows))}. Look for a good copy, or archive what there is (--keep-damaged); "
        "`recon` leaves damaged frames out either way. Nothing was written."
    )


def drop_from_cache(path: Path) -> None:
    """Make the system read the file from the disk, not from its cache, if it can be told so."""
    if sys.platform == "linux":
        with path.open("rb") as file:
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def _is_compared(out: Path, compared: os.stat_result, scan: Path, checksums: Mapping[str, list[int]]) -> bool:
    """Whether this is the file that was compared. Where a file system numbers it anew, it is compared again."""
    if os.path.samestat(out.stat(), compared):
        return True
    with hdf5.open_hdf5(scan) as raw, hdf5.readable(scan):
        return not _differs(raw, out, checksums, lambda image: None)


def _differs(raw: h5py.File, path: Path, checksums: Mapping[str, list[int]], count_image: CountImage) -> str:
    """The first difference of the raw file and its copy at this path; "" without one."""
    with hdf5.open_hdf5(path) as file:
        return next(_differences(raw, file, checksums, count_image), "")


def _differences(
    raw: h5py.File, file: h5py.File, checksums: Mapping[str, list[int]], count_image: CountImage
) -> Iterator[str]:
    """The differences of the two files: images by their checksums, other datasets by their values."""
    for path, expected in checksums.items():
        for row, (image, checksum) in enumerate(zip(_images(file[path]), expected, strict=True)):
            count_image(image)
            if checksum_of(image) != checksum:
                yield f"image {row} of {path}"
    names: list[str] = []
    raw.visit(names.append)  # each object once, by one of its names
    for name in ("/", *names):
        item, copied = raw[name], file.get(name)
        if type(item) is not type(copied) or not _same_attributes(item, copied):
            yield name
        elif isinstance(item, h5py.Dataset) and not _is_image_dataset(item) and not item.is_virtual:
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


def filter_of(codec: str) -> Mapping[str, Any]:
    """The keywords of an HDF5 dataset that is compressed by one of these codecs."""
    filters: Mapping[str, Any] = {
        "blosc2": hdf5plugin.Blosc2("zstd", clevel=1, filters=hdf5plugin.Blosc2.BITSHUFFLE),
        "bitshuffle-zstd": hdf5plugin.Bitshuffle(cname="zstd", clevel=3),
        "bitshuffle-lz4": hdf5plugin.Bitshuffle(cname="lz4"),
    }[codec]
    return filters


class _CompressedCopy:
    """Copies a file group by group.

    Args:
        require_taken: is asked after each image; it raises where the disk refuses.

    Attributes:
        checksums: CRC-32 of each image, by the path of its dataset.
        damaged: rows of our frames that differ from the checksum that the raw file has of them.
    """

    def __init__(self, codec: str, count_image: CountImage, require_taken: Callable[[], None]) -> None:
        self._codec, self._count, self._require_taken = filter_of(codec), count_image, require_taken
        self._paths: dict[_Place, str] = {}
        self.checksums: dict[str, list[int]] = {}
        self.damaged = set[int]()

    def group(self, source: h5py.Group, target: h5py.Group) -> None:
        """Copy a group; an object with several names in the raw file keeps them in the copy."""
        self._paths[_place(source)] = target.name
        datasets.copy_attributes(source, target)
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
            elif _is_image_dataset(item):
                self._images(item, target, name)
            else:
                source.copy(name, target)

    def _images(self, source: h5py.Dataset, target: h5py.Group, name: str) -> None:
        made = target.create_dataset(
            name, source.shape, source.dtype, chunks=(1, *source.shape[1:]), maxshape=source.maxshape,
            fillvalue=source.fillvalue, **self._codec,
        )  # fmt: skip
        datasets.copy_attributes(source, made)
        stored = _stored_checksums(source)
        checksums = self.checksums[source.name] = []
        for row, image in enumerate(_images(source)):
            made[row] = image
            self._require_taken()
            checksums.append(checksum_of(image))
            if stored is not None and not has_checksum(image, int(stored[row])):
                self.damaged.add(row)
            self._count(image)


def _image_datasets(raw: h5py.File) -> list[h5py.Dataset]:
    """Every dataset of images, once.

    DataError for content that a copy would lack: values in another file, other than frames, and references between
    objects, which are places in this file.
    """
    names: list[str] = []
    raw.visit_links(names.append)  # an error within a visit would end h5py
    images: dict[_Place, h5py.Dataset] = {}
    for name in ("/", *names):
        link = raw.get(name, getlink=True) if name != "/" else None
        item = raw[name] if link is None or isinstance(link, h5py.HardLink) else None
        if item is not None and _refers(item):
            raise DataError(
                f"{raw.filename}: {name} holds references to other objects of the file, which a copy would not keep. "
                "Keep the raw file. Nothing was written."
            )
        if item is not None and _is_image_dataset(item):
            if lost := datasets.missing_links(item):
                raise DataError(f"{raw.filename} draws its frames from {lost[0]}, which is not there or differs.")
            images[_place(item)] = item
        elif others := [link.filename] if isinstance(link, h5py.ExternalLink) else _kept_in(item):
            raise DataError(
                f"{raw.filename} draws {name} from {others[0]} by a link; an archive would still need that file. "
                "`beamline ingest` makes one file of both. Nothing was written."
            )
    return [*images.values()]


def _is_image_dataset(item: h5py.HLObject) -> bool:
    """Whether it holds images of its own, not those of another dataset of its file."""
    if not isinstance(item, h5py.Dataset) or item.shape is None or item.ndim != 3 or item.dtype.kind not in "iuf":
        return False
    if item.is_virtual:
        return bool(_drawn_from(item))
    wide = math.prod(item.shape[1:]) * item.dtype.itemsize >= _IMAGE
    return wide and len(item) > 0 and item.dtype.itemsize <= 8 and not item.external


def _drawn_from(item: h5py.HLObject) -> list[str]:
    """The other files whose values it shows as its own."""
    if not (isinstance(item, h5py.Dataset) and item.is_virtual):
        return []
    return [source.file_name for source in item.virtual_sources() if source.file_name != "."]


def _kept_in(item: h5py.HLObject | None) -> list[str]:
    """The other files that hold the values of a dataset."""
    raw_files = [str(name) for name, *_ in item.external or ()] if isinstance(item, h5py.Dataset) else []
    return raw_files or ([] if item is None else _drawn_from(item))


def _refers(item: h5py.HLObject) -> bool:
    """An object, or one of its attributes, holds references."""
    dtypes = [item.attrs.get_id(name).dtype for name in item.attrs]
    return any(map(_is_reference, dtypes)) or (isinstance(item, h5py.Dataset) and _is_reference(item.dtype))


def _is_reference(dtype: np.dtype[Any]) -> bool:
    parts = [field[0] for field in dtype.fields.values()] if dtype.fields else []
    parts += [part for part in (h5py.check_vlen_dtype(dtype), dtype.base) if isinstance(part, np.dtype)]
    return h5py.check_ref_dtype(dtype) is not None or any(_is_reference(part) for part in parts if part is not dtype)


def _images(dataset: h5py.Dataset) -> Iterator[NDArray[Any]]:
    """Each image, in memory that the next one takes."""
    image = np.empty((1, *dataset.shape[1:]), dataset.dtype)
    for row in range(len(dataset)):
        datasets.read_frames(dataset, np.array([row]), slice(None), image)
        yield image[0]


def _stored_checksums(dataset: h5py.Dataset) -> NDArray[Any] | None:
    """Those that were written with our frames; None of other images."""
    ours = layout.COMMITTED in dataset.file and _place(dataset) == _place(dataset.file[layout.DATA])
    return dataset.file["/entry/digest/checksum"][()] if ours else None


class _Place(NamedTuple):
    """Of an object in its file."""

    file: int
    address: int


def _place(item: h5py.HLObject) -> _Place:
    info = h5py.h5o.get_info(item.id)
    return _Place(info.fileno, info.addr)
