"""CompressedCopy: all that is in an HDF5 file once more, its images compressed one by one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.monitor.digest import checksum_of, has_checksum
from beamline.storage import hdf5
from beamline.storage.codecs import filter_of
from beamline.storage.writers import layout

_IMAGE = 4096  # bytes from which a row of a dataset [frame, row, col] is an image

Progress = Callable[[int, int], None]
"""Is told how many of how many MB are done."""


class ImageCounter:
    """Counts the bytes of images, and tells how many of how many MB are done."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._done, self._total = progress, 0, total

    def add(self, image: NDArray[Any]) -> None:
        self._done += image.nbytes
        if self._progress is not None:
            self._progress(math.ceil(self._done / 1e6), math.ceil(self._total / 1e6))


class CompressedCopy:
    """Copies a file group by group.

    Args:
        require_taken: is asked after each image; it raises where the disk refuses.

    Attributes:
        checksums: CRC-32 of each image, by the path of its dataset.
        damaged: rows of our frames that differ from the checksum that the raw file has of them.
    """

    def __init__(self, codec: str, counter: ImageCounter, require_taken: Callable[[], None]) -> None:
        self._codec, self._counter, self._require_taken = filter_of(codec), counter, require_taken
        self._paths: dict[_Place, str] = {}
        self.checksums: dict[str, list[int]] = {}
        self.damaged = set[int]()

    def group(self, source: h5py.Group, target: h5py.Group) -> None:
        """All that is in a group; what has several names in the raw file has them in the copy."""
        self._paths[_place(source)] = target.name
        hdf5.copy_attributes(source, target)
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
            elif is_image_dataset(item):
                self._images(item, target, name)
            else:
                source.copy(name, target)

    def _images(self, source: h5py.Dataset, target: h5py.Group, name: str) -> None:
        made = target.create_dataset(
            name, source.shape, source.dtype, chunks=(1, *source.shape[1:]), maxshape=source.maxshape,
            fillvalue=source.fillvalue, **self._codec,
        )  # fmt: skip
        hdf5.copy_attributes(source, made)
        said = _stored_checksums(source)
        checksums = self.checksums[source.name] = []
        for row, image in enumerate(images(source)):
            made[row] = image
            self._require_taken()
            checksums.append(checksum_of(image))
            if said is not None and not has_checksum(image, int(said[row])):
                self.damaged.add(row)
            self._counter.add(image)


def image_datasets(raw: h5py.File) -> list[h5py.Dataset]:
    """Every dataset of images, once.

    DataError where something would not be in a copy: values in another file, other than frames, and references between
    objects, which are places in this one.
    """
    names: list[str] = []
    raw.visit_links(names.append)  # an error within a visit would end h5py
    found: dict[_Place, h5py.Dataset] = {}
    for name in ("/", *names):
        link = raw.get(name, getlink=True) if name != "/" else None
        item = raw[name] if link is None or isinstance(link, h5py.HardLink) else None
        if item is not None and _refers(item):
            raise DataError(
                f"{raw.filename}: {name} holds references to other objects of the file, which a copy would not keep. "
                "Keep the raw file. Nothing was written."
            )
        if item is not None and is_image_dataset(item):
            if lost := hdf5.missing_links(item):
                raise DataError(f"{raw.filename} draws its frames from {lost[0]}, which is not there or differs.")
            found[_place(item)] = item
        elif others := [link.filename] if isinstance(link, h5py.ExternalLink) else _kept_in(item):
            raise DataError(
                f"{raw.filename} draws {name} from {others[0]} by a link; an archive would still need that file. "
                "`beamline ingest` makes one file of both. Nothing was written."
            )
    return [*found.values()]


def is_image_dataset(item: h5py.HLObject) -> bool:
    """It holds images, and not those of another dataset of its file."""
    if not isinstance(item, h5py.Dataset) or item.shape is None or item.ndim != 3 or item.dtype.kind not in "iuf":
        return False
    if item.is_virtual:
        return bool(drawn_from(item))
    wide = math.prod(item.shape[1:]) * item.dtype.itemsize >= _IMAGE
    return wide and len(item) > 0 and item.dtype.itemsize <= 8 and not item.external


def drawn_from(item: h5py.HLObject) -> list[str]:
    """The other files whose values it shows as its own."""
    if not (isinstance(item, h5py.Dataset) and item.is_virtual):
        return []
    return [source.file_name for source in item.virtual_sources() if source.file_name != "."]


def _kept_in(item: h5py.HLObject | None) -> list[str]:
    """The other files that hold the values of a dataset."""
    raw_files = [str(name) for name, *_ in item.external or ()] if isinstance(item, h5py.Dataset) else []
    return raw_files or ([] if item is None else drawn_from(item))


def _refers(item: h5py.HLObject) -> bool:
    """An object, or one of its attributes, holds references."""
    dtypes = [item.attrs.get_id(name).dtype for name in item.attrs]
    return any(map(_is_reference, dtypes)) or (isinstance(item, h5py.Dataset) and _is_reference(item.dtype))


def _is_reference(dtype: np.dtype[Any]) -> bool:
    parts = [field[0] for field in dtype.fields.values()] if dtype.fields else []
    parts += [part for part in (h5py.check_vlen_dtype(dtype), dtype.base) if isinstance(part, np.dtype)]
    return h5py.check_ref_dtype(dtype) is not None or any(_is_reference(part) for part in parts if part is not dtype)


def images(dataset: h5py.Dataset) -> Iterator[NDArray[Any]]:
    """Each image, in memory that the next one takes."""
    image = np.empty((1, *dataset.shape[1:]), dataset.dtype)
    for row in range(len(dataset)):
        hdf5.read_frames(dataset, np.array([row]), slice(None), image)
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
