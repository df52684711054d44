"""Image series: a folder (or .zip) with one image per file, as TIFF, .npy or PNG; or a scene of R²-Gaussian.

The name of a file states its kind, see `image_names`; all files except darks and flats must be one series. They are
sorted by the numbers in their names, never by a directory listing. Files are read one at a time, so that the memory
needed does not grow with the scan. Hidden files (`._0001.tif` of a Mac) are ignored.
"""

from __future__ import annotations

import errno
import io
import json
import math
import os
import re
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tifffile import TiffFile

from beamline.core.errors import DataError
from beamline.core.files import TEXT, decoded, is_below, text_in
from beamline.core.text import count, size, spans
from beamline.storage import hdf5
from beamline.storage.array_file import zarr_root
from beamline.storage.datasets import require_real
from beamline.storage.frame_table import FrameTable
from beamline.storage.hdf5 import UnreadableError
from beamline.storage.packing import packing
from beamline.storage.readers.base import WHOLE, NotUsed, Opening, ScanFormat, ScanSource, frame_indices
from beamline.storage.readers.frames import Frames
from beamline.storage.readers.images.image_names import NamedImages, in_order, places_of
from beamline.storage.readers.images.tiff_stack import TiffStackSource
from beamline.storage.readers.nexus import differing
from beamline.storage.readers.side_files import offered
from beamline.storage.readers.stacks import open_stacks
from beamline.storage.readers.tiff import (
    DECODERS,
    SUFFIXES,
    UNREADABLE,
    image_of,
    images_among,
    is_hidden,
    is_untyped,
    no_image,
    open_tiff,
    refuse_volume,
    stated,
)
from beamline.storage.readers.transforms import in_parts
from beamline.storage.structure import is_blank
from beamline.storage.writers.rows import ScanEnding
from drivers.base.frame import FrameKind

MOST_FILES = 100_000
LARGEST_IMAGE = 2**30  # bytes of an image: 16 000 x 16 000 pixels of 4 bytes
_LOOKED, _REFERENCES = 2**30, 1000  # most bytes, and most darks and flats, that are read to find out their type
_MOST_NUMBERS = 2**20  # largest difference between the last and the first number of a series
_TRIED = 3  # one of this many first images of a series must be readable; then the others are assumed to be readable
_FEW_STACKS = 20  # most files of a folder that may be stacks, because all are open at the same time
_SCALES, _PICTURE = "scaleoffset.json", ".png"
ANGLE_FILE = re.compile(r"(?:^|[^a-z])(angle|theta)[^/]*\.(txt|csv|dat)$|(?:^|/)(angles?|thetas?)\.npy$")


class _StacksError(DataError):
    """A file contains more than one image."""


