"""Writes a volume in the format that the suffix of the file name selects, and opens volume files slice by slice."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.events import json_of
from beamline.core.files import atomic_file, bring_to_disk
from beamline.core.quantities import VoxelKind
from beamline.storage import datasets, hdf5
from beamline.storage.array_file import is_zarr
from beamline.storage.foreign_zarr import open_zarr
from beamline.storage.readers.base import Opening
from beamline.storage.readers.formats import FORMATS as SCANS
from beamline.storage.readers.tiff import VOLUME
from beamline.storage.recon_record import ReconRecord
from beamline.storage.structure import dtype_of, require_held, require_npy, shape_of
from beamline.storage.volume_file import axes_of, has_only_a_volume, read_volume
from beamline.storage.volumes import REGISTRY, formats
from beamline.storage.volumes.base import Pixels, Slices, VolumeFormat, bare_record, facts_of, marked, record_of
from beamline.storage.writers.recon_file import (
    DEFINITION,
    SUFFIXES,
    opened_reconstruction,
    volumes_in_time,
    write_reconstruction,
    write_record,
)
from recon.base.registry import did_you_mean
from recon.base.volume import Volume


@dataclass(frozen=True)
class NXtomoproc:
    """HDF5 with float32 voxels, all settings, figures of merit and the history."""

    name: str = "HDF5 (NXtomoproc)"
    suffixes: tuple[str, ...] = REGISTRY["hdf5"].suffixes
    greys: bool = False

    def write(self, path: Path, record: ReconRecord, slices: Slices) -> None:
        write_record(path, record)

    def holds(self, path: Path) -> bool:
        if not path.is_file() or not hdf5.is_hdf5(path):
            return False
        with hdf5.readable(path):
            try:
                with hdf5.open_hdf5(path) as file:
                    return datasets.text_at(file, "entry/definition") == DEFINITION
            except (DataError, OSError, TypeError):
                return False

    def open(self, path: Path) -> AbstractContextManager[ReconRecord]:
        return opened_reconstruction(path)


@dataclass(frozen=True)
class NexusVolume:
    """HDF5 whose default plot has the axes z, y, x: a ground truth of `simulate`, or labels of `structure`. This format
    is only read.
    """

    name: str = "HDF5 (NXdata)"
    suffixes: tuple[str, ...] = ()
    greys: bool = False

    def write(self, path: Path, record: ReconRecord, slices: Slices) -> None:
        raise ValueError(f"{self.name} can be read but not written; choose the format {NXtomoproc().name} instead.")

    def holds(self, path: Path) -> bool:
        if not path.is_file() or not hdf5.is_hdf5(path):
            return False
        try:
            with hdf5.open_hdf5(path) as file:
                return _plotted(file) is not None
        except (DataError, *hdf5.ALTERED):
            return False

    @contextmanager
    def open(self, path: Path) -> Iterator[ReconRecord]:
        with hdf5.open_hdf5(path) as file, hdf5.readable(path):
            values = _plotted(file)
            assert values is not None
            spacing, first = axes_of(file, str(values.name))
            record = bare_record(path, values, spacing)
            if spacing is not None and first is not None:
                half = [(n - 1) / 2 * edge for n, edge in zip(values.shape, spacing, strict=True)]
                z, y, x = (low + middle for low, middle in zip(first, half, strict=True))
                grid = replace(record.volume.grid, centre=(z, y, x))
                record = replace(record, volume=Volume(values, grid))
            yield replace(record, kind=VoxelKind.of_unit(datasets.attribute(values, "units")))


def _plotted(file: h5py.File) -> h5py.Dataset | None:
    """The volume [z, y, x] to which the attributes `default` and `signal` of the file lead; None if there is no such
    volume.
    """
    entry = datasets.resolve(file, datasets.attribute(file, "default") or "entry")
    data = (
        datasets.resolve(entry, datasets.attribute(entry, "default") or "data")
        if isinstance(entry, h5py.Group)
        else None
    )
    if not isinstance(data, h5py.Group) or [datasets.text(name) for name in data.attrs.get("axes", ())] != [
        "z",
        "y",
        "x",
    ]:
        return None
    values = datasets.dataset(data, datasets.attribute(data, "signal"))
    return values if values is not None and values.ndim == 3 and values.dtype.kind in "uif" else None


_TYPES = {32: "float", 16: "uint16", 8: "uint8"}
_LONGEST_HEADER = 2**20
_KEY = b"splatline:="


@dataclass(frozen=True)
class Nrrd:
    """NRRD 4 (teem.sourceforge.net/nrrd/format.html), raw, with an attached header. The metadata are JSON under
    `splatline`.
    """

    name: str = "NRRD"
    suffixes: tuple[str, ...] = REGISTRY["nrrd"].suffixes
    greys: bool = True

    def write(self, path: Path, record: ReconRecord, slices: Slices) -> None:
        grid, nz, ny, nx = record.volume.grid, *slices.shape
        z, y, x = (float(centres[0]) for centres in grid.coordinates())
        dz, dy, dx = (float(edge) for edge in grid.spacing)
        units = f'space units: "{record.length_unit}" "{record.length_unit}" "{record.length_unit}"\n'
        facts = json_of(facts_of(record, slices.pixels))
        header = (
            f"NRRD0004\ntype: {_TYPES[slices.pixels.bits]}\ndimension: 3\nspace dimension: 3\nsizes: {nx} {ny} {nz}\n"
            f"space directions: ({dx!r},0,0) (0,{dy!r},0) (0,0,{dz!r})\nkinds: space space space\nendian: little\n"
            f"encoding: raw\n{units}space origin: ({x!r},{y!r},{z!r})\n"
        ).encode("ascii")
        with path.open("xb") as file:
            escaped = facts.replace("\\", "\\\\")  # JSON contains no line ends, which NRRD would have to escape
            file.write(header + _KEY + escaped.encode("ascii") + b"\n\n")
            for values in slices:
                file.write(values.data)

    def holds(self, path: Path) -> bool:
        return path.name.lower().endswith(self.suffixes) and path.is_file() and VOLUME.encode() in _header(path)[0]

    @contextmanager
    def open(self, path: Path) -> Iterator[ReconRecord]:
        header, begin = _header(path)
        fields = dict(line.split(b": ", 1) for line in header.splitlines() if b": " in line and b":=" not in line)
        notes = [line.removeprefix(_KEY) for line in header.splitlines() if line.startswith(_KEY)]
        kinds = {name.encode(): bits for bits, name in _TYPES.items()}
        try:
            facts = marked(notes[0].decode("ascii").replace("\\\\", "\\")) if len(notes) == 1 else None
            if facts is None:
                raise ValueError(f"the field {_KEY.decode()} was not written by this program")
            shape = shape_of([int(n) for n in fields[b"sizes"].split()][::-1])
            dtype = dtype_of({32: "<f4", 16: "<u2", 8: "u1"}[kinds[fields[b"type"]]])
            require_held(shape, dtype, begin, path.stat().st_size)
            values = np.memmap(path, dtype, "r", begin, shape)
        except (KeyError, ValueError, OSError) as error:
            raise DataError(
                f"{path} cannot be read as a volume ({error}): the file is cut off or was changed."
            ) from error
        yield record_of(path, facts, values)


@dataclass(frozen=True)
class Npy:
    """NumPy's own format: only the voxels and their shape."""

    name: str = "npy"
    suffixes: tuple[str, ...] = REGISTRY["npy"].suffixes
    greys: bool = True

    def write(self, path: Path, record: ReconRecord, slices: Slices) -> None:
        header = {"descr": slices.pixels.dtype.str, "fortran_order": False, "shape": slices.shape}
        with path.open("xb") as file:
            np.lib.format.write_array_header_1_0(file, header)
            for values in slices:
                file.write(values.data)

    def holds(self, path: Path) -> bool:
        """True if the file is an array of numbers with three axes."""
        if not (path.name.lower().endswith(self.suffixes) and path.is_file()):
            return False
        try:
            with path.open("rb") as file:
                shape, dtype = require_npy(file)
        except (OSError, ValueError, EOFError, OverflowError, TypeError):
            return False
        return len(shape) == 3 and dtype.kind in "uif"

    @contextmanager
    def open(self, path: Path) -> Iterator[ReconRecord]:
        yield bare_record(path, np.load(path, mmap_mode="r", allow_pickle=False))


