"""PoseTable: displacement, roll and tilt of each projection, or its vectors, read from a CSV, an .npz, a volume or
an NXtomo file.
"""

from __future__ import annotations

import csv
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import h5py
import numpy as np

from beamline.core.errors import DataError
from beamline.core.files import text_in, write_whole
from beamline.core.text import csv_text
from beamline.storage import datasets, hdf5
from beamline.storage.array_file import numpy_arrays
from beamline.storage.readers.nexus import choose, find
from beamline.storage.recon_record import ReconRecord
from beamline.storage.writers.recon_file import opened_reconstruction
from drivers.base.frame import FrameKind
from recon.base.arrays import F64
from recon.base.vectors import geometry_of_vectors

Key = Literal["frame", "view", "angle_deg"]
IGNORE = "ignore"  # value in place of a file: all projections count as not displaced, whatever the scan file says
_KEYS: tuple[Key, ...] = "frame", "view", "angle_deg"
_PIXELS = "shift_col_px", "shift_row_px"
_TURNS = "roll_deg", "tilt_deg"
_FOR_PEOPLE = "shift_col_mm", "shift_row_mm"
_VECTORS = {
    cone: tuple(f"{vector}_{axis}" for vector in (first, "d", "u", "v") for axis in "xyz")
    for cone, first in ((False, "ray"), (True, "src"))
}
# names of arrays of vectors, and whether the vectors are those of a cone beam
_ARRAYS = {"parallel3d_vec": False, "cone_vec": True}
_STEEPEST = 85.0  # largest tilt in degrees that is accepted
_LARGEST = 64 * 2**20  # largest size of a CSV in bytes
_HOW = (
    "state the directions: --poses FILE:x,-y means that a positive x_translation shifts the sample towards higher "
    "columns, and a positive y_translation towards lower rows"
)


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Poses of some projections, in unbinned pixels.

    Attributes:
        path: path of the file.
        by: meaning of `keys`: rows of the scan file, projections counted from 0 in its order, or angles in degrees.
        keys: float64 [row], all different.
        angles_deg: float64 [row], angles of the projections, to be compared with the angles of the scan. None if the
            file has no angles.
        shifts: float64 [row, 2], displacement of the image along (columns, rows), in `unit`.
        turns_deg: float64 [row, 2], roll and tilt, as in `recon.base.geometry.Geometry`.
        unit: "px" of the unbinned detector, or "mm" at the sample.
        frames: number of frames of the scan for which the file was made; None: not known.
        axis_col: rotation axis of the volume with which the poses were found, in columns of the whole detector; None:
            not known.
        vectors: float64 [row, 12] in mm, as in `recon.base.vectors`, which state the complete geometry; None: no
            vectors.
        cone: True if the vectors are those of a cone beam.
    """

    path: Path
    by: Key
    keys: F64
    angles_deg: F64 | None
    shifts: F64
    turns_deg: F64
    unit: Literal["px", "mm"] = "px"
    frames: int | None = None
    axis_col: float | None = None
    vectors: F64 | None = None
    cone: bool = False

    @property
    def leans(self) -> bool:
        """True if a detector row may show several slices, because a projection is rolled or tilted."""
        return self.vectors is not None or bool(self.turns_deg.any())

    def __str__(self) -> str:
        return str(self.path)

    def __post_init__(self) -> None:
        for name, values in (("shift", self.shifts), ("roll or tilt", self.turns_deg)):
            if not np.isfinite(values).all():
                row = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
                raise ValueError(f"{self.path}: {self.by} {self.keys[row]:g} has no finite {name}")
        steep = np.abs(self.turns_deg) > (180.0, _STEEPEST)
        if steep.any():
            row = int(np.flatnonzero(steep.any(axis=1))[0])
            roll, tilt = self.turns_deg[row]
            projection = self.keys[row]
            raise ValueError(
                f"{self.path}: {self.by} {projection:g} has a roll of {roll:g} and a tilt of {tilt:g} degrees; "
                f"expected at most 180 and {_STEEPEST:g}"
            )
        ordered, counts = np.unique(self.keys, return_counts=True)
        if (counts > 1).any():
            repeated = ordered[counts > 1][0]
            raise ValueError(f"{self.path}: {self.by} {repeated:g} has {counts.max()} rows; expected one")


class _NoPosesError(Exception):
    """A valid file that does not state poses. It is not a ValueError, because a ValueError would be taken for a damaged
    file.
    """


def read_poses(text: str) -> PoseTable:
    """The table that a text names: `FILE`, or `FILE:x,-y` for an NXtomo file. The text `ignore` gives an empty table.

    Raises:
        ValueError: the file cannot be read as poses; the message says why.
    """
    if text == IGNORE:
        return PoseTable(Path(IGNORE), "view", np.empty(0), None, np.empty((0, 2)), np.empty((0, 2)))
    match = re.fullmatch(r"(.+):([+-]?[xyz]|0),([+-]?[xyz]|0)", text)
    path = Path(match[1] if match else text)
    try:
        if hdf5.is_hdf5(path):
            return _of_hdf5(path, (match[2], match[3]) if match else None)
        if zipfile.is_zipfile(path):
            return _of_arrays(path)
        return _of_csv(path, text_in(path, _LARGEST))
    except _NoPosesError as error:
        raise ValueError(str(error)) from error
    except (OSError, DataError) as error:
        raise ValueError(f"{path} cannot be read ({hdf5.reason(error)})") from error


def _of_csv(path: Path, content: str) -> PoseTable:
    lines = [line for line in content.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    head, *rows = list(csv.reader(lines)) or [[]]
    names = [name.strip().lower() for name in head]
    cone = next((cone for cone, columns in _VECTORS.items() if columns[0] in names), None)
    if lines and len(re.split(r"[\s,]+", lines[0].strip())) == 12 and not re.search("[a-df-z]", lines[0]):
        raise ValueError(
            f"{path} has 12 numbers per line and no names, like vectors of ASTRA. Save these vectors "
            'under the name of their kind, cone_vec or parallel3d_vec: python -c "import numpy as np; '
            f"np.savez('poses.npz', cone_vec=np.loadtxt('{path.name}'))\", and give --poses poses.npz"
        )
    _require_header(path, names, cone)
    columns = dict(zip(names, _numbers(path, names, rows).T, strict=True))
    key_name = next(name for name in _KEYS if name in columns)
    keys, angles = columns[key_name], columns.get("angle_deg")
    _require_keys(path, columns, key_name)
    if cone is not None:
        vectors = np.stack([columns[name] for name in _VECTORS[cone]], axis=1)
        return _of_vectors(path, key_name, keys, vectors, cone=cone)
    zeros = np.zeros(keys.size)
    shifts, turns = (np.stack([columns.get(name, zeros) for name in part], axis=1) for part in (_PIXELS, _TURNS))
    return PoseTable(path, key_name, keys, angles, shifts, turns)


def _require_header(path: Path, names: list[str], cone: bool | None) -> None:
    """Raise ValueError unless the first line contains a key, and either poses or a complete set of vectors (of a
    parallel beam or a cone), and no other names.
    """
    stated = (*_PIXELS, *_TURNS) if cone is None else _VECTORS[cone]
    missing = set(stated) - set(names)
    if not set(names) & set(_KEYS) or (len(missing) == len(stated) if cone is None else missing):
        raise ValueError(
            f"{path}: the first line is {','.join(names)!r}; expected a header with view, frame or "
            f"angle_deg, and with {'some' if cone is None else 'all'} of {', '.join(stated)}"
        )
    legal = (*_KEYS, *stated, *(_FOR_PEOPLE if cone is None else ()))
    for name in names:
        if name not in legal or names.count(name) > 1:
            known_names = ", ".join(legal)
            raise ValueError(f"{path}: column {name!r} is unknown or occurs twice; known: {known_names}")


def _numbers(path: Path, names: list[str], rows: list[list[str]]) -> F64:
    """The table [row, column]. Raises ValueError if a cell is not a number, or if there is no row."""
    if not rows:
        raise ValueError(f"{path} has a header and no rows; expected one row for each projection")
    values = np.empty((len(rows), len(names)))
    for number, row in enumerate(rows):
        try:
            values[number] = [float(cell) for _, cell in zip(names, row, strict=True)]
        except ValueError:
            raise ValueError(f"{path}: {','.join(row)!r} are not {len(names)} numbers") from None
    return values


def _require_keys(path: Path, columns: dict[str, F64], by: Key) -> None:
    """Raise ValueError for keys that are not integers of at least 0, and for angles that are not finite."""
    for name in {by, "angle_deg"} & columns.keys():
        given = columns[name]
        bad = ~np.isfinite(given) | ((name != "angle_deg") & (given != np.abs(np.round(given))))
        if bad.any():
            kind = "finite angles" if name == "angle_deg" else "integers from 0 on"
            raise ValueError(f"{path}: {name} holds {given[bad][:3].tolist()}; expected {kind}")


def _of_arrays(path: Path) -> PoseTable:
    """The vectors of all projections. An .npz contains them under the name that ASTRA uses for their kind."""
    with hdf5.readable(path):
        arrays = numpy_arrays(path)
    read = {name: values for name, values in arrays.items() if name in _ARRAYS}
    if len(read) != 1:
        raise ValueError(f"{path} contains {', '.join(arrays)}; expected one of {' and '.join(_ARRAYS)}")
    ((name, vectors),) = read.items()
    if vectors.dtype.kind not in "iuf" or vectors.ndim != 2:
        raise ValueError(f"{path}: {name} is {vectors.dtype} of shape {vectors.shape}; expected numbers [view, 12]")
    keys = np.arange(len(vectors), dtype=np.float64)
    return _of_vectors(path, "view", keys, vectors.astype(np.float64), cone=_ARRAYS[name])


def _of_vectors(path: Path, by: Key, keys: F64, vectors: F64, *, cone: bool) -> PoseTable:
    try:
        views = geometry_of_vectors(vectors, (1, 1), cone=cone)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    turns = np.degrees(np.stack((views.roll, views.tilt), axis=1))
    return PoseTable(path, by, keys, None, np.zeros((len(keys), 2)), turns, vectors=vectors, cone=cone)


def _of_hdf5(path: Path, ways: tuple[str, str] | None) -> PoseTable:
    with hdf5.open_hdf5(path) as file, hdf5.readable(path):
        if ways is not None or datasets.text_at(file, "entry/definition") != "NXtomoproc":
            return _of_nexus(path, file, ways)
    with opened_reconstruction(path) as record:
        return _of_volume(path, record)


def _of_volume(path: Path, record: ReconRecord) -> PoseTable:
    parameters = record.parameters
    frames, angles = (
        np.atleast_1d(np.asarray(parameters.get(name, ()), np.float64)) for name in ("view_frames", "view_angles_deg")
    )
    if not any(name in parameters for name in POSES_KEPT) or not frames.size:
        raise ValueError(
            f"{path} contains no poses: the projections of this volume were used without displacement and without tilt"
        )
    if CENTRES_KEPT in parameters:
        raise ValueError(
            f"{path} was reconstructed with geometry vectors, but does not contain these vectors: give the file with "
            "the vectors"
        )
    zeros, binning = np.zeros(frames.size), int(parameters.get("binning", 1))
    shifts = np.asarray(parameters.get("view_shifts_px", np.zeros((frames.size, 2))), np.float64) * binning
    turns = np.stack([np.asarray(parameters.get(name, zeros), np.float64) for name in POSES_KEPT[1:]], axis=1)
    axis = None if "columns" in parameters or "axis_col" not in parameters else float(parameters["axis_col"])
    return PoseTable(path, "frame", frames, angles, shifts, turns, axis_col=axis)


CENTRES_KEPT = "view_centres_mm"
"""Name of a parameter in a volume file: `Geometry.centres` of the projections."""

POSES_KEPT = "view_shifts_px", "view_roll_deg", "view_tilt_deg"
"""Names of the parameters in a volume file that contain the poses of the projections. Shifts are in binned pixels."""


def _of_nexus(path: Path, file: h5py.File, ways: tuple[str, str] | None) -> PoseTable:
    """Translations of the sample in mm, minus their median. A translation that all projections share does not displace
    a projection relative to the others.
    """
    places = choose(file, find(file))
    kinds = places.kinds()
    shown = kinds == FrameKind.PROJECTION
    moved: dict[str, F64] = {}
    for axis in "xyz":
        item = datasets.dataset(places.entry, f"sample/{axis}_translation")
        if item is None:
            continue
        datasets.require_real(item.dtype, f"{item.name} in {path}")
        unit = datasets.factor_of(datasets.attribute(item, "units"), datasets.LENGTH_UNITS)
        values = np.ravel(np.asarray(datasets.values_of(item), np.float64))
        if unit is None or values.size not in (1, kinds.size):
            raise _NoPosesError(
                f"{path}: {item.name} has {values.size} values in the units {datasets.attribute(item, 'units')!r}; "
                f"expected one for each of {kinds.size} frames, in a unit of length"
            )
        values = np.broadcast_to(values * unit, kinds.shape)
        if not np.isfinite(values[shown]).all():
            n_bad = (~np.isfinite(values[shown])).sum()
            raise _NoPosesError(f"{path}: {item.name} is not finite in {n_bad} projections")
        moved[axis] = values - np.median(values[shown])
    if not moved:
        raise _NoPosesError(
            f"{path} has none of sample/x_translation, y_translation and z_translation; expected at least one of "
            "these fields, or a CSV file"
        )
    directions = ", ".join(f"{axis} by {np.ptp(values[shown]):.4g} mm" for axis, values in moved.items())
    if ways is None:
        raise _NoPosesError(
            f"{path}: the sample moves in {directions}, but NeXus does not state the directions on the detector; {_HOW}"
        )
    named = {way[-1] for way in ways} - {"0"}
    if not named <= set(moved) or len(named) < sum(way != "0" for way in ways):
        raise _NoPosesError(
            f"{path}: {','.join(ways)} does not name two of the sample translations in the file ({', '.join(moved)}); "
            f"{_HOW}"
        )
    shifts = [np.zeros(kinds.size) if way == "0" else (-1 if way[0] == "-" else 1) * moved[way[-1]] for way in ways]
    rows = np.flatnonzero(shown)
    stacked = np.stack(shifts, axis=1)[rows]
    return PoseTable(path, "frame", rows.astype(np.float64), None, stacked, np.zeros((rows.size, 2)), "mm", kinds.size)


def write_poses(path: Path, volume: Path) -> tuple[int, float]:
    """Write the poses of the projections of a volume file as a CSV that `read_poses` reads. Returns the number of
    projections, and the column of the rotation axis.

    Raises:
        DataError: the volume file contains no poses, `path` exists, or the disk failed. No new file is left.
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
