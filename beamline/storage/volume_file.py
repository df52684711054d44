"""Volume file: a volume [z, y, x] from TIFF, NumPy, NIfTI or HDF5, for whoever wants voxels and not a scan."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import h5py
import numpy as np
import tifffile
from numpy.typing import NDArray

from beamline.errors import DataError
from beamline.storage import hdf5
from beamline.storage.nifti import read_nifti

SUFFIXES = (".tif", ".tiff", ".npy", ".npz", ".nii", ".nii.gz", ".h5", ".hdf5", ".nxs")


def read_volume(
    path: Path, dataset: str | None = None
) -> tuple[NDArray[np.generic], tuple[float, float, float] | None]:
    """The volume, and mm from voxel to voxel along its axes where the file says (NIfTI; an .npz by its `voxel_mm`).

    Args:
        dataset: path in an HDF5 file or name in an .npz; None: the only array of three axes.

    Raises:
        DataError: no file of these kinds, not readable, or no such array in it.
    """
    name = path.name.lower()
    if not path.is_file():
        raise DataError(f"There is no volume {path}.")
    if dataset is not None and name.endswith((".tif", ".tiff", ".npy", ".nii", ".nii.gz")):
        raise DataError(f"{path} holds one volume; a dataset ({dataset!r}) belongs to an HDF5 file or an .npz.")
    if name.endswith((".nii", ".nii.gz")):
        return read_nifti(path)
    if name.endswith((".h5", ".hdf5", ".nxs")):
        with hdf5.open_hdf5(path) as file:
            return _from_hdf5(path, file, dataset), None
    try:
        if name.endswith((".tif", ".tiff")):
            return tifffile.imread(path), None
        if name.endswith((".npy", ".npz")):
            return _from_numpy(path, dataset)
    except (tifffile.TiffFileError, OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError(f"{path} cannot be read ({error}).") from error
    raise DataError(f"{path} is no volume file that is known; the kinds are {', '.join(SUFFIXES)}.")


def _from_numpy(path: Path, name: str | None) -> tuple[NDArray[np.generic], tuple[float, float, float] | None]:
    loaded = np.load(path, allow_pickle=False)
    if isinstance(loaded, np.ndarray):
        return loaded, None
    with loaded:
        arrays = {key: loaded[key] for key in loaded.files}
    name = _only(path, {key: array.ndim for key, array in arrays.items()}) if name is None else name
    if name not in arrays:
        raise DataError(f"{path} has no array {name!r}; it has {', '.join(arrays)}.")
    spacing = arrays.get("voxel_mm")
    if spacing is None or spacing.ndim != 0 or not (np.issubdtype(spacing.dtype, np.floating) and spacing > 0):
        return arrays[name], None
    return arrays[name], (float(spacing),) * 3


def _from_hdf5(path: Path, file: h5py.File, name: str | None) -> NDArray[np.generic]:
    if name is None:
        found: dict[str, int] = {}
        file.visititems(
            lambda key, item: (
                found.update({key: item.ndim}) if isinstance(item, h5py.Dataset) and item.ndim == 3 else None
            )
        )
        name = _only(path, found)
    item = file.get(name)
    if not isinstance(item, h5py.Dataset):
        raise DataError(f"{path} has no dataset {name!r}.")
    try:
        return item[()]
    except (OSError, RuntimeError) as error:
        raise DataError(f"{path}: {name} cannot be read ({error}).") from error


def _only(path: Path, axes: dict[str, int]) -> str:
    volumes = [name for name, n in axes.items() if n == 3]
    if len(volumes) != 1:
        raise DataError(
            f"{path} holds {len(volumes)} volumes ({', '.join(volumes) or 'none'}); name one as its dataset."
        )
    return volumes[0]