@dataclass(frozen=True)
class Npz:
    """NumPy's archive: a volume that the library saved, or a single array. This format is only read."""

    name: str = "npz"
    suffixes: tuple[str, ...] = ()
    greys: bool = False

    def write(self, path: Path, record: ReconRecord, slices: Slices) -> None:
        raise ValueError(f"{self.name} can be read but not written; choose the format {NXtomoproc().name} instead.")

    def holds(self, path: Path) -> bool:
        return path.name.lower().endswith(".npz") and path.is_file() and has_only_a_volume(path)

    @contextmanager
    def open(self, path: Path) -> Iterator[ReconRecord]:
        yield bare_record(path, *read_volume(path))


def _header(path: Path) -> tuple[bytes, int]:
    """The header of an NRRD, and the position at which its data begin; (b"", 0) if the file has no header."""
    with path.open("rb") as file:
        head = file.read(_LONGEST_HEADER)
    end = head.find(b"\n\n")
    return (head[:end], end + 2) if head.startswith(b"NRRD") and end >= 0 else (b"", 0)


def format_of(path: Path) -> VolumeFormat:
    """The format of a file name, by its suffix.

    Raises:
        ValueError: no format has this suffix; the message lists the suffixes of all formats.
    """
    suffix = path.suffix.lower()
    if not path.name or (not suffix and path.name.startswith(".")):
        raise ValueError(f"{str(path)!r} is not the name of a volume; expected a name such as volume.h5.")
    kind_of_file = next((kind for kind in formats() if suffix in kind.suffixes), None)
    if kind_of_file is None:
        known = ", ".join(f"{' '.join(kind.suffixes) or 'no suffix'} ({kind.name})" for kind in formats())
        if path.name.lower().endswith((".nii", ".nii.gz")):
            raise ValueError(
                f"{str(path)!r}: NIfTI can be read but not written. Write .nrrd instead: NRRD stores the same values "
                "and sizes, and programs that read NIfTI also read NRRD"
            )
        raise ValueError(
            f"{str(path)!r}: the suffix of a volume's name selects its format. {suffix!r} is unknown; "
            "expected "
            f"{known}{did_you_mean(suffix, [each for kind in formats() for each in kind.suffixes])}."
        )
    return kind_of_file


