"""Order of dimensions: decides which dimensions of an array are frames, rows and columns, from what the file or the
user states, and from the shapes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.storage import datasets
from beamline.storage.datasets import bytes_unpacked
from beamline.storage.frame_table import FrameTable
from beamline.storage.readers.base import WHOLE, ScanSource, frame_indices
from beamline.storage.readers.frames import Frames, Read
from beamline.storage.writers.rows import ScanEnding

Order = tuple[int | None, int | None, int | None]
"""The numbers of the dimensions that are frames, rows and columns. None: the array does not have this dimension; its
length counts as one.
"""


class TurnedFrames:
    """An array that is read as [frame, row, col], whatever the order of its dimensions is. Additional dimensions must
    have length one.
    """

    def __init__(self, item: Any, order: Order) -> None:
        self.item, self._order = item, order
        self.dtype, self.ndim, self.name, self.file, self.chunks = item.dtype, 3, item.name, item.file, item.chunks

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(1 if axis is None else int(self.item.shape[axis]) for axis in self._order)

    @property
    def frame_bytes(self) -> int:
        """Number of bytes that are decompressed to read a frame."""
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
    """Which of two or three named dimensions are frames, rows and columns; None if this is not clear from the names.

    x, u, columns or horizontal are columns; y, v or rows are rows; any other name (theta, rotation_angle) means frames.
    """
    names = [axis.strip().lower() for axis in axes]
    cols = [i for i, name in enumerate(names) if name[:1] in ("x", "u") or name.startswith(("col", "horizontal"))]
    rows = [i for i, name in enumerate(names) if name[:1] == "y" or (name.startswith(("v", "row")) and name != "view")]
    frames = [i for i in range(len(names)) if i not in cols + rows]
    if len(names) not in (2, 3) or len(cols) != 1 or len(rows) > 1 or len(frames) > 1:
        return None
    return (*frames, None)[0], (*rows, None)[0], cols[0]


def dimensions(order: Order) -> str:
    """The names of an array's dimensions in their order, such as "frame,row,col"."""
    return ",".join(("frame", "row", "col")[order.index(axis)] for axis in USUAL if axis in order)


USUAL = (0, 1, 2)
SINOGRAM = (0, None, 1)
"""The order of one sinogram [view, col]."""


def dimensions_without_ones(shape: tuple[int, ...], n: int = 3) -> dict[int, int]:
    """The lengths of n dimensions of a shape, by their numbers. Surplus dimensions must have length one. If the last
    dimension has length one, it is dropped first; otherwise the first dimension with length one is dropped.
    """
    sizes = dict(enumerate(shape))
    while len(sizes) > n and 1 in sizes.values():
        last = max(sizes)
        del sizes[last if sizes[last] == 1 else next(axis for axis, size in sizes.items() if size == 1)]
    return sizes


def as_frames(item: Any, order: Order = USUAL) -> Any:
    """An array as frames [frame, row, col]. A single image, without a dimension of frames, is accepted, too."""
    n = 3 - order.count(None)
    if isinstance(item, h5py.Dataset) and order == USUAL and item.ndim == n:
        return item
    places = [*dimensions_without_ones(item.shape, n)]
    if len(places) == n - 1 and (frames := order[0]) is not None:
        order = _with_axes({axis: axis - (axis > frames) for axis in USUAL if axis != frames}, order)
    elif len(places) != n:
        return item
    return TurnedFrames(item, _with_axes(dict(enumerate(places)), order))


def _with_axes(new: Mapping[int, int], order: Order) -> Order:
    """The same order with new numbers for the dimensions. Dimensions without a new number are dropped."""
    frames, rows, cols = (None if axis is None else new.get(axis) for axis in order)
    return frames, rows, cols


def stated_order(names: str) -> Order:
    """The order that a caller states, such as "row,view,col". Raises DataError for any other text."""
    if (order := order_of_axes(names.split(","))) is None:
        raise DataError(
            f"The dimensions are given as {names}; expected a name for each dimension of the array, such as "
            "frame,row,col, or view,col for a sinogram."
        )
    return order


def order_by_shapes(
    views: tuple[int, ...], references: list[tuple[int, ...]], n_angles: int | None, *, matlab: bool
) -> Order:
    """Decide which dimensions are frames, rows and columns, from the shapes of darks and flats, and from the number of
    angles.

    MATLAB writes dimensions in reverse order, and the dimension of rows comes before that of columns in its images. If
    the projections are the middle dimension, the stack consists of sinograms, as in ASTRA, with columns first.
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


def with_order(base: ScanSource, order: str | None, n_angles: int | None) -> ScanSource:
    """A scan whose images are stacked to an array with the dimensions in `order`, such as "row,view,col".

    Args:
        order: None: the images are projections, with one exception. If there is only one image, or each image has only
            one row or column, and another dimension is as long as the list of angles, the images are a sinogram.

    Raises:
        DataError: some of the images are darks or flats, the dimensions do not fit, or a sinogram is square.
    """
    sizes, alike = (len(base.table), *base.shape), base.table.are_views.all()
    fits = [axis for axis, n in enumerate(sizes) if n == n_angles]
    counted = base.table.numbers is not None and sizes[0] > 1  # image files of a series are projections
    if order is None and (1 not in sizes or n_angles in (1, sizes[0]) or not fits or not alike or counted):
        return base
    if order is None and len(fits) > 1:
        raise DataError(
            f"Give --order view,col or --order col,view: {base.path} is one image of {n_angles} x "
            f"{n_angles} pixels. Because there are {n_angles} angles it is a sinogram, but either its "
            "rows or its columns may be the projections."
        )
    order = order or ("col,view" if max(sizes[: fits[0]]) > 1 else "view,col")
    images = as_frames(_ImageStack(base), places := stated_order(order))
    if not isinstance(images, TurnedFrames) or not alike:
        n_rows = base.shape[0]
        n_cols = base.shape[1]
        raise DataError(
            f"--order {order} does not fit {base.path}, {len(base.table)} images of {n_rows} x {n_cols} pixels. "
            "--order must name each dimension, and all images must show the sample: give darks and flats with "
            "--darks and --flats."
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
        attributes=lambda known: {**known, "dimensions": dimensions(places)},
    )


class _ImageStack:
    """All images of a scan as an array [image, row, col]."""

    def __init__(self, base: ScanSource) -> None:
        self.shape, self.dtype, self.ndim = (len(base.table), *base.shape), base.dtype, 3
        self.name, self.file, self.chunks, self._read = str(base.path), None, None, base.read

    def __getitem__(self, part: tuple[slice, slice, slice]) -> NDArray[Any]:
        return self._read(part[0], part[1])[..., part[2]]
