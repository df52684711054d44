"""StacksSource: a scan with a stack of projections and separate stacks of darks and flats, such as HDF5 datasets of any
name.

Such a layout does not state when darks and flats were taken: the frames are numbered with darks first, then flats, then
projections.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.storage import datasets, hdf5
from beamline.storage.array_file import ArrayFile, NamedArray, open_array_file
from beamline.storage.frame_table import FrameTable
from beamline.storage.readers.base import (
    WHOLE,
    Attributes,
    NamedArrays,
    Opening,
    ScanFormat,
    ScanSource,
    frame_indices,
)
from beamline.storage.readers.nexus import differing
from beamline.storage.readers.orders import (
    Order,
    TurnedFrames,
    as_frames,
    dimensions,
    dimensions_without_ones,
    order_by_shapes,
    order_of_axes,
    stated_order,
)
from beamline.storage.superblock import marked_as_being_written
from drivers.base.frame import FrameKind
from recon.base.arrays import F64
from recon.base.units import gone_round


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
        rows: int64 [frame, 2], number of the stack that contains the frame, and position of the frame in the stack.
    """

    rows: NDArray[np.int64] = np.zeros((0, 2), np.int64)

    def __init__(self, path: Path, file: Any, stacks: Sequence[FrameStack], *, format: str, facts: Attributes) -> None:
        """Read from stacks. `file` is the open file, or any other object, that is closed together with the scan.

        Angles are NaN. `stacks` are in the order of the frames, with the projections last.
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
        """Number the frames of stacks with these sizes. New frames come after the frames known so far. Angles and
        exposures become NaN.
        """
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
                    f"{self.path}: expected frames [frame, row, col] with equal numbers of rows and columns "
                    f"(dimensions of length one do not count); found {shapes}. If the dimensions have another "
                    "order, state the order, such as --order row,view,col."
                )
            item = stack.frames.item if isinstance(stack.frames, TurnedFrames) else stack.frames
            if isinstance(item, h5py.Dataset | NamedArray):
                self.unpack_bytes = max(self.unpack_bytes, datasets.require_possible(stack.frames))
                if lost := datasets.missing_links(item):
                    linked_file = lost[0]
                    raise DataError(
                        f"{self.path} refers to frames in {linked_file}, which does not exist or has another shape."
                    )
        if not len(views.frames):
            none = DataError if self.finished else hdf5.NotReadyError
            raise none(f"{self.path} contains no projections: {views.name} has shape {views.frames.shape}.")

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


def open_stacks(
    path: Path, data: str | None, darks: str | None = None, flats: str | None = None, angles: str | None = None
) -> StacksSource:
    """Open the scan whose arrays have these paths in an HDF5 file, a Zarr or an .npy. A dark or flat may be a single
    image [row, col].

    Args:
        data: path of the projections; None: the only array of images. The order of the dimensions may follow the path,
            as in `/images:view,col,row`. Darks and flats have the same order.
        angles: path of the angles of the projections. Their number helps to decide which dimension counts the
            projections.

    Raises:
        DataError: an array does not exist or is not a stack of frames. The message lists the datasets in the file.
    """
    file = open_array_file(path)
    with hdf5.closed_on_error(file):
        views, where, order = _named_order(file, _only_images(file) if data is None else data)
        given = ((FrameKind.DARK, darks), (FrameKind.FLAT, flats))
        references = [(kind, name, dataset_at(file, name)) for kind, name in given if name is not None]
        n_angles = None if angles is None else dataset_at(file, angles).size
        shapes = [
            tuple(dimensions_without_ones(item.shape).values()) for item in (views, *(item for *_, item in references))
        ]
        order = order or order_by_shapes(shapes[0], shapes[1:], n_angles, matlab="MATLAB_class" in views.attrs)
        stacks = [FrameStack(kind, name, as_frames(item, order)) for kind, name, item in references]
        stacks.append(FrameStack(FrameKind.PROJECTION, where, as_frames(views, order)))
        facts = {"data": where, "dimensions": dimensions(order)}
        stored = isinstance(file, h5py.File)
        source = StacksSource(path, file, stacks, format="hdf5_stacks" if stored else "arrays", facts=facts)
        lists = [item.name for item in arrays_of(file) if item.ndim == 1 and item.size == len(stacks[-1].frames)]
        if lists and angles is None:
            source.facts = {**facts, "angles": f"--angles-path {lists[0]} uses those of {', '.join(lists[:_LISTED])}"}
        if isinstance(file, ArrayFile) and angles is None:
            _take_angles(source, [file[name] for name in lists if _ANGLES.search(name)])
        _take_geometry(source, views)
        return source


def _take_angles(source: StacksSource, lists: list[NamedArray]) -> None:
    """Use the only list whose name means angles. Its unit is the one that it states, or the unit with which it covers
    180 or 360 degrees.
    """
    if len(lists) != 1:
        return
    item, values, turns = lists[0], np.unique(lists[0][...]), {"rad": 2 * np.pi, "deg": 360.0}
    unit = item.attrs.get("units") or next((unit for unit, turn in turns.items() if gone_round(values, turn)), "")
    if unit:
        source.table.angles[source.table.views] = datasets.radians(item, default=unit)
        source.facts = {**source.facts, "angles_from": f"{item.name}, in {unit}"}


_ANGLES = re.compile("angle|theta", re.IGNORECASE)


def _take_geometry(source: StacksSource, views: Any) -> None:
    """Use the geometry that CIL stores next to `views`, the dataset of the projections. Lengths are in mm.

    In CIL, the angles rotate the object counter-clockwise about the axis, which is the same as a rotation of the beam
    by the negative angles (CIL's `convert_geometry_to_astra_vec_3D`). Here a projection is rotated by θ in the frame of
    the detector: columns, beam, rows.
    """
    config = datasets.resolve(views.parent.parent, "config") if isinstance(views, h5py.Dataset) else None
    if not isinstance(config, h5py.Group) or "pixel_size_h" not in views.attrs:
        return
    source.pixel_size_mm, height = (float(views.attrs.get(f"pixel_size_{side}", np.nan)) for side in "hv")
    source.row_pitch_mm = differing(height if np.isfinite(height) else None, source.pixel_size_mm)
    pitch = np.array([source.row_pitch_mm or source.pixel_size_mm, source.pixel_size_mm])
    across, up, beam = _frame(config)
    end, axis = (_vector(config, f"{name}/position", (0, 0, 0)) for name in ("detector", "rotation_axis"))
    middle, plane = (np.array(source.shape) - 1) / 2, np.array([up, across])
    if datasets.dataset(config, "source/position") is not None:
        start, normal = _vector(config, "source/position", (0, 0, 0)), np.cross(across, up)
        normal *= np.sign(normal @ beam)
        source.cone = float(normal @ (axis - start)), float(normal @ (end - start))
        foot = start + source.cone[1] * normal  # pixel that the central ray meets
        source.central_ray = tuple((middle + plane @ (foot - end) / pitch).tolist())
        axis = start + (axis - start) * source.cone[1] / source.cone[0]
    source.axis_col = float((middle + plane @ (axis - end) / pitch)[1])
    angles = datasets.dataset(config, "angles")
    if angles is not None and angles.size == len(source.table):
        source.table = replace(source.table, angles=in_frame_of_detector(angles, datasets.radians(angles), ""))


def in_frame_of_detector(item: Any, angles: F64, unit: str | None) -> F64:
    """Angles of projections in radians, relative to the detector. CIL states the angles of the object; they are
    converted. All other angles are returned unchanged.

    Args:
        angles: the values of `item` in radians.
        unit: unit of the angles that the caller states instead of the file.
    """
    config = item.parent if isinstance(item, h5py.Dataset) else None
    if config is None or datasets.dataset(config, "detector/direction_x") is None:
        return angles
    across, up, beam = _frame(config)
    sense = -np.sign(np.linalg.det([across, beam, up]) * (_vector(config, "rotation_axis/direction", (0, 0, 1)) @ up))
    factor = datasets.factor_of(unit or datasets.attribute(item, "angle_unit"), datasets.ANGLE_UNITS) or 0.0
    return np.asarray(sense * (angles + float(item.attrs.get("initial_angle", 0)) * factor)) + 0.0  # avoids -0


def _frame(config: h5py.Group) -> tuple[F64, F64, F64]:
    """The directions (x, y, z) in which column numbers and row numbers increase, and the direction of the beam."""
    origin = datasets.attribute(datasets.resolve(config.parent, "data/data") or config, "panel_origin")
    across = _vector(config, "detector/direction_x", (1, 0, 0)) * (-1 if "right" in origin else 1)
    up = _vector(config, "detector/direction_y", (0, 0, 1)) * (-1 if "top" in origin else 1)
    if datasets.dataset(config, "source/position") is None:
        return across, up, _vector(config, "ray/direction", (0, 1, 0))
    end, start = (_vector(config, f"{name}/position", (0, 0, 0)) for name in ("detector", "source"))
    return across, up, end - start


def _vector(config: h5py.Group, where: str, default: tuple[float, ...]) -> F64:
    """A vector (x, y, z) of the geometry. If only two components are stated, z is 0."""
    item = datasets.dataset(config, where)
    values = np.ravel(default if item is None else datasets.values_of(item)).astype(np.float64)
    return np.pad(values[:3], (0, 3 - min(values.size, 3)))


def _only_images(file: ArrayFile) -> str:
    """The name of the only array that may contain images. Raises DataError if there are several such arrays, or
    none.
    """
    images = [name for name, item in file.items() if item.ndim > 1]
    if len(images) != 1:
        raise DataError(
            f"{file.filename} contains {len(images)} arrays that may be images. {datasets_text(file)} Name the "
            "datasets of the scan: --data-path, --angles-path, --darks-path, --flats-path."
        )
    return images[0]


def _named_order(file: Any, data: str) -> tuple[Any, str, Order | None]:
    """The dataset of the projections, its path, and the order of its dimensions (frames, rows, columns) if stated."""
    where, colon, names = data.rpartition(":")
    if colon and datasets.dataset(file, data) is None:
        return dataset_at(file, where), where, stated_order(names)
    item = dataset_at(file, data)
    return item, data, order_of_axes([datasets.text(item.attrs.get(f"dim{axis}", "")) for axis in range(item.ndim)])


def dataset_at(file: Any, where: str) -> Any:
    """The array at a path. If there is no array, the DataError lists the arrays of the file."""
    item = datasets.dataset(file, where)
    if item is None:
        datasets.refuse_broken(file, where)
        raise DataError(f"{file.filename} has no dataset {where}. {datasets_text(file)}")
    return item


def datasets_text(file: Any) -> str:
    """A sentence that lists the datasets of a file with their shapes, the largest first."""
    arrays = sorted(arrays_of(file), key=lambda item: (-item.ndim, -item.size))
    shapes = [f"{item.name} ({' x '.join(map(str, item.shape))})" for item in arrays[:_LISTED]]
    more = f" and {len(arrays) - _LISTED} more" if len(arrays) > _LISTED else ""
    return f"It has {', '.join(shapes)}{more}." if shapes else "It has no arrays."


_LISTED = 10  # most datasets that an error names


def arrays_of(file: Any) -> list[Any]:
    if isinstance(file, ArrayFile):
        return [*file.values()]
    arrays = list[h5py.Dataset]()
    file.visititems(lambda _, item: arrays.append(item) if isinstance(item, h5py.Dataset) and item.shape else None)
    return arrays


_CIL = "entry1/tomo_entry/data/data"


def _recognises(path: Path, opening: Opening) -> bool:
    if not (path.is_file() and hdf5.is_hdf5(path)):
        return False
    with closing(hdf5.open_hdf5(path, opening.follow)) as file:
        data = datasets.resolve(file, _CIL)
        return isinstance(data, h5py.Dataset) and datasets.attribute(data, "data_type") == "AcquisitionData"


def _scan_of_arrays(path: Path, arrays: NamedArrays) -> StacksSource:
    return open_stacks(path, arrays.data, arrays.darks, arrays.flats, arrays.angles)


FORMAT = ScanFormat("a scan of CIL", _recognises, lambda path, opening: open_stacks(path, _CIL), _scan_of_arrays)