def write_volume(path: Path, record: ReconRecord, pixels: Pixels | None = None, *, replace: bool = False) -> int:
    """Write a volume, slice by slice, in the format that the suffix of `path` selects. After an error no file remains.

    Args:
        pixels: how voxels are stored; default: float32.
        replace: True: a file may replace an older file. A folder never replaces an older one.

    Returns:
        the number of voxels that the window clipped.

    Raises:
        ValueError: the suffix is unknown, or the format cannot store grey values.
        DataError: `path` exists and `replace` is False, or the disk failed. No new file is left.
    """
    kind, pixels = format_of(path), pixels or Pixels()
    if record.series is not None:
        if path.suffix.lower() not in SUFFIXES:
            raise ValueError(f"a time series can only be written to HDF5, not to {kind.name}")
        write_reconstruction(path, record, replace=replace)
        return 0
    if pixels.window is not None and not kind.greys:
        raise ValueError(f"Omit bits and window: {kind.name} stores the values themselves (float32).")
    slices = Slices(record.volume, pixels)
    with atomic_file(path, replace=replace) as partial:
        kind.write(partial, record, slices)
        bring_to_disk(partial)
    return slices.outside


def volume_format(path: Path) -> VolumeFormat | None:
    """The format of a file that is a volume: written by this program, or an .npy that is not a scan, or an .npz with
    a volume alone, or a NeXus file whose default plot is a volume. None for other files.
    """
    kind_of_file = next((kind for kind in (*formats(), NexusVolume(), Npz()) if kind.holds(path)), None)
    # Voxels alone do not show their origin, so the readers of scans are asked first.
    if isinstance(kind_of_file, Npy) and any(scan.recognises(path, Opening()) for scan in SCANS):
        return None
    return kind_of_file


def whole_volume(
    path: Path, dataset: str | None = None
) -> tuple[NDArray[np.generic], tuple[float, float, float] | None]:
    """Read a volume as `read_volume` does, but also from every format that this program writes. Also returns the voxel
    size that the file states.

    Raises:
        DataError: as for `opened_volume`.
    """
    kind = None if dataset is not None else volume_format(path)
    if kind is None or isinstance(kind, NXtomoproc | Npy | Npz):
        return read_volume(path, dataset)
    with kind.open(path) as record:
        values = np.asarray(record.volume.data[: record.volume.grid.shape[0]])
        return values, record.volume.grid.spacing if record.length_unit == "mm" else None


def times_of(path: Path) -> tuple[float, ...]:
    """Time of each of several volumes, in s from the first projection on; empty if the file has no time series."""
    if not NXtomoproc().holds(path):
        return ()
    with hdf5.open_hdf5(path) as file, hdf5.readable(path):
        return tuple(file["entry/data/time"][:].tolist()) if volumes_in_time(file) else ()


@contextmanager
def opened_volume(path: Path, dataset: str | None = None, at: int | None = None) -> Iterator[ReconRecord]:
    """Open a volume file of any format. A volume of this program is read when it is sliced along z. Other files are
    read completely (see `read_volume`).

    Args:
        at: index of the volume, if the file contains a time series.

    Raises:
        DataError: the file cannot be read, or it does not contain a volume.
    """
    if at is not None:
        with opened_reconstruction(path, at) as record:
            assert record.series is not None
            facts = {**record.parameters, "time_s": float(record.series.seconds[at])}
            yield dataclasses.replace(record, series=None, parameters=facts)
        return
    kind = None if dataset is not None else volume_format(path)
    if kind is not None:
        with kind.open(path) as record:
            yield record
        return
    if is_zarr(path):
        yield bare_record(path, *open_zarr(path, dataset))
        return
    values, spacing = read_volume(path, dataset)
    if values.ndim != 3 or values.dtype.kind not in "uifb":
        raise DataError(f"{path} contains {values.dtype} of shape {values.shape}; expected real numbers [z, y, x].")
    yield bare_record(path, values, spacing)
