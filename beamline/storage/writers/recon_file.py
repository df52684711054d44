"""Reconstruction files: a volume, everything it was made with and how it grew, as NXtomoproc; all of it or nothing."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import whole_file
from beamline.core.shipped import version
from beamline.core.voxel_kind import VoxelKind
from beamline.storage import hdf5
from beamline.storage.structure import require_harmless
from beamline.storage.writer_lock import opened_whole
from recon.assess.time_model import NextDecibel
from recon.base.volume import Grid, Volume

DEFINITION = "NXtomoproc"
FBP, DEVIATION = "fbp", "data_errors"
"""Datasets beside the volume: filtered back-projection of the same views, and the standard deviation of each voxel."""
SUFFIXES = (".h5", ".hdf5", ".nxs")
_MODEL = 2**32  # bytes of a list of Gaussians
_SLAB = 16  # slices written at a time
_UNITS_OF_MODEL = {
    "centres": "length", "widths": "length", "densities": "voxel", "density_unit": "voxel",
    "pixel_pitch": "length", "source_distances": "length", "view_angles": "rad", "view_roll": "rad", "view_tilt": "rad",
    "view_shifts": "px", "axis": "px",
}  # fmt: skip
_LONG_NAMES = {VoxelKind.ATTENUATION: "linear attenuation coefficient"}
_ENDS = ("ended_early", "resumed_from", "checkpoint_lost")  # parameters that tell how it ended
Value = str | int | float | bool | NDArray[Any]


@dataclass(frozen=True, eq=False)
class VolumesInTime:
    """Volumes of a sample that changes.

    Attributes:
        seconds: float64 [time], from the first view on.
        data: float32 [time, z, y, x], or a dataset of a file.
    """

    seconds: NDArray[np.float64]
    data: Any

    def each(self) -> list[Any]:
        """The volumes, which are read where they are sliced along z."""
        return [_VolumeAt(self.data, at) for at in range(len(self.seconds))]


class _VolumeAt:
    """One volume of a dataset [time, z, y, x], as a dataset [z, y, x] that is sliced along z."""

    def __init__(self, data: Any, at: int) -> None:
        self._data, self._at, self.shape, self.dtype = data, at, data.shape[1:], data.dtype

    def __getitem__(self, z: slice) -> NDArray[np.float32]:
        return np.asarray(self._data[self._at, z])


@dataclass(frozen=True, eq=False)
class VolumeInFile:
    """A volume whose voxels are in a file alone: its grid, and what reads it."""

    grid: Grid
    read: Callable[[], Volume]


class VolumeField:
    """A field of a dataclass that holds a volume, or one in a file, which is read at the first use."""

    def __get__(self, record: Any, owner: type | None = None) -> Volume:
        if record is None:
            raise AttributeError("a field without a default")
        held = record.__dict__["volume"]
        if isinstance(held, VolumeInFile):
            held = record.__dict__["volume"] = held.read()
        return held

    def __set__(self, record: Any, volume: Volume | VolumeInFile) -> None:
        record.__dict__["volume"] = volume


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ReconRecord:
    """The record of a volume: what was made, of what, how it was judged, and where it lies.

    The same value is in the file of the volume, in the event `done` and in the results of `beamline.api`.

    Attributes:
        volume: `volume.data` float32 [z, y, x]; of an open file, a dataset that is sliced along z. Of a file just
            written, it is read at the first use.
        length_unit: "mm" where the pixel size is known, else "px".
        raw_file: name of the scan it was made from.
        time: s since the Unix epoch when it was made.
        parameters: every setting used, by name; numbers, strings and arrays.
        metrics: figures of merit, by name.
        history: equally long arrays, by name (step, seconds, loss ...); empty where there are no steps.
        deviation: float32 [z, y, x], the standard deviation of each voxel in the volume's unit; None: not known.
        fbp: float32 [z, y, x], FBP of the same views, where the volume may hide or lack something; None: not kept.
        series: all volumes in time, where `volume` is one of several; None: it is the only one.
        kind: what the voxels are.
        model: the Gaussians behind the volume and the geometry of their views, see `reconstruct.model`; empty: none.
        compared: metrics of FBP of the same views; None without. This and what follows are of a volume that was made
            by this program just now; files do not hold it.
        warnings: sentences.
        hiding: the warning of what the volume may hide; empty without.
        chosen: how `auto`, a budget or a preset came to its settings; empty where they were given.
        next_decibel, next_decibel_text: what one more decibel costs; None, and empty, where that is not known.
        output, report: files of the volume and of its report; None: not written.
        elapsed, times: s in all, and of each phase.
    """

    volume: VolumeField = VolumeField()
    length_unit: str
    raw_file: str
    title: str
    sample: str
    time: float
    parameters: Mapping[str, Value]
    metrics: Mapping[str, float] = field(default_factory=dict)
    history: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    model: Mapping[str, Any] = field(default_factory=dict)
    deviation: NDArray[np.float32] | None = None
    fbp: NDArray[np.float32] | None = None
    kind: VoxelKind = VoxelKind.ATTENUATION
    series: VolumesInTime | None = None
    compared: Mapping[str, float] | None = None
    warnings: Sequence[str] = ()
    hiding: str = ""
    chosen: str = ""
    next_decibel: NextDecibel | None = None
    next_decibel_text: str = ""
    output: Path | None = None
    report: Path | None = None
    elapsed: float = math.nan
    times: Mapping[str, float] = field(default_factory=dict)

    @property
    def grid(self) -> Grid:
        """Of the volume, which is not read for it."""
        held: Volume | VolumeInFile = self.__dict__["volume"]
        return held.grid

    @property
    def unit(self) -> str:
        """Of the voxels; empty for shares."""
        return self.kind.unit(self.length_unit)

    @property
    def method(self) -> str:
        """Its name; of a choice, that of the method chosen. Empty in the file of another program."""
        return str(self.parameters.get("method", ""))

    @property
    def axis_col(self) -> float:
        """Rotation axis in columns of the full detector; NaN where no file states it."""
        return float(self.parameters.get("axis_col", math.nan))

    @property
    def ended_early(self) -> bool:
        """It was stopped, and is the volume reached by then."""
        return bool(self.parameters.get("ended_early", False))

    @property
    def figures(self) -> Mapping[str, float]:
        """`metrics`, as scripts call them."""
        return self.metrics

    @property
    def settings(self) -> Mapping[str, Value]:
        """`parameters`, as scripts call them."""
        return self.parameters

    @property
    def units(self) -> str:
        """`unit`, as scripts call it."""
        return self.unit

    def __repr__(self) -> str:
        return f"ReconRecord({self.method}: {' x '.join(map(str, self.grid.shape))} voxels, {self.output})"

    def _repr_html_(self) -> str:
        """For a notebook: the figures and the volume's middle slices."""
        figures = ", ".join(f"{name} {value:.4g}" for name, value in self.metrics.items())
        return f"<p>{self.method}: {figures}</p>{self.volume._repr_html_()}"

    def told(self) -> dict[str, Any]:
        """What the event `done` says of it, by name, in the order of its line."""
        parameters = self.parameters
        ends = {name: parameters[name] for name in _ENDS if name in parameters}
        others = {
            "hiding": self.hiding or None,
            "chosen": self.chosen or None,
            "next_db": self.next_decibel,
            "next_db_said": None if self.next_decibel is None else self.next_decibel_text,
            "fbp": self.compared,
        }
        return {
            "output": self.output,
            "report": self.report,
            "method": self.method,
            "axis_col": self.axis_col,
            "n_views": parameters.get("n_views"),
            "shape": self.grid.shape,
            "units": self.unit,
            "elapsed": self.elapsed,
            "times": self.times,
            **self.metrics,
            **ends,
            **{name: value for name, value in others.items() if value is not None},
        }


