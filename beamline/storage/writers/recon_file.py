"""Writes and reads reconstruction files: a volume with all settings and its history, as NXtomoproc. A file is written
completely or not at all.

Also writes and reads checkpoints: the state of a fit, with its data and settings. A new checkpoint replaces the one
before only when it is complete.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import atomic_file
from beamline.core.installed import version
from beamline.core.quantities import VoxelKind
from beamline.storage import datasets, hdf5
from beamline.storage.recon_record import ReconRecord, Value
from beamline.storage.structure import require_harmless
from beamline.storage.writer_lock import opened_whole
from recon.base.volume import Grid, Volume, VolumeSeries

DEFINITION = "NXtomoproc"
DEVIATION, CHANGE, DISPLACEMENT = "data_errors", "change", "displacement"
"""Names of datasets next to the volume: the standard deviation of each voxel, the volume minus a moved reference, and
(with _z, _y and _x) the displacement of the reference.
"""
SUFFIXES = (".h5", ".hdf5", ".nxs")
_SLAB = 16  # slices that are written together
_UNITS_OF_MODEL = {
    "centres": "length", "widths": "length", "densities": "voxel", "density_unit": "voxel",
    "pixel_pitch": "length", "source_distances": "length", "view_angles": "rad", "view_roll": "rad", "view_tilt": "rad",
    "view_shifts": "px", "axis": "px",
}  # fmt: skip
_LONG_NAMES = {VoxelKind.ATTENUATION: "linear attenuation coefficient"}


def write_reconstruction(path: Path, record: ReconRecord, *, replace: bool = False) -> None:
    """Write `record` to `path` as NXtomoproc (NeXus definitions, applications/NXtomoproc).

    Raises:
        DataError: `path` exists and `replace` is False, or the disk failed. No incomplete file is left.
    """
    with atomic_file(path, replace=replace) as partial:
        write_record(partial, record)


def write_record(path: Path, record: ReconRecord, *, empty: bool = False) -> None:
    """Write the new file `path`, sixteen slices at a time. Raises OSError if the disk failed.

    Args:
        empty: True: the voxels are not written, but their space is allocated as blocks of zeros.
    """
    with hdf5.created(path) as file:
        write_entry(file, record, empty)
        file.attrs["default"] = "entry"


def write_entry(file: hdf5.NewFile, record: ReconRecord, empty: bool) -> None:
    entry = _group(file, "entry", "NXentry")
    entry.attrs["default"] = "data"
    _write_facts(entry, record)
    data = _group(entry, "data", "NXdata")
    data.attrs["signal"] = "data"
    times = [] if record.series is None else ["time"]
    data.attrs["axes"] = [*times, "z", "y", "x"]
    # One slice per chunk, because viewers show one slice after the other. Compression with gzip would take minutes for
    # large volumes and save little, because of the noise.
    shape = record.volume.grid.shape
    voxels = [record.volume.data] if record.series is None else record.series.each()
    several = () if record.series is None else (len(voxels),)
    chunk = None if empty else (1, *shape[1:]) if record.series is None else (1, 1, *shape[1:])
    stored = data.create_dataset("data", (*several, *shape), np.float32, chunks=chunk)
    if empty:
        stored[-1, -1, -1] = 0  # allocates the space
    for index, one in zip(np.ndindex(several), voxels, strict=True):
        # writes in pieces, so that a signal need not wait for the whole volume
        for first in range(0, 0 if empty else shape[0], _SLAB):
            stored[(*index, slice(first, first + _SLAB))] = one[first : first + _SLAB]
            file.require_taken()
    if record.series is not None:
        data["time"] = record.series.seconds
        data["time"].attrs["units"] = "s"
    for name, (values, what) in _beside(record).items():
        other = data.create_dataset(name, shape, np.float32, chunks=None if empty else (1, *shape[1:]))
        if empty:
            other[-1, -1, -1] = 0
        for first in range(0, 0 if empty else shape[0], _SLAB):
            other[first : first + _SLAB] = values[first : first + _SLAB]
            file.require_taken()
        unit = record.length_unit if name.startswith(DISPLACEMENT) else record.unit
        other.attrs["units"], other.attrs["long_name"] = unit, f"{what} ({unit})"
    data["data"].attrs["units"] = record.unit
    what = f"{_LONG_NAMES.get(record.kind, record.kind.value)} ({record.unit})"
    data["data"].attrs["long_name"] = what.removesuffix(" ()")
    for name, centres in zip(("z", "y", "x"), record.volume.grid.coordinates(), strict=True):
        data[name] = centres
        data[name].attrs["units"] = record.length_unit


def _beside(record: ReconRecord) -> dict[str, tuple[NDArray[np.float32], str]]:
    """The arrays [z, y, x] next to the volume, by the names of their datasets, with descriptions."""
    arrays = {}
    if record.deviation is not None:
        arrays[DEVIATION] = record.deviation, "standard deviation of each voxel"
    if record.change is not None:
        arrays[CHANGE] = record.change, "volume minus the moved reference"
    if record.displacement is not None:
        for axis, values in zip("zyx", record.displacement, strict=True):
            arrays[f"{DISPLACEMENT}_{axis}"] = (
                values,
                (f"displacement of the material along {axis}: position in the reference minus position in the volume"),
            )
    return arrays


def _write_facts(entry: h5py.Group, record: ReconRecord) -> None:
    entry["definition"] = DEFINITION
    entry["title"] = record.title
    source = _group(_group(entry, "instrument", "NXinstrument"), "source", "NXsource")
    source["probe"] = "x-ray"
    _group(entry, "sample", "NXsample")["name"] = record.sample

    process = _group(entry, "reconstruction", "NXprocess")
    process["program"] = "splatline"
    process["version"] = version()
    process["date"] = datetime.fromtimestamp(record.time, UTC).isoformat(timespec="seconds")
    parameters = _group(process, "parameters", "NXparameters")
    parameters["raw_file"] = record.raw_file
    for name, value in record.parameters.items():
        parameters[name] = value
    groups: dict[str, Mapping[str, Any]] = {"metrics": record.metrics, "history": record.history}
    if record.model:
        groups["gaussians"] = record.model
    for group, values in groups.items():
        node = _group(process, group, "NXcollection")
        for name, value in values.items():
            node[name] = value
    for name, unit in _UNITS_OF_MODEL.items() if record.model else ():
        process["gaussians"][name].attrs["units"] = {"length": record.length_unit, "voxel": record.unit}.get(unit, unit)


def _group(parent: h5py.Group, name: str, nx_class: str) -> h5py.Group:
    group = parent.create_group(name)
    group.attrs["NX_class"] = nx_class
    return group


def new_plot(file: hdf5.NewFile, signal: str, grid: Grid, unit: str) -> h5py.Group:
    """Create the group entry/data of a new file as NXdata, which is the default plot. It gets the axes z, y and x, but
    not yet the signal.
    """
    file.attrs["default"] = "entry"
    entry = _group(file, "entry", "NXentry")
    entry.attrs["default"] = "data"
    data = _group(entry, "data", "NXdata")
    data.attrs["signal"], data.attrs["axes"] = signal, ["z", "y", "x"]
    for name, centres in zip(("z", "y", "x"), grid.coordinates(), strict=True):
        data[name] = centres
        data[name].attrs["units"] = unit
    return data


def read_reconstruction(path: Path) -> ReconRecord:
    """Read the record written by `write_reconstruction`.

    Raises:
        DataError: the file is missing, or it is not a reconstruction file.
    """
    with opened_reconstruction(path) as record, hdf5.readable(path):
        values = np.asarray(record.volume.data[:], dtype=np.float32)
        deviation = None if record.deviation is None else np.asarray(record.deviation[:], dtype=np.float32)
        return replace(record, volume=Volume(values, record.volume.grid), deviation=deviation)


@contextmanager
def opened_reconstruction(path: Path, at: int | None = None) -> Iterator[ReconRecord]:
    """Like `read_reconstruction`, but voxels are read when the volume is sliced along z.

    Args:
        at: number of one of several volumes in time.

    Raises:
        DataError: the file is missing, it is not a reconstruction file, or it does not contain volume `at`.
    """
    if not path.is_file():
        raise DataError(f"{path} does not exist.")
    with ExitStack() as stack:
        try:
            file = stack.enter_context(opened_whole(path))
            require_harmless(file)
            n = volumes_in_time(file)
            if (at is None) != (n == 0) or (at is not None and not 0 <= at < n):
                held = "one volume, not a time series: omit --at"
                if n:
                    last = n - 1
                    held = f"{n} volumes of a time series: choose one with --at 0 to {last} (`beamline export`)"
                raise DataError(f"{path} contains {held}.")
            record = _read_entry(file["entry"], at)
        except hdf5.ALTERED as error:
            raise DataError(f"{path} cannot be read as a reconstruction ({error}). Expected NXtomoproc.") from error
        yield record


def volumes_in_time(file: h5py.File) -> int:
    """Number of volumes of the time series in a file of this program; 0 if the file contains a single volume."""
    stored = file["entry/data/data"]
    return int(stored.shape[0]) if stored.ndim == 4 else 0


def _read_entry(entry: h5py.Group, number: int | None) -> ReconRecord:
    data, process = entry["data"], entry["reconstruction"]
    z, y, x = (np.asarray(datasets.values_of(data[name])) for name in ("z", "y", "x"))
    # An axis with one voxel does not show the voxel size, and a longer axis shows it more precisely. Slices may be
    # thicker.
    height = _pitch(z)
    size = _pitch(max(y, x, key=len)) or height or 1.0
    pitch = None if height is None or math.isclose(height, size, rel_tol=1e-3) else height
    centre = tuple(float(a[0] + a[-1]) / 2 for a in (z, y, x))
    stored, series = data["data"], None
    if number is not None:
        series = VolumeSeries(np.asarray(data["time"][:]), stored)
        stored = series.each()[number]
    grid = Grid(stored.shape, size, centre, pitch)  # type: ignore[arg-type]
    parameters = {name: value_of(node) for name, node in process["parameters"].items()}
    return ReconRecord(
        volume=Volume(stored, grid),
        length_unit=str(data["x"].attrs["units"]),
        raw_file=str(parameters.pop("raw_file")),
        title=str(value_of(entry["title"])),
        sample=str(value_of(entry["sample/name"])),
        time=datetime.fromisoformat(str(value_of(process["date"]))).timestamp(),
        parameters=parameters,
        metrics={name: float(datasets.values_of(node)) for name, node in process["metrics"].items()},
        history={name: np.asarray(datasets.values_of(node)) for name, node in process["history"].items()},
        model={name: value_of(node) for name, node in process.get("gaussians", {}).items()},
        deviation=data.get(DEVIATION),
        kind=VoxelKind.of_unit(str(data["data"].attrs.get("units"))),
        series=series,
    )


def _pitch(axis: NDArray[np.floating]) -> float | None:
    """Distance between voxels; None if there is only one voxel."""
    return float(axis[-1] - axis[0]) / (axis.size - 1) if axis.size > 1 else None


def value_of(node: h5py.Dataset) -> Value:
    """Value of a dataset: a text, a number, or an array."""
    value = node[()]
    if isinstance(value, bytes):
        return value.decode()
    return value.item() if isinstance(value, np.generic) else value


_FORMAT = "splatline checkpoint 1"


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The state of an interrupted fit.

    Attributes:
        state: arrays of the state by name, see recon.splatting.checkpoint.
        made_from: data and settings of the fit, by name; they must be the same when it resumes.
        steps: planned number of steps; 0 if a time limit was planned.
    """

    state: Mapping[str, NDArray[Any]]
    made_from: Mapping[str, Value]
    steps: int


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write `checkpoint` to `path`, atomically replacing an older one.

    Raises:
        DataError: the disk failed. An older checkpoint is unchanged.
    """
    with atomic_file(path, replace=True) as partial, hdf5.created(partial) as file:
        file.attrs["format"], file.attrs["version"] = _FORMAT, version()
        file.attrs["steps"] = checkpoint.steps
        for group, values in (("state", checkpoint.state), ("made_from", checkpoint.made_from)):
            node = file.create_group(group)
            for name, value in values.items():
                node[name] = value


def read_checkpoint(path: Path) -> Checkpoint:
    """Read the checkpoint written by `write_checkpoint`.

    Raises:
        DataError: the file is missing, damaged, or not a checkpoint.
    """
    if not path.is_file():
        raise DataError(f"{path} does not exist; give a checkpoint that `beamline recon --checkpoint` wrote.")
    try:
        with opened_whole(path) as file:
            require_harmless(file)
            format_of_file = file.attrs.get("format")
            if format_of_file != _FORMAT:
                raise KeyError(f"its format is {format_of_file!r}, expected {_FORMAT!r}")
            return Checkpoint(
                {name: np.asarray(node[()]) for name, node in file["state"].items()},
                {name: value_of(node) for name, node in file["made_from"].items()},
                int(file.attrs["steps"]),
            )
    # errors of h5py
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, MemoryError) as error:
        raise DataError(
            f"{path} is not a readable checkpoint ({error}); `beamline recon --checkpoint` writes a checkpoint."
        ) from error
