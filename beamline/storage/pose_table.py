"""PoseTable: displacement, roll and tilt of each view from a CSV or a volume, or its vectors from an .npz."""

from __future__ import annotations

import csv
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from beamline.core.errors import DataError
from beamline.core.files import text_in, write_whole
from beamline.core.text import csv_text
from beamline.storage import hdf5
from beamline.storage.recon_record import ReconRecord
from beamline.storage.writers.recon_file import opened_reconstruction
from recon.base.arrays import F64
from recon.base.vectors import geometry_of_vectors

Key = Literal["frame", "view", "angle_deg"]
IGNORE = "ignore"  # In place of a file: views count as not displaced, whatever their scan file says
_KEYS: tuple[Key, ...] = "frame", "view", "angle_deg"
_PIXELS = "shift_col_px", "shift_row_px"
_TURNS = "roll_deg", "tilt_deg"
_FOR_PEOPLE = "shift_col_mm", "shift_row_mm"
_ARRAYS = {"parallel3d_vec": False, "cone_vec": True}  # arrays of vectors, and whether they are of a cone
_STEEPEST = 85.0  # degrees of tilt
_LARGEST = 64 * 2**20  # bytes of a CSV


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Poses of some views, in unbinned pixels.

    Attributes:
        path: of the file.
        by: what `keys` are: rows of the scan file, views counted from 0 in its order, or angles in degrees.
        keys: float64 [row], all different.
        angles_deg: float64 [row] of the views, to be compared with the scan's; None where the file has none.
        shifts: float64 [row, 2], displacement of the image along (columns, rows), in pixels.
        turns_deg: float64 [row, 2], roll and tilt, as of `recon.base.geometry.Geometry`.
        axis_col: of the volume that the poses are of, in columns of the whole detector; None: not known.
        vectors: float64 [row, 12] in mm, as of `recon.base.vectors`, which state all of the geometry; None: no such.
        cone: the vectors are of a cone.
    """

    path: Path
    by: Key
    keys: F64
    angles_deg: F64 | None
    shifts: F64
    turns_deg: F64
    axis_col: float | None = None
    vectors: F64 | None = None
    cone: bool = False

    @property
    def leans(self) -> bool:
        """Whether a row of a view may show several slices, because the view is rolled or tilted."""
        return self.vectors is not None or bool(self.turns_deg.any())

    def __str__(self) -> str:
        return str(self.path)

    def __post_init__(self) -> None:
        ordered, counts = np.unique(self.keys, return_counts=True)
        if (counts > 1).any():
            raise ValueError(f"{self.path}: {self.by} {ordered[counts > 1][0]:g} has {counts.max()} rows; expected one")
        if (steep := np.abs(self.turns_deg) > (180.0, _STEEPEST)).any():
            row = int(np.flatnonzero(steep.any(axis=1))[0])
            roll, tilt = self.turns_deg[row]
            raise ValueError(
                f"{self.path}: {self.by} {self.keys[row]:g} has a roll of {roll:g} and a tilt of {tilt:g} degrees; "
                f"expected at most 180 and {_STEEPEST:g}"
            )


def read_poses(text: str) -> PoseTable:
    """The table in the file `text`; an empty one for `ignore`.

    Raises:
        ValueError: the file cannot be read as poses; the message says why.
    """
    path = Path(text)
    if text == IGNORE:
        return PoseTable(path, "view", np.empty(0), None, np.empty((0, 2)), np.empty((0, 2)))
    try:
        if hdf5.is_hdf5(path):
            with opened_reconstruction(path) as record:
                return _of_volume(path, record)
        return _of_arrays(path) if zipfile.is_zipfile(path) else _of_csv(path, text_in(path, _LARGEST))
    except (OSError, DataError) as error:
        raise ValueError(f"{path} cannot be read ({hdf5.reason(error)})") from error


def _of_csv(path: Path, content: str) -> PoseTable:
    lines = [line for line in content.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    head, *rows = list(csv.reader(lines)) or [[]]
    names, poses = [name.strip().lower() for name in head], (*_PIXELS, *_TURNS)
    if not set(names) & set(_KEYS) or not set(names) & set(poses):
        raise ValueError(
            f"{path}: the first line is {','.join(names)!r}; expected a header with view, frame or angle_deg and with "
            f"some of {', '.join(poses)}"
        )
    for name in names:
        if name not in (*_KEYS, *poses, *_FOR_PEOPLE) or names.count(name) > 1:
            raise ValueError(
                f"{path}: column {name!r} is unknown or there twice; known: {', '.join((*_KEYS, *poses, *_FOR_PEOPLE))}"
            )
    values = np.empty((len(rows), len(names)))
    for number, row in enumerate(rows):
        try:
            values[number] = [float(cell) for _, cell in zip(names, row, strict=True)]
        except ValueError:
            raise ValueError(f"{path}: {','.join(row)!r} are not {len(names)} numbers") from None
    if not rows or not np.isfinite(values).all():
        raise ValueError(f"{path} has {len(rows)} rows of poses; expected finite numbers in one for each view")
    columns = dict(zip(names, values.T, strict=True))
    by = next(name for name in _KEYS if name in columns)
    keys, none = columns[by], np.zeros(len(rows))
    if by != "angle_deg" and (bad := keys != np.abs(np.round(keys))).any():
        raise ValueError(f"{path}: {by} holds {keys[bad][:3].tolist()}; expected whole numbers from 0 on")
    shifts, turns = (np.stack([columns.get(name, none) for name in part], axis=1) for part in (_PIXELS, _TURNS))
    return PoseTable(path, by, keys, columns.get("angle_deg"), shifts, turns)


def _of_arrays(path: Path) -> PoseTable:
    """Vectors of all views, in an .npz under the name that ASTRA has for their kind."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            read, names = {name: arrays[name] for name in arrays.files if name in _ARRAYS}, arrays.files
        if len(read) != 1:
            raise ValueError(f"it holds {', '.join(names)}; expected one of {' and '.join(_ARRAYS)}")
        ((name, vectors),) = read.items()
        if vectors.dtype.kind not in "iuf" or vectors.ndim != 2:
            raise ValueError(f"{name} is {vectors.dtype} of shape {vectors.shape}; expected numbers [view, 12]")
        views = geometry_of_vectors(vectors.astype(np.float64), (1, 1), cone=_ARRAYS[name])
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path}: {error}") from error
    n, turns = len(vectors), np.degrees(np.stack((views.roll, views.tilt), axis=1))
    return PoseTable(
        path, "view", np.arange(n, dtype=np.float64), None, np.zeros((n, 2)), turns,
        vectors=vectors.astype(np.float64), cone=_ARRAYS[name],
    )  # fmt: skip