def write_reconstruction(path: Path, record: ReconRecord, *, replace: bool = False) -> None:
    """Write `record` to `path` as NXtomoproc (NeXus definitions, applications/NXtomoproc).

    Raises:
        DataError: if `path` exists and `replace` is not set, or the disk refuses; no partial file stays.
    """
    with whole_file(path, replace=replace) as partial:
        write_record(partial, record)


def write_record(path: Path, record: ReconRecord, *, empty: bool = False) -> None:
    """Write the new file `path`, sixteen slices at a time. OSError where the disk refuses.

    Args:
        empty: without the voxels, for which there is one place, of zeros.
    """
    with hdf5.created(path) as file:
        _write_entry(file, record, empty)
        file.attrs["default"] = "entry"


def rewrite_facts(path: Path, record: ReconRecord) -> None:
    """Replace all but voxels and axes by what `record` says. OSError where the disk refuses."""
    with hdf5.changed(path) as file:
        entry = file["entry"]
        for name in set(entry) - {"data"}:
            del entry[name]
        _write_facts(entry, record)


def _write_entry(file: hdf5.NewFile, record: ReconRecord, empty: bool) -> None:
    entry = _group(file, "entry", "NXentry")
    entry.attrs["default"] = "data"
    _write_facts(entry, record)
    data = _group(entry, "data", "NXdata")
    data.attrs["signal"] = "data"
    times = [] if record.series is None else ["time"]
    data.attrs["axes"] = [*times, "z", "y", "x"]
    # One slice a chunk: viewers page through z; gzip would cost minutes on large volumes and gain little on noise.
    shape = record.volume.grid.shape
    voxels = [record.volume.data] if record.series is None else record.series.each()
    several = () if record.series is None else (len(voxels),)
    chunk = None if empty else (1, *shape[1:]) if record.series is None else (1, 1, *shape[1:])
    stored = data.create_dataset("data", (*several, *shape), np.float32, chunks=chunk)
    if empty:
        stored[-1, -1, -1] = 0  # which allocates it
    for at, one in zip(np.ndindex(several), voxels, strict=True):
        for first in range(0, 0 if empty else shape[0], _SLAB):  # so that a signal need not wait for the whole
            stored[(*at, slice(first, first + _SLAB))] = one[first : first + _SLAB]
            file.require_taken()
    if record.series is not None:
        data["time"] = record.series.seconds
        data["time"].attrs["units"] = "s"
    beside = {
        DEVIATION: (record.deviation, "standard deviation of each voxel"),
        FBP: (record.fbp, "filtered back-projection of the same views"),
    }
    for name, (values, meaning) in beside.items():
        if values is None or empty:
            continue
        other = data.create_dataset(name, shape, np.float32, chunks=(1, *shape[1:]))
        for first in range(0, shape[0], _SLAB):
            other[first : first + _SLAB] = values[first : first + _SLAB]
            file.require_taken()
        other.attrs["units"] = record.unit
        other.attrs["long_name"] = f"{meaning} ({record.unit})"
    data["data"].attrs["units"] = record.unit
    what = f"{_LONG_NAMES.get(record.kind, record.kind.value)} ({record.unit})"
    data["data"].attrs["long_name"] = what.removesuffix(" ()")
    for name, centres in zip(("z", "y", "x"), record.volume.grid.coordinates(), strict=True):
        data[name] = centres
        data[name].attrs["units"] = record.length_unit


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


