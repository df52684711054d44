"""StacksSource: a scan with a stack of projections and others of darks and flats, such as HDF5 under any names.

Such a layout does not say when the references were taken: the frames are numbered darks first, then flats, then
projections.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.storage import datasets, hdf5
from beamline.storage.datasets import bytes_unpacked
from beamline.storage.foreign_zarr import ArrayFile, NamedArray, open_array_file
from beamline.storage.frame_table import FrameTable
from beamline.storage.readers.base import WHOLE, Attributes, ScanSource, frame_indices
from beamline.storage.readers.frames import Frames, Read
from beamline.storage.superblock import marked_as_being_written
from beamline.storage.writers.rows import ScanEnding
from drivers.base.frame import FrameKind

Order = tuple[int | None, int | None, int | None]
"""Which dimensions of an array are frames, rows and columns; None: one of length one that it does not have."""


class TurnedFrames:
    """An array of any dimensions, read as [frame, row, col]. Dimensions that are none of these have length one."""

    def __init__(self, item: Any, order: Order) -> None:
        self.item, self._order = item, order
        self.dtype, self.ndim, self.name, self.file, self.chunks = item.dtype, 3, item.name, item.file, item.chunks

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(1 if axis is None else int(self.item.shape[axis]) for axis in self._order)

    @property
    def frame_bytes(self) -> int:
        """Bytes that are decompressed to read a frame."""
        return bytes_unpacked(self.item, self._order[0])

    def __len__(self) -> int:
        return int(self.shape[0])

    def __getitem__(self, wanted: tuple[slice, ...]) -> NDArray[Any]:
        stored, parts = [slice(None)] * self.item.ndim, (*wanted, WHOLE, WHOLE)[:3]
        for axis, part in zip(self._order, parts, strict=True):
            if axis is not None:
                stored[axis] = part
        values, axes = np.asarray(self.item[tuple(stored)]), [axis for axis in self._order if axis is not None]
        values = values.transpose([*axes, *({*range(values.ndim)} - {*axes})])
        sizes = [1 if axis is None else values.shape[axes.index(axis)] for axis in self._order]
        return values.reshape(sizes)[
            tuple(part if axis is None else WHOLE for axis, part in zip(self._order, parts, strict=True))
        ]


def order_of_axes(axes: Sequence[str]) -> Order | None:
    """Which of two or three named dimensions are frames, rows and columns; None if the names do not tell.

    x, u or columns; y, v or rows; another one, whatever its name (theta, rotation_angle), are frames.
    """
    names = [axis.strip().lower() for axis in axes]
    cols = [i for i, name in enumerate(names) if name[:1] in ("x", "u") or name.startswith("col")]
    rows = [i for i, name in enumerate(names) if name[:1] == "y" or (name.startswith(("v", "row")) and name != "view")]
    frames = [i for i in range(len(names)) if i not in cols + rows]
    if len(names) not in (2, 3) or len(cols) != 1 or len(rows) > 1 or len(frames) > 1:
        return None
    return (*frames, None)[0], (*rows, None)[0], cols[0]


USUAL = (0, 1, 2)
SINOGRAM = (0, None, 1)
"""The order of one sinogram [view, col]."""


def dimensions_without_ones(shape: tuple[int, ...], n: int = 3) -> dict[int, int]:
    """The n dimensions of a shape: place and length. Others, where there are more, have length one: the last one, which
    no column of pixels is, or the first of them."""
    sizes = dict(enumerate(shape))
    while len(sizes) > n and 1 in sizes.values():
        last = max(sizes)
        del sizes[last if sizes[last] == 1 else next(axis for axis, size in sizes.items() if size == 1)]
    return sizes


def as_frames(item: Any, order: Order = USUAL) -> Any:
    """An array as frames [frame, row, col]; also one image, which has no dimension of frames."""
    n = 3 - order.count(None)
    if isinstance(item, h5py.Dataset) and order == USUAL and item.ndim == n:
        return item
    places = [*dimensions_without_ones(item.shape, n)]
    if len(places) == n - 1 and (frames := order[0]) is not None:
        order = (None, *(axis if axis is None else axis - (axis > frames) for axis in order[1:]))  # type: ignore[assignment]
    elif len(places) != n:
        return item
    return TurnedFrames(item, tuple(axis if axis is None else places[axis] for axis in order))  # type: ignore[arg-type]


@dataclass(frozen=True)
class FrameStack:
    """Frames of one kind. `frames`: [frame, row, col], a dataset or an array; `name`: for messages."""

    kind: FrameKind
    name: str
    frames: Any


class StacksSource(ScanSource):
    """A scan in stacks; see ScanSource.

    Quantity: "counts" if there are darks and flats, otherwise "unknown".

    Attributes:
        rows: int64 [frame, 2], the stack of each frame and its place there.
    """

    rows: NDArray[np.int64] = np.zeros((0, 2), np.int64)

    def __init__(self, path: Path, file: Any, stacks: Sequence[FrameStack], *, format: str, facts: Attributes) -> None:
        """Take over an open file, or what else is closed with the scan.

        Angles are NaN; `stacks` are in the order of the frames, the projections last.
        """
        self.path, self.format, self.facts = path, format, facts
        self._file, self._stacks = file, stacks
        self._check()
        self.shape = tuple(stacks[-1].frames.shape[1:])
        self.dtype = np.result_type(*(stack.frames.dtype for stack in stacks))
        self.number_frames([len(stack.frames) for stack in stacks])
        kinds = {stack.kind for stack in stacks}
        self.quantity = "counts" if {FrameKind.DARK, FrameKind.FLAT} <= kinds else "unknown"
        self.in_order = kinds == {FrameKind.PROJECTION}

    def number_frames(self, sizes: Sequence[int]) -> None:
        """Number the frames of stacks of these sizes, new ones after those known so far; angles and exposures become
        NaN."""
        had = np.bincount(self.rows[:, 0], minlength=len(sizes))
        new = [(stack, place) for stack, n in enumerate(sizes) for place in range(had[stack], n)]
        self.rows = np.r_[self.rows, np.array(new, np.int64).reshape(-1, 2)]
        self.table = FrameTable.of(np.array([stack.kind for stack in self._stacks])[self.rows[:, 0]])

    @property
    def finished(self) -> bool:
        return not isinstance(self._file, h5py.File) or not marked_as_being_written(self.path)

    def _check(self) -> None:
        views = self._stacks[-1]
        for stack in self._stacks:
            datasets.require_real(stack.frames.dtype, f"{stack.name} in {self.path}")
            if stack.frames.ndim != 3 or stack.frames.shape[1:] != views.frames.shape[1:]:
                shapes = ", ".join(f"{part.name} {part.frames.shape}" for part in self._stacks)
                raise DataError(
                    f"{self.path}: expected frames [frame, row, col] of one shape, beside dimensions of length one; "
                    f"found {shapes}. --order view,row,col says another order of dimensions."
                )
            item = stack.frames.item if isinstance(stack.frames, TurnedFrames) else stack.frames
            if isinstance(item, h5py.Dataset | NamedArray):
                self.unpack_bytes = max(self.unpack_bytes, datasets.require_possible(stack.frames))
                if lost := datasets.missing_links(item):
                    raise DataError(f"{self.path} draws its frames from {lost[0]}, which is not there or differs.")
        if not len(views.frames):
            none = DataError if self.finished else hdf5.NotReadyError
            raise none(f"{self.path} holds no projections: {views.name} has shape {views.frames.shape}.")

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        """Pixels [frame, row, col] of the requested frames, in that order; darks and flats are cast to dtype."""
        indices = frame_indices(frames, len(self.table))
        out = np.empty((indices.size, len(range(self.shape[0])[rows]), self.shape[1]), self.dtype)
        for number, stack in enumerate(self._stacks):
            wanted = np.flatnonzero(self.rows[indices, 0] == number)
            if wanted.size:
                part = np.empty((wanted.size, *out.shape[1:]), stack.frames.dtype)
                datasets.read_frames(stack.frames, self.rows[indices[wanted], 1], rows, part)
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
    """The scan whose arrays have these paths in an HDF5 file, a Zarr or an .npy. A dark or flat may be a single
    image [row, col].

    Args:
        data: of the projections; their dimensions may follow it, as in `/images:view,col,row`, and those of darks and
            flats are in the same order.
        angles: of the angles of the projections alone, whose number helps to tell which dimension is that of the views.

    Raises:
        DataError: one is not there, or is no stack of frames; the message names the datasets that the file has.
    """
    file = open_array_file(path)
    with hdf5.closed_on_error(file):
        views, where, order = _named_order(file, data)
        given = ((FrameKind.DARK, darks), (FrameKind.FLAT, flats))
        references = [(kind, name, dataset_at(file, name)) for kind, name in given if name is not None]
        n_angles = None if angles is None else dataset_at(file, angles).size
        shapes = [
            tuple(dimensions_without_ones(item.shape).values()) for item in (views, *(item for *_, item in references))
        ]
        order = order or _order_by_shapes(shapes[0], shapes[1:], n_angles, matlab="MATLAB_class" in views.attrs)
        stacks = [FrameStack(kind, name, as_frames(item, order)) for kind, name, item in references]
        stacks.append(FrameStack(FrameKind.PROJECTION, where, as_frames(views, order)))
        names = [("frame", "row", "col")[order.index(axis)] for axis in USUAL if axis in order]
        facts = {"data": where, "dimensions": ",".join(names)}
        stored = isinstance(file, h5py.File)
        source = StacksSource(path, file, stacks, format="hdf5_stacks" if stored else "arrays", facts=facts)
        config = datasets.resolve(views.parent.parent, "config") if stored and "pixel_size_h" in views.attrs else None
        if isinstance(config, h5py.Group):
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
        source.central_ray = tuple((middle + np.array([foot @ up, foot @ across]) / pixel_mm).tolist())


_CIL = (
    ("source", "position"),
    ("rotation_axis", "position"),
    *(("detector", of) for of in ("position", "direction_x", "direction_y")),
)


def open_arrays(path: Path) -> StacksSource:
    """The scan in an .npy or a Zarr with one array of images. DataError: it holds several such, or none."""
    with closing(ArrayFile(path)) as file:
        images = [name for name, item in file.items() if item.ndim > 1]
        if len(images) != 1:
            raise DataError(
                f"{path} holds {len(images)} arrays that may be images. {datasets_text(file)} Name those of the scan: "
                "--data-path, --angles-path, --darks-path, --flats-path."
            )
    return open_stacks(path, images[0], None, None)


def _named_order(file: Any, data: str) -> tuple[Any, str, Order | None]:
    """The dataset of the projections, its path, and which of its dimensions are frames, rows and columns, if stated."""
    where, colon, names = data.rpartition(":")
    if not colon or datasets.dataset(file, data) is not None:
        return dataset_at(file, data), data, None
    return dataset_at(file, where), where, stated_order(names)


def stated_order(names: str) -> Order:
    """The order that a caller states, as in "row,view,col". DataError for another text."""
    if (order := order_of_axes(names.split(","))) is None:
        raise DataError(
            f"The dimensions are given as {names}; expected those of the array, such as frame,row,col, or view,col of "
            "a sinogram."
        )
    return order


def _order_by_shapes(
    views: tuple[int, ...], references: list[tuple[int, ...]], n_angles: int | None, *, matlab: bool
) -> Order:
    """Which dimensions are frames, rows and columns, by the shapes of the references and the number of angles.

    MATLAB's first dimension is the last one here, and an image of its has rows before columns. Its stacks with the
    views in the middle are sinograms, as ASTRA has them, with columns first.
    """
    if len(views) != 3:
        lines = len(views) == 2 and any(shape[-1:] == views[-1:] and shape != views for shape in references)
        return SINOGRAM if lines else USUAL
    images = [(*views[:axis], *views[axis + 1 :]) for axis in USUAL]
    fitting = [
        axis
        for axis in USUAL
        if all(images[axis] in (shape, (*shape[:axis], *shape[axis + 1 :])) for shape in references)
    ]
    frames = next((axis for axis in fitting if views[axis] == n_angles), fitting[0] if fitting else 0)
    rows, cols = (axis for axis in USUAL if axis != frames)
    return (frames, cols, rows) if matlab and frames != 1 else (frames, rows, cols)


def angles_at(path: Path, where: str, unit: str | None, default: str = "") -> NDArray[np.float64]:
    """Angles in radians of the array `where` of an HDF5 file, a Zarr or an .npy, a list or a column.

    Args:
        where: "": the only list whose unit is one of angles, or the only array.
        unit: "deg" or "rad", whatever the file says; None: as it says, or `default` where it says none.

    Raises:
        DataError: it is not there, is no list, or nothing says its unit.
    """
    with closing(open_array_file(path)) as file, hdf5.readable(path):
        if not where and isinstance(file, h5py.File):
            where = _only_angles(file)
        item = dataset_at(file, where)
        if item.ndim == 0 or item.size != max(item.shape):
            raise DataError(f"{item.name} in {path} has the shape {item.shape}; expected a list of angles.")
        return datasets.radians(item, unit, default)


def _only_angles(file: h5py.File) -> str:
    """The path of the only list of a file whose unit is one of angles."""
    names = [
        str(item.name)
        for item in _arrays_of(file)
        if item.ndim == 1 and datasets.factor_of(datasets.attribute(item, "units"), datasets.ANGLE_UNITS)
    ]
    if len(names) != 1:
        raise DataError(
            f"{file.filename} has {len(names)} lists in a unit of angles. {datasets_text(file)} Name the right one: "
            "--angles FILE::DATASET; where it states no unit, also --angles-unit deg or rad."
        )
    return names[0]


def dataset_at(file: Any, where: str) -> Any:
    """The array at a path. If there is none, the DataError lists those of the file."""
    item = datasets.dataset(file, where)
    if item is None:
        datasets.refuse_broken(file, where)
        raise DataError(f"{file.filename} has no dataset {where}. {datasets_text(file)}")
    return item


def datasets_text(file: Any) -> str:
    """A sentence on the datasets of a file and their shapes, the largest first."""
    arrays = sorted(_arrays_of(file), key=lambda item: (-item.ndim, -item.size))
    shapes = [f"{item.name} ({' x '.join(map(str, item.shape))})" for item in arrays[:_LISTED]]
    more = f" and {len(arrays) - _LISTED} more" if len(arrays) > _LISTED else ""
    return f"It has {', '.join(shapes)}{more}." if shapes else "It has no arrays."


_LISTED = 10  # datasets of a file that an error names


def _arrays_of(file: Any) -> list[Any]:
    if isinstance(file, ArrayFile):
        return [*file.values()]
    arrays = list[h5py.Dataset]()
    file.visititems(lambda _, item: arrays.append(item) if isinstance(item, h5py.Dataset) and item.shape else None)
    return arrays


def with_order(base: ScanSource, order: str | None, n_angles: int | None) -> ScanSource:
    """A scan whose images, one after the other, have the dimensions that `order` names, such as "row,view,col".

    Args:
        order: None: the images are views, but for a single one that has as many rows, or columns, as there are angles:
            it is a sinogram.

    Raises:
        DataError: some of the images are darks or flats, or they have other dimensions; or a sinogram is square.
    """
    fits = [axis for axis, n in enumerate(base.shape) if n == n_angles]
    if order is None and (len(base.table) != 1 or n_angles == 1 or not fits):
        return base
    if order is None and len(fits) > 1:
        raise DataError(
            f"{base.path} holds one image of {n_angles} x {n_angles} pixels, a sinogram by its {n_angles} angles: "
            "whether its rows or its columns are the views is not known. Give --order view,col or --order col,view."
        )
    order = order or ("col,view" if fits[0] else "view,col")
    images = as_frames(_ImageStack(base), stated_order(order))
    if not isinstance(images, TurnedFrames) or base.table.views.size < len(base.table):
        raise DataError(
            f"--order {order} does not fit {base.path}, {len(base.table)} images of {base.shape[0]} x "
            f"{base.shape[1]} pixels. It names each dimension, and all images must be of the sample: give darks and "
            "flats with --darks and --flats."
        )

    def pixels(read: Read, frames: slice | ArrayLike, rows: slice) -> NDArray[Any]:
        indices = frame_indices(frames, len(images))
        out = np.empty((indices.size, len(range(images.shape[1])[rows]), images.shape[2]), base.dtype)
        datasets.read_frames(images, indices, rows, out)
        return out

    return Frames(
        base,
        pixels=pixels,
        table=lambda known: FrameTable.of(np.zeros(len(images))),
        shape=images.shape[1:],
        in_order=True,
        ending=ScanEnding(),
        frame_bytes=base.frame_bytes * len(base.table),
        attributes=lambda known: {**known, "dimensions": order},
    )


class _ImageStack:
    """All images of a scan as an array [image, row, col]."""

    def __init__(self, base: ScanSource) -> None:
        self.shape, self.dtype, self.ndim = (len(base.table), *base.shape), base.dtype, 3
        self.name, self.file, self.chunks, self._read = str(base.path), None, None, base.read

    def __getitem__(self, part: tuple[slice, slice, slice]) -> NDArray[Any]:
        return self._read(part[0], part[1])[..., part[2]]