class TiffSeriesSource(ScanSource):
    """A folder or .zip with one image per file; see ScanSource. Frames: darks, flats, then the series."""

    format = "tiff_series"
    side_files = True

    def __init__(self, path: Path, *, one_series: bool = False, listed: list[str] | None = None) -> None:
        """Open.

        Args:
            one_series: True if all images are one numbered series, whatever kinds the names state.
            listed: names of the images, which are all projections; None: all images in the folder.
        """
        self.path = path
        self._zip = _open_zip(path) if path.is_file() else None
        with hdf5.closed_on_error(self):
            names = self._names() if listed is None else listed
            among = images_among([name for name in names if not ANGLE_FILE.search(name.lower())])
            if not among:
                raise DataError(no_image(path, names))
            images = in_order(path, among, one_series=one_series or listed is not None)
            self.names, self.in_order = images.names, len(images.series) == len(images.names)
            self.table = FrameTable.of(images.kinds, images.angles, numbers=images.numbers)
            references, series = images.references, images.series
            # damage is reported further below
            with suppress(UnreadableError, *UNREADABLE), self._tiff(series[0]) as tif:
                refuse_volume(path, tif)
                self.not_used, self.untyped = stated(path, tif), is_untyped(tif)
            some = references[:: len(references) // _REFERENCES + 1]
            samples = [*self._readable(some), *self._readable(series[:_TRIED], at_least=1)[:1]]
            self.shape = samples[-1][0]
            self.dtype = np.result_type(*(dtype for _, dtype in samples))
            self._texts = [name for name in names if ANGLE_FILE.search(name.lower())]
            self.packing = next((self._text(name) for name in names if name.rpartition("/")[2] == _SCALES), "")
        missing, gaps = _omitted(images)
        self.stated_ending, self.not_used = ScanEnding(missing=missing), self.not_used + offered(self)
        if images.half_turn:
            self.not_used += (NotUsed(images.half_turn[0], count(len(images.half_turn), "image"), _BESIDE, False),)
        self.facts = {"series": f"{series[0]} ... {series[-1]}", "places": places_of(images.names)}
        self.facts |= {"missing_numbers": gaps} if gaps else {}
        if np.isfinite(self.table.angles).any() and len(self._texts) != 1:
            self.facts |= {"angles_from": "the names of the files"}
        if images.doubt:
            self.facts |= {"angles": images.doubt}

    @property
    def angle_text(self) -> tuple[str, str] | None:
        """Name and content of the only file whose name means angles; None if there is no such file. Raises DataError if
        the file is too large.
        """
        return (self._texts[0], self._text(self._texts[0])) if len(self._texts) == 1 else None

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        indices = frame_indices(frames, len(self.table))
        out = np.empty((indices.size, len(range(self.shape[0])[rows]), self.shape[1]), self.dtype)
        for i, number in enumerate(indices):
            name = self.names[number]
            image = self._image(name)
            if image.shape != self.shape:
                raise DataError(
                    f"{name} in {self.path} has the shape {image.shape}; the other frames have the shape {self.shape}."
                )
            if not np.can_cast(image.dtype, self.dtype):
                raise DataError(
                    f"{name} in {self.path} has {image.dtype} pixels, but the frames before it have {self.dtype} "
                    f"pixels, which cannot represent all values of {image.dtype}. Write all images of a scan in one "
                    "pixel type."
                )
            out[i] = image[rows]
        return out

    def close(self) -> None:
        if self._zip is not None:
            self._zip.close()

    def _names(self) -> list[str]:
        if self._zip is not None:
            packed = (name for name in self._zip.namelist() if not name.endswith("/") and "__MACOSX" not in name)
            return [name for name in packed if not is_hidden(name)]
        names, places = list[Path](), set[str]()
        for folder, inner, files in os.walk(self.path, followlinks=True):
            # a link to a folder that was already visited
            inner[:] = [] if (place := os.path.realpath(folder)) in places else inner
            names += [] if place in places else [Path(folder, name) for name in files]
            places.add(place)
            _refuse_more(self.path, len(names) + len(places))
        return [file.relative_to(self.path).as_posix() for file in names if not is_hidden(file.name) and file.is_file()]

    def _bytes(self, name: str, most: int) -> bytes:
        try:
            with self._opened(name, most) as file:
                return file.read(min(most, self._size(name)))
        except UNREADABLE as error:
            raise UnreadableError(f"{name} in {self.path} cannot be read ({hdf5.reason(error)}).") from error

    def _size(self, name: str) -> int:
        return (self.path / name).stat().st_size if self._zip is None else self._zip.getinfo(name).file_size

    def _opened(self, name: str, most: int) -> IO[bytes]:
        """The content of a file of the series, which may have at most `most` bytes."""
        if (n := self._size(name)) > most:
            raise OSError(errno.EFBIG, f"the image has {size(n)}; at most {size(most)} are allowed")
        if self._zip is not None and is_blank(n, self._zip.getinfo(name).compress_size, n):
            raise OSError(errno.EFBIG, f"the file unpacks to {size(n)} of nearly equal values, which is not an image")
        return (self.path / name).open("rb") if self._zip is None else self._zip.open(name)

    @contextmanager
    def _tiff(self, name: str) -> Iterator[TiffFile]:
        """Shape and type of an image. Only the header is read, not the pixels."""
        try:
            with self._opened(name, LARGEST_IMAGE) as file, open_tiff(file) as tif:
                yield tif
        except UNREADABLE as error:
            raise UnreadableError(f"{name} in {self.path} cannot be read ({hdf5.reason(error)}).") from error

    def _readable(self, names: list[str], at_least: int = 0) -> list[tuple[tuple[int, int], np.dtype[Any]]]:
        """Shape and type of the images in these files, from their headers. Raises DataError if fewer than `at_least`
        files can be read.

        If the files have very many bytes, only the first files are read; they are enough to find out the type.
        """
        images, failed, looked = list[tuple[tuple[int, int], np.dtype[Any]]](), list[UnreadableError](), 0
        for name in names:
            if images and looked > _LOOKED:
                break
            looked += self._size(name)
            try:
                if name.lower().endswith(SUFFIXES):
                    with self._tiff(name) as tif:
                        shape, dtype = image_of(tif)
                else:
                    shape, dtype = (image := self._image(name)).shape, image.dtype
                images.append((self._require_grey(name, shape, dtype), dtype))
            except UnreadableError as error:
                failed.append(error)
        if len(images) < at_least:
            raise failed[0]
        return images

    def _text(self, name: str) -> str:
        return _text_of(name, self._bytes(name, TEXT))

    def _image(self, name: str) -> NDArray[Any]:
        content = self._bytes(name, LARGEST_IMAGE)
        try:
            image = DECODERS[name[name.rindex(".") :].lower()](io.BytesIO(content), LARGEST_IMAGE)
        except UNREADABLE as error:
            raise UnreadableError(
                f"{name} in {self.path} cannot be read as an image ({hdf5.reason(error)})."
            ) from error
        while image.ndim > 2 and image.shape[0] == 1:
            image = image[0]
        self._require_grey(name, image.shape, image.dtype)
        return image

    def _require_grey(self, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> tuple[int, int]:
        if not shape or math.prod(shape) == 0:
            raise UnreadableError(
                f"{name} in {self.path} cannot be read as an image, because the file contains no image."
            )
        if len(shape) != 2:
            raise _StacksError(
                f"{name} in {self.path} has the shape {shape}; expected one grey image per file. A folder of at most "
                f"{_FEW_STACKS} files may have a stack of grey images in each. Give a single stack as FILE, with "
                "--darks FILE and --flats FILE."
            )
        require_real(dtype, f"{name} in {self.path}")
        return shape


def _text_of(name: str, content: bytes) -> str:
    """The content of a text file. For an .npy, a text with one number per line."""
    if name.lower().endswith(".npy"):
        return "\n".join(map(str, np.ravel(DECODERS[".npy"](io.BytesIO(content))).tolist()))
    return decoded(content, "replace")  # a comment may be in another alphabet; wrong numbers are reported later


def _open_zip(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except UNREADABLE as error:
        raise DataError(f"{path} cannot be read as a zip file ({hdf5.reason(error)}).") from error


def _refuse_more(path: Path, n: int) -> None:
    if n > MOST_FILES:
        raise DataError(
            f"{path} contains more than {MOST_FILES} files, which is too many for a scan. Give a folder that "
            "contains only the images of the scan."
        )


def _omitted(images: NamedImages) -> tuple[tuple[int, ...], str]:
    """The rows of a scan at which the numbers of a series have gaps, and the missing numbers as text."""
    numbers = images.of_series
    if numbers is None or np.ptp(numbers) >= _MOST_NUMBERS:  # dates and serial numbers do not count images
        return (), ""
    left_out, first = sorted({*range(numbers.min(), numbers.max())} - {*numbers.tolist()}), int(numbers.min())
    before = int((images.kinds == FrameKind.PROJECTION).argmax())
    return tuple(before + number - first for number in left_out), spans(left_out)


_META = "meta_data.json"
_TEST = "projections that the authors of the scene keep as test data; they are left out"
_AXES = (
    "volume[z, y, x] shows the same as vol_gt.transpose(2, 0, 1)[::-1, ::-1]; one unit of length of the scene counts "
    "as 1 mm"
)


def _scene_of(path: Path) -> Path | None:
    """The folder of a scene, from the folder itself or its file meta_data.json; None for any other path."""
    folder = path.parent if path.name == _META else path
    file = folder / _META
    return folder if file.is_file() and '"proj_train"' in text_in(file) else None


def _open_scene(folder: Path) -> ScanSource:
    """The scan in the folder of a scene of R²-Gaussian (Zha et al. 2024, NeurIPS, github.com/Ruyi-Zha/r2_gaussian).

    The scene states no unit of length. One of its units counts as 1 mm, so that densities are those of the scene's
    volume. Projections and angles are used unchanged. In a scene, the first row of a projection has the highest z, and
    the source is at (DSO cos θ, DSO sin θ, 0). `_AXES` states what follows for the axes.

    Raises:
        DataError: projections are missing, or the beam is neither a cone nor parallel.
    """
    meta: dict[str, Any] = json.loads(text_in(folder / _META))
    scanner, angles = meta["scanner"], {str(view["file_path"]): float(view["angle"]) for view in meta["proj_train"]}
    beams = {"cone": (float(scanner["DSO"]), float(scanner["DSD"])), "parallel": None}
    if (mode := scanner["mode"]) not in beams or not angles:
        meta_path = folder / _META
        raise DataError(f"{meta_path} states {len(angles)} views in the mode {mode!r}; expected cone or parallel.")
    if lost := [name for name in angles if not is_below(folder, name)]:
        meta_file = folder / _META
        example = lost[0]
        raise DataError(
            f"{meta_file} lists {len(angles)} projections, but {len(lost)} of the files do not exist, such as "
            f"{example}. Download these files, or remove them from the list. Nothing was read."
        )
    source = TiffSeriesSource(folder, listed=[*angles])
    source.format, source.quantity = "r2_gaussian_scene", "line_integrals"
    source.table = replace(source.table, angles=np.array([angles[name] for name in source.names]))
    source.cone = beams[mode]
    size, n = np.broadcast_to(scanner.get("sDetector", 0), 2), np.broadcast_to(scanner["nDetector"], 2)
    height, width = map(float, np.broadcast_to(scanner.get("dDetector", size / n), 2))
    source.pixel_size_mm, source.row_pitch_mm = width, differing(height, width)
    moved = {name: scanner[name] for name in ("offDetector", "offOrigin") if np.any(scanner.get(name, 0))}
    source.axis_col = None if "offDetector" in moved else (source.shape[1] - 1) / 2
    source.facts = {**source.facts, "axes": _AXES}
    source.not_used += tuple(NotUsed(f"scanner/{name}", str(value), _MOVED, True) for name, value in moved.items())
    if test := meta.get("proj_test"):
        source.not_used += (NotUsed("proj_test", f"{len(test)} views", _TEST, False),)
    return source


_MOVED = "the axis is searched for, and the central ray is assumed at the middle row; --axis sets the axis"
_BESIDE = (
    "a projection 180 degrees from the first, taken after the series. This projection is not used: the axis is "
    "found from the series itself"
)


def _open(path: Path, opening: Opening) -> ScanSource:
    if path.suffix.lower() == _PICTURE and path.is_file():
        return Frames(TiffSeriesSource(path.parent, listed=[path.name]), path=path)
    if (scene := _scene_of(path)) is not None:
        return _open_scene(scene)
    try:
        source = TiffSeriesSource(path, one_series=opening.one_series)
    except _StacksError:
        names = [item.name for item in path.iterdir()] if path.is_dir() else []
        files = images_among([name for name in names if not ANGLE_FILE.search(name.lower())])
        if not 0 < len(files) <= _FEW_STACKS:
            raise
        return _of_stacks(path, in_order(path, files))
    alone = opening.counts and source.in_order and path.is_dir() and not opening.one_series
    return _with_values(_with_references_beside(source) if alone else source)


def _of_stacks(path: Path, images: NamedImages) -> ScanSource:
    """The scan in a folder whose files contain stacks of images. The names of the files state the kinds of the
    frames.
    """
    tiff = images.names[0].lower().endswith(SUFFIXES)
    with ExitStack() as opened:
        files = [
            opened.enter_context(TiffStackSource(path / name) if tiff else open_stacks(path / name, None))
            for name in images.names
        ]
        kinds = np.repeat(images.kinds, [len(file.table) for file in files])
        places = ", ".join(f"{len(file.table)} of {name}" for file, name in zip(files, images.names, strict=True))
        joined = in_parts(files[:-1], files[-1], path)
        opened.pop_all()
    texts = [item for item in path.iterdir() if ANGLE_FILE.search(item.name.lower())]
    of_views = (texts[0].name, _text_of(texts[0].name, texts[0].read_bytes())) if len(texts) == 1 else None
    return Frames(
        joined,
        table=lambda known: replace(known, kinds=kinds),
        in_order=False,
        attributes={"places": places},
        angle_text=of_views,
    )


def _with_references_beside(source: TiffSeriesSource) -> TiffSeriesSource:
    """The scan of the folder above this one, if this folder contains its projections, and other folders contain darks
    or flats.
    """
    with suppress(DataError, OSError):  # the folder above is only a suggestion, and may not contain a scan
        above = TiffSeriesSource(source.path.absolute().parent)
        views = [Path(above.names[i]).parts[0] for i in above.table.views]
        neighbour_folders = sorted({Path(name).parts[0] for name in above.names} - {*views})
        if neighbour_folders and {*views} == {source.path.absolute().name}:
            above.facts = {**above.facts, "beside": ", ".join(neighbour_folders)}
            return above
    return source


def _with_values(source: TiffSeriesSource) -> ScanSource:
    """A series that CIL packed, with its values restored from the scale and the offset in the file that CIL writes next
    to the images.
    """
    attributes = json.loads(source.packing) if source.packing else {}
    values = (
        packing(attributes, source.dtype, f"{_SCALES} in {source.path}", by_cil=True)
        if isinstance(attributes, dict)
        else None
    )
    if values is None:
        return source
    real = np.result_type(source.dtype, np.float32)
    return Frames(source, pixels=lambda read, frames, rows: values(read(frames, rows)), dtype=real)


FORMAT = ScanFormat(
    "a folder or .zip of images (TIFF, .npy or PNG), or a scene of R²-Gaussian",
    lambda path, opening: (
        (path.is_dir() and zarr_root(path) is None)
        or (path.is_file() and path.suffix.lower() in (".zip", _PICTURE) and zarr_root(path) is None)
        or _scene_of(path) is not None
    ),
    _open,
)