def read_reconstruction(path: Path) -> ReconRecord:
    """The record that `write_reconstruction` wrote.

    Raises:
        DataError: if the file is missing or is not such a file.
    """
    with opened_reconstruction(path) as record, hdf5.readable(path):
        values = np.asarray(record.volume.data[:], dtype=np.float32)
        beside = record.deviation, record.fbp
        deviation, fbp = (None if other is None else np.asarray(other[:], dtype=np.float32) for other in beside)
        return replace(record, volume=Volume(values, record.volume.grid), deviation=deviation, fbp=fbp)


@contextmanager
def opened_reconstruction(path: Path, at: int | None = None) -> Iterator[ReconRecord]:
    """As `read_reconstruction`, without voxels in memory: the volume's data are read where they are sliced along z.

    Args:
        at: number of one of several volumes in time.

    Raises:
        DataError: if the file is missing or is not such a file, or `at` names none of its volumes.
    """
    with ExitStack() as stack:
        try:
            file = stack.enter_context(opened_whole(path))
            require_harmless(file)
            n = volumes_in_time(file)
            if (at is None) != (n == 0) or (at is not None and not 0 <= at < n):
                held = "one volume, not a series in time: leave out --at"
                if n:
                    held = f"{n} volumes in time: name one by --at 0 to {n - 1} (`beamline export`)"
                raise DataError(f"{path} holds {held}.")
            record = _read_entry(file["entry"], at)
        except hdf5.ALTERED as error:
            raise DataError(f"{path} cannot be read as a reconstruction ({error}). Expected NXtomoproc.") from error
        yield record


