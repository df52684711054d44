"""The formats of volume files, by the suffix of a name; writing one as a whole, and opening one slice by slice."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import bring_to_disk, whole_file
from beamline.storage import hdf5
from beamline.storage.foreign_zarr import is_zarr, open_zarr
from beamline.storage.readers.base import Opening
from beamline.storage.readers.open import FORMATS as SCANS
from beamline.storage.recon_record import ReconRecord
from beamline.storage.volume_file import read_volume
from beamline.storage.volumes.base import Pixels, Slices, VolumeFormat, bare_record
from beamline.storage.volumes.registry import formats
from beamline.storage.volumes.single_files import NexusVolume, Npy, NXtomoproc
from beamline.storage.writers.recon_file import (
    SUFFIXES,
    opened_reconstruction,
    volumes_in_time,
    write_reconstruction,
)
from recon.base.registry import did_you_mean


def format_of(path: Path) -> VolumeFormat:
    """The format of a file name, by its suffix.

    Raises:
        ValueError: for none; the message lists those that there are.
    """
    suffix = path.suffix.lower()
    if not path.name or (not suffix and path.name.startswith(".")):
        raise ValueError(f"{str(path)!r} is not the name of a volume; expected one such as volume.h5.")
    kind_of_file = next((kind for kind in formats() if suffix in kind.suffixes), None)
    if kind_of_file is None:
        known = ", ".join(f"{' '.join(kind.suffixes) or 'no suffix'} ({kind.name})" for kind in formats())
        if path.name.lower().endswith((".nii", ".nii.gz")):
            raise ValueError(
                f"{str(path)!r}: NIfTI is read, not written; .nrrd holds the same, and programs that read NIfTI read it"
            )
        raise ValueError(
            f"{str(path)!r}: the suffix names the format of a volume; {suffix!r} is not known, expected {known}"
            f"{did_you_mean(suffix, [each for kind in formats() for each in kind.suffixes])}."
        )
    return kind_of_file


def write_volume(path: Path, record: ReconRecord, pixels: Pixels | None = None, *, replace: bool = False) -> int:
    """Write a volume in the format of the suffix of `path`, slice by slice; on an error no file remains.

    Args:
        pixels: default: float32.
        replace: a file takes the place of an older one; a folder never does.

    Returns:
        how many voxels the window clipped.

    Raises:
        ValueError: an unknown suffix, or grey values in a format without.
        DataError: `path` exists and `replace` is not set, or the disk refuses; nothing is left.
    """
    kind, pixels = format_of(path), pixels or Pixels()
    if record.series is not None:
        if path.suffix.lower() not in SUFFIXES:
            raise ValueError(f"a time series can only be written to HDF5, not to {kind.name}")
        write_reconstruction(path, record, replace=replace)
        return 0
    if pixels.window is not None and not kind.greys:
        raise ValueError(f"{kind.name} holds the values themselves (float32); leave bits and window out.")
    slices = Slices(record.volume, pixels)
    with whole_file(path, replace=replace) as partial:
        kind.write(partial, record, slices)
        bring_to_disk(partial)
    return slices.outside


def volume_format(path: Path) -> VolumeFormat | None:
    """The format of a volume that this program wrote, of an .npy that is no scan, or of a NeXus file with a volume as
    its plot; None for other files.
    """
    kind_of_file = next((kind for kind in (*formats(), NexusVolume()) if kind.holds(path)), None)
    # Voxels alone say nothing of where they come from: a reader of scans goes first.
    if isinstance(kind_of_file, Npy) and any(scan.recognises(path, Opening()) for scan in SCANS):
        return None
    return kind_of_file


def whole_volume(
    path: Path, dataset: str | None = None
) -> tuple[NDArray[np.generic], tuple[float, float, float] | None]:
    """`read_volume`, also for every format that this program writes, with the voxel size that the file states.

    Raises:
        DataError: as `opened_volume`.
    """
    kind = None if dataset is not None else volume_format(path)
    if kind is None or isinstance(kind, NXtomoproc | Npy):
        return read_volume(path, dataset)
    with kind.open(path) as record:
        values = np.asarray(record.volume.data[: record.volume.grid.shape[0]])
        return values, record.volume.grid.spacing if record.length_unit == "mm" else None


def times_of(path: Path) -> tuple[float, ...]:
    """Time of each of several volumes, in s from the first view on; empty if the file has no time series."""
    if not NXtomoproc().holds(path):
        return ()
    with hdf5.open_hdf5(path) as file, hdf5.readable(path):
        return tuple(file["entry/data/time"][:].tolist()) if volumes_in_time(file) else ()


@contextmanager
def opened_volume(path: Path, dataset: str | None = None, at: int | None = None) -> Iterator[ReconRecord]:
    """Open any volume file: one of this program is read when it is sliced along z, others are read wholly (see
    `read_volume`).

    Args:
        at: number of one of several volumes in time.

    Raises:
        DataError: it cannot be read, or holds no volume.
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
        raise DataError(f"{path} holds {values.dtype} of shape {values.shape}; expected real numbers [z, y, x].")
    yield bare_record(path, values, spacing)
