"""StacksSource: a scan with a stack of projections and others of darks and flats, such as HDF5 under any names.

Such a layout does not say when the references were taken: the frames are numbered darks first, then flats, then
projections.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.storage import datasets, hdf5
from beamline.storage.datasets import bytes_unpacked
from beamline.storage.readers.base import WHOLE, Attributes, ScanSource, frame_indices
from drivers.base.frame import FrameKind


class TurnedFrames:
    """A dataset of three dimensions in any order, read as [frame, row, col]."""

    def __init__(self, item: h5py.Dataset, order: tuple[int, int, int]) -> None:
        """`order`: which dimensions of `item` are frames, rows and columns."""
        self.item, self._order = item, order
        self.shape = tuple(item.shape[axis] for axis in order)
        self.dtype, self.ndim, self.name, self.file, self.chunks = item.dtype, 3, item.name, item.file, item.chunks

    @property
    def frame_bytes(self) -> int:
        """Bytes that are decompressed to read a frame."""
        return bytes_unpacked(self.item, self._order[0])

    def __len__(self) -> int:
        return int(self.shape[0])

    def __getitem__(self, wanted: tuple[slice, slice]) -> NDArray[Any]:
        stored = [slice(None)] * 3
        for axis, part in zip(self._order, wanted, strict=False):
            stored[axis] = part
        return np.asarray(self.item[tuple(stored)]).transpose(self._order)


def dimensions(axes: Sequence[str]) -> tuple[int, int, int] | None:
    """Which of three named dimensions are frames, rows and columns; None if the names do not tell.

    x, u or columns; y, v or rows; the third, whatever its name (theta, rotation_angle), are frames.
    """
    names = [axis.strip().lower() for axis in axes]
    cols = [i for i, name in enumerate(names) if name[:1] in ("x", "u") or name.startswith("col")]
    rows = [i for i, name in enumerate(names) if name[:1] == "y" or (name.startswith(("v", "row")) and name != "view")]
    if len(names) != 3 or len(cols) != 1 or len(rows) != 1:
        return None
    return 3 - cols[0] - rows[0], rows[0], cols[0]


USUAL = (0, 1, 2)


def in_order(item: h5py.Dataset, order: tuple[int, int, int]) -> h5py.Dataset | TurnedFrames:
    """A dataset as frames [frame, row, col]."""
    return item if order == USUAL or item.ndim != 3 else TurnedFrames(item, order)


_LISTED = 10  # datasets of a file that an error names


@dataclass(frozen=True)
class FrameStack:
    """Frames of one kind. `frames`: [frame, row, col], a dataset or an array; `name`: for messages."""

    kind: FrameKind
    name: str
    frames: Any


class StacksSource(ScanSource):
    """A scan in stacks; see ScanSource. `finished` is always True: a scan in stacks cannot grow.

    Quantity: "counts" if there are darks and flats, otherwise "unknown".
    """

    def __init__(self, path: Path, file: Any, stacks: Sequence[FrameStack], *, format: str, facts: Attributes) -> None:
        """Take over an open file, or what else is closed with the scan.

        Angles are NaN; `stacks` are in the order of the frames, the projections last.
        """
        self.path, self.format, self.facts = path, format, facts
        self._file, self._stacks = file, stacks
        self._check()
        sizes = [len(stack.frames) for stack in stacks]
        self._starts = np.cumsum([0, *sizes])
        views = stacks[-1].frames
        self.shape = tuple(views.shape[1:])
        self.dtype = np.result_type(*(stack.frames.dtype for stack in stacks))
        self.image_key = np.repeat([stack.kind for stack in stacks], sizes).astype(np.int32)
        self.angles = np.full(self.image_key.size, np.nan)
        self.exposures = np.full(self.image_key.size, np.nan)
        kinds = {stack.kind for stack in stacks}
        self.quantity = "counts" if {FrameKind.DARK, FrameKind.FLAT} <= kinds else "unknown"
        self.in_order = kinds == {FrameKind.PROJECTION}

    def _check(self) -> None:
        views = self._stacks[-1]
        for stack in self._stacks:
            datasets.require_real(stack.frames.dtype, f"{stack.name} in {self.path}")
            if stack.frames.ndim != 3 or stack.frames.shape[1:] != views.frames.shape[1:]:
                shapes = ", ".join(f"{part.name} {part.frames.shape}" for part in self._stacks)
                raise DataError(f"{self.path}: expected frames [frame, row, col] of one shape, found {shapes}.")
            item = stack.frames.item if isinstance(stack.frames, TurnedFrames) else stack.frames
            if isinstance(item, h5py.Dataset):
                datasets.require_possible(stack.frames)
                if lost := datasets.missing_links(item):
                    raise DataError(f"{self.path} draws its frames from {lost[0]}, which is not there or differs.")
        if not len(views.frames):
            raise DataError(f"{self.path} holds no projections: {views.name} has shape {views.frames.shape}.")

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        """Pixels [frame, row, col] of the requested frames, in that order; darks and flats are cast to dtype."""
        indices = frame_indices(frames, self.image_key.size)
        out = np.empty((indices.size, len(range(self.shape[0])[rows]), self.shape[1]), self.dtype)
        for stack, first, last in zip(self._stacks, self._starts[:-1], self._starts[1:], strict=True):
            wanted = np.flatnonzero((indices >= first) & (indices < last))
            if wanted.size:
                part = np.empty((wanted.size, *out.shape[1:]), stack.frames.dtype)
                datasets.read_frames(stack.frames, indices[wanted] - first, rows, part)
                out[wanted] = part
        return out

    @property
    def frame_bytes(self) -> int:
        stored = [stack.frames for stack in self._stacks]
        known = [item.frame_bytes for item in stored if isinstance(item, TurnedFrames)]
        known += [datasets.bytes_unpacked(item) for item in stored if isinstance(item, h5py.Dataset)]
        return max(known, default=super().frame_bytes)

    def close(self) -> None:
        self._file.close()


def open_stacks(path: Path, data: str, darks: str | None, flats: str | None, angles: str | None = None) -> StacksSource:
    """The scan whose datasets have these paths in an HDF5 file. A dark or flat may be a single image [row, col].

    Args:
        data: of the projections; their dimensions may follow it, as in `/images:view,col,row`, and those of darks and
            flats are in the same order.
        angles: of the angles of the projections alone, whose number helps to tell which dimension is that of the views.

    Raises:
        DataError: one is not there, or is no stack of frames; the message names the datasets that the file has.
    """
    file = hdf5.open_hdf5(path)
    with hdf5.closed_on_error(file):
        views, where, order = _named_order(file, data)
        given = ((FrameKind.DARK, darks), (FrameKind.FLAT, flats))
        references = [(kind, name, dataset_at(file, name)) for kind, name in given if name is not None]
        n_angles = None if angles is None else dataset_at(file, angles).size
        order = order or _order_of(views, [item.shape for *_, item in references], n_angles)
        stacks = [FrameStack(kind, name, _frames(item, order)) for kind, name, item in references]
        stacks.append(FrameStack(FrameKind.PROJECTION, where, in_order(views, order)))
        names = [("frame", "row", "col")[order.index(axis)] for axis in USUAL]
        facts = {"data": where, "dimensions": ",".join(names)}
        source = StacksSource(path, file, stacks, format="hdf5_stacks", facts=facts)
        if "pixel_size_h" in views.attrs and isinstance(
            config := datasets.resolve(views.parent.parent, "config"), h5py.Group
        ):
            _take_geometry(source, float(views.attrs["pixel_size_h"]), config)
        return source


def _take_geometry(source: StacksSource, pixel_mm: float, config: h5py.Group) -> None:
    """Take the pixel size, the distances of a cone and where its central ray falls as CIL writes them, taken as mm."""
    source.pixel_size_mm = pixel_mm
    places = [datasets.dataset(config, f"{name}/{what}") for name, what in _CIL]
    if None not in places:
        start, axis, end, across, up = (np.asarray(datasets.values_of(place), np.float64) for place in places)
        normal = np.cross(across, up)
        normal *= np.sign(normal @ (end - start))
        source.cone = float(normal @ (axis - start)), float(normal @ (end - start))
        foot = start + source.cone[1] * normal - end  # from the middle of the detector
        middle = (np.array(source.shape) - 1) / 2
        source.central = tuple((middle + np.array([foot @ up, foot @ across]) / pixel_mm).tolist())


_CIL = (
    ("source", "position"),
    ("rotation_axis", "position"),
    *(("detector", of) for of in ("position", "direction_x", "direction_y")),
)


def _named_order(file: h5py.File, data: str) -> tuple[h5py.Dataset, str, tuple[int, int, int] | None]:
    """The dataset of the projections, its path, and which of its dimensions are frames, rows and columns, if stated."""
    where, colon, names = data.rpartition(":")
    if not colon or datasets.dataset(file, data) is not None:
        return dataset_at(file, data), data, None
    if (order := dimensions(names.split(","))) is None:
        raise DataError(f"The dimensions of {where} are given as {names}; expected three, such as frame,row,col.")
    return dataset_at(file, where), where, order


def _order_of(views: h5py.Dataset, references: list[tuple[int, ...]], n_angles: int | None) -> tuple[int, int, int]:
    """Which dimensions are frames, rows and columns, by the shapes of the references and the number of angles.

    MATLAB's first dimension is the last one here, and an image of its has rows before columns. Its stacks with the
    views in the middle are sinograms, as ASTRA has them, with columns first.
    """
    if views.ndim != 3:
        return USUAL
    images = [(*views.shape[:axis], *views.shape[axis + 1 :]) for axis in USUAL]
    fitting = [
        axis
        for axis in USUAL
        if all(images[axis] in (shape, (*shape[:axis], *shape[axis + 1 :])) for shape in references)
    ]
    frames = next((axis for axis in fitting if views.shape[axis] == n_angles), fitting[0] if fitting else 0)
    rows, cols = (axis for axis in USUAL if axis != frames)
    return (frames, cols, rows) if "MATLAB_class" in views.attrs and frames != 1 else (frames, rows, cols)


def _frames(item: h5py.Dataset, order: tuple[int, int, int]) -> Any:
    """Darks or flats as frames [frame, row, col]; also of one image, which has no dimension of frames."""
    if item.ndim != 2:
        return in_order(item, order)
    image = np.asarray(datasets.values_of(item))
    return (image.T if order[1] > order[2] else image)[None]


def angles_at(path: Path, where: str, unit: str | None) -> NDArray[np.float64]:
    """Angles in radians of the dataset `where` of an HDF5 file, a list or a column.

    Args:
        unit: "deg" or "rad", whatever the file says; None: as it says.

    Raises:
        DataError: it is not there, is no list, or nothing says its unit.
    """
    with hdf5.open_hdf5(path) as file, hdf5.readable(path):
        item = dataset_at(file, where)
        if item.ndim == 0 or item.size != max(item.shape):
            raise DataError(f"{where} in {path} is {item.shape}; expected a list of angles.")
        return datasets.radians(item, unit)


def dataset_at(file: h5py.File, where: str) -> h5py.Dataset:
    """The dataset at a path. If there is none, the DataError lists the datasets of the file."""
    item = datasets.dataset(file, where)
    if item is None:
        datasets.refuse_broken(file, where)
        raise DataError(f"{file.filename} has no dataset {where}. {datasets_text(file)}")
    return item


def datasets_text(file: h5py.File) -> str:
    """A sentence on the datasets of a file and their shapes, the largest first."""
    arrays = list[h5py.Dataset]()
    file.visititems(lambda _, item: arrays.append(item) if isinstance(item, h5py.Dataset) and item.shape else None)
    arrays.sort(key=lambda item: (-item.ndim, -item.size))
    shapes = [f"{item.name} ({' x '.join(map(str, item.shape))})" for item in arrays[:_LISTED]]
    more = f" and {len(arrays) - _LISTED} more" if len(arrays) > _LISTED else ""
    return f"It has {', '.join(shapes)}{more}." if shapes else "It has no arrays."