def volumes_in_time(file: h5py.File) -> int:
    """How many volumes in time a file of ours has; 0: it has one volume alone."""
    stored = file["entry/data/data"]
    return int(stored.shape[0]) if stored.ndim == 4 else 0


def _read_entry(entry: h5py.Group, at: int | None) -> ReconRecord:
    data, process = entry["data"], entry["reconstruction"]
    z, y, x = (np.asarray(hdf5.values_of(data[name])) for name in ("z", "y", "x"))
    # An axis of one voxel says nothing about the voxel size, the longer one says it best; slices may be higher.
    height = _pitch(z)
    size = _pitch(max(y, x, key=len)) or height or 1.0
    pitch = None if height is None or math.isclose(height, size, rel_tol=1e-3) else height
    centre = tuple(float(a[0] + a[-1]) / 2 for a in (z, y, x))
    stored, series = data["data"], None
    if at is not None:
        series = VolumesInTime(np.asarray(data["time"][:]), stored)
        stored = series.each()[at]
    grid = Grid(stored.shape, size, centre, pitch)  # type: ignore[arg-type]
    parameters = {name: _own_value(node) for name, node in process["parameters"].items()}
    return ReconRecord(
        volume=Volume(stored, grid),
        length_unit=str(data["x"].attrs["units"]),
        raw_file=str(parameters.pop("raw_file")),
        title=str(_own_value(entry["title"])),
        sample=str(_own_value(entry["sample/name"])),
        time=datetime.fromisoformat(str(value_of(process["date"]))).timestamp(),
        parameters=parameters,
        metrics={name: float(hdf5.values_of(node)) for name, node in process["metrics"].items()},
        history={name: np.asarray(hdf5.values_of(node)) for name, node in process["history"].items()},
        model={name: value_of(node, _MODEL) for name, node in process.get("gaussians", {}).items()},
        deviation=data.get(DEVIATION),
        fbp=data.get(FBP),
        kind=VoxelKind.of_unit(str(data["data"].attrs.get("units"))),
        series=series,
    )


def _pitch(axis: NDArray[np.floating]) -> float | None:
    """From voxel to voxel; None of one voxel."""
    return float(axis[-1] - axis[0]) / (axis.size - 1) if axis.size > 1 else None


def _own_value(node: h5py.Dataset) -> Value:
    return "" if hdf5.is_foreign(node) else value_of(node)


def value_of(node: h5py.Dataset, most: float = hdf5.BRIEF) -> Value:
    """What a dataset of so many bytes at most holds, as plain text or number where it is one."""
    value = hdf5.values_of(node, most)
    if isinstance(value, bytes):
        return value.decode()
    return value.item() if isinstance(value, np.generic) else value