def _of_volume(path: Path, record: ReconRecord) -> PoseTable:
    parameters = record.parameters
    frames, angles = (
        np.atleast_1d(np.asarray(parameters.get(name, ()), np.float64)) for name in ("view_frames", "view_angles_deg")
    )
    if not any(name in parameters for name in POSES_KEPT) or not frames.size:
        raise ValueError(f"{path} holds no poses: its views were taken as straight and not displaced")
    if CENTRES_KEPT in parameters:
        raise ValueError(f"{path} was made with vectors of each view, but does not hold them: give their file")
    none, binning = np.zeros(frames.size), int(parameters.get("binning", 1))
    shifts = np.asarray(parameters.get("view_shifts_px", np.zeros((frames.size, 2))), np.float64) * binning
    turns = np.stack([np.asarray(parameters.get(name, none), np.float64) for name in POSES_KEPT[1:]], axis=1)
    axis = None if "columns" in parameters or "axis_col" not in parameters else float(parameters["axis_col"])
    return PoseTable(path, "frame", frames, angles, shifts, turns, axis_col=axis)


CENTRES_KEPT = "view_centres_mm"
"""Parameter of a volume: `Geometry.centres` of its views."""

POSES_KEPT = "view_shifts_px", "view_roll_deg", "view_tilt_deg"
"""Parameters of a volume that keep the poses of its views, shifts in binned pixels."""


def write_poses(path: Path, volume: Path) -> tuple[int, float]:
    """Write the poses of the views of a volume file as a CSV that `read_poses` reads; returns the number of views, and
    the axis' column.

    Raises:
        DataError: the volume holds none, `path` exists, or the disk refuses; nothing is left.
    """
    with opened_reconstruction(volume) as record:
        try:
            table = _of_volume(volume, record)
        except ValueError as error:
            raise DataError(f"{error}. Nothing was written.") from error
        parameters, mm = record.parameters, record.length_unit == "mm"
        pixel = record.volume.grid.voxel_size if "sample_pitch" not in parameters else float(parameters["sample_pitch"])
        pixel /= int(parameters.get("binning", 1))
    assert table.angles_deg is not None
    header = ["frame", "angle_deg", *_PIXELS, *_TURNS, *(_FOR_PEOPLE if mm else ())]
    columns = [table.angles_deg, *table.shifts.T, *table.turns_deg.T, *(table.shifts.T * pixel if mm else ())]
    rows = ([int(frame), *map(repr, map(float, values))] for frame, *values in zip(table.keys, *columns, strict=True))
    write_whole(path, csv_text([header, *rows]))
    return int(table.keys.size), float(parameters["axis_col"])
