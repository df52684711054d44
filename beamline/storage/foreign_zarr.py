"""Volumes in a Zarr, versions 2 and 3 with any codec, by the format's library where it is installed; and the arrays of
a Zarr or an .npy by their names, as an HDF5 file has datasets.

Axes, scales and units are those of ngff.openmicroscopy.org, 0.4 and 0.5; translations are left out.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import require_regular
from beamline.core.machine import free_memory
from beamline.storage import hdf5
from beamline.storage.packing import packing
from beamline.storage.structure import numbers_of, shape_of

METADATA = "zarr.json", ".zgroup", ".zarray"  # one of them is in the folder of a Zarr
_MM = {"angstrom": 1e-7, "nanometer": 1e-6, "micrometer": 1e-3, "millimeter": 1.0, "centimeter": 10.0, "meter": 1e3}

Spacing = tuple[float, float, float]


def is_zarr(path: Path) -> bool:
    """Whether a folder is a Zarr store, written by any program."""
    return any((path / name).is_file() for name in METADATA)


@dataclass(frozen=True)
class ZarrScale:
    """A scale of a volume, read box by box: an array [..., z, y, x] of a Zarr store whose leading axes have length one.

    Attributes:
        coarser: the same volume with fewer voxels.
    """

    path: Path
    array: Any
    coarser: tuple[ZarrScale, ...] = ()

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.array.shape[-3:]

    @property
    def chunk(self) -> tuple[int, int, int]:
        return self.array.chunks[-3:]

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(self.array.dtype)

    def __getitem__(self, part: slice) -> NDArray[Any]:
        return self._read(part)

    def box(self, first: tuple[int, int, int], end: tuple[int, int, int]) -> NDArray[Any]:
        """The voxels of a box."""
        return self._read(*map(slice, first, end))

    def _read(self, *parts: slice) -> NDArray[Any]:
        lead = (0,) * (self.array.ndim - 3)
        try:
            return np.asarray(self.array[(*lead, *parts, *[slice(None)] * (3 - len(parts)))])
        except Exception as error:  # whatever its codecs raise for a damaged chunk
            raise DataError(f"{self.path} cannot be read ({type(error).__name__}: {error}).") from error


def zarr_library(path: Path) -> Any:
    """The package zarr. DataError: it is not installed."""
    try:
        import zarr
    except ImportError as error:
        raise DataError(
            f"{path}: a Zarr needs zarr, which cannot be loaded here ({error}): pip install splatline[zarr]."
        ) from error
    return zarr


def open_zarr(path: Path, dataset: str | None = None) -> tuple[ZarrScale, Spacing | None]:
    """The finest scale of an OME-Zarr with the coarser ones, or the array `dataset`; voxel size in mm, if stated.

    Raises:
        DataError: no library, not readable, no volume, or several channels or times.
    """
    zarr = zarr_library(path)
    try:
        root: Any = zarr.open(store=str(path), mode="r")
        image = root.attrs.get("ome", root.attrs).get("multiscales", [{}])[0]
        names = [each["path"] for each in image.get("datasets", [])] if dataset is None else [dataset]
        arrays: list[Any] = [root] if hasattr(root, "chunks") else [root[name] for name in names]
        spacing = _spacing(image, arrays[0].ndim, names[0]) if arrays and names else None
    except Exception as error:  # readers of foreign files raise various errors if one is damaged
        raise DataError(f"{path} cannot be read as a Zarr ({type(error).__name__}: {error}).") from error
    if not arrays:
        raise DataError(f"{path} is not an OME-Zarr image; name an array in it, in `view` as {path.name}::NAME.")
    finest, *coarser = arrays
    _require_volume(path, finest)
    scales = [finest, *(array for array in coarser if is_halved(finest.shape[-3:], array))]
    for array in scales:
        _require_chunks(path, array)
    if spacing is not None and not all(0 < step < np.inf for step in spacing):
        raise DataError(f"{path} states voxels of {spacing} mm; expected lengths above 0. Nothing was read.")
    return ZarrScale(path, finest, tuple(ZarrScale(path, array) for array in scales[1:])), spacing


def _require_volume(path: Path, array: Any) -> None:
    """DataError for an array that is no volume of real numbers."""
    if array.ndim < 3 or any(n != 1 for n in array.shape[:-3]) or np.dtype(array.dtype).kind not in "uifb":
        raise DataError(
            f"{path} holds {array.dtype} of shape {array.shape}; expected real numbers [z, y, x], of one time and "
            "one channel. Copy one to a separate file."
        )


def _require_chunks(path: Path, array: Any) -> None:
    """DataError for an impossible shape, and for chunks that the memory does not hold."""
    try:
        shape_of(array.shape[-3:])
        piece = math.prod(shape_of(array.chunks[-3:], "chunk")) * np.dtype(array.dtype).itemsize
    except ValueError as error:
        raise DataError(f"{path} cannot be read as a Zarr ({error}).") from error
    if piece > free_memory():
        raise DataError(f"{path} has chunks of {piece / 1e9:.3g} GB, more than the memory that is free.")


def _spacing(image: Mapping[str, Any], axes: int, name: str) -> Spacing | None:
    """None where a unit or the size is not stated."""
    (mine,) = [each for each in image.get("datasets", []) if each["path"] == name] or [{}]
    steps = [*mine.get("coordinateTransformations", []), *image.get("coordinateTransformations", [])]
    scales = [numbers_of(step["scale"], axes, "scale")[-3:] for step in steps if step["type"] == "scale"]
    units = [_MM.get(axis.get("unit", "")) for axis in image.get("axes", [])[axes - 3 :] if isinstance(axis, Mapping)]
    if not scales or len(units) != 3 or None in units:
        return None
    z, y, x = (np.prod(scales, axis=0) * np.asarray(units, float)).tolist()
    return z, y, x


def is_halved(finest: tuple[int, ...], array: Any) -> bool:
    """Whether halving one shape repeatedly gives the shape of an array, along each axis, rounded either way."""
    shape = getattr(array, "shape", ())[-3:]  # a group has none
    if len(shape) < 3 or min(*shape, *finest) < 1:
        return False
    steps = [2 ** round(np.log2(n / m)) for n, m in zip(finest, shape, strict=True)]
    return all(m in (n // by, -(-n // by)) for n, m, by in zip(finest, shape, steps, strict=True))


_MOST = 1000  # arrays and groups of a Zarr that are looked at


class NamedArray:
    """An array with what is asked of a dataset of HDF5: name, file, attrs, shape, dtype, chunks; values by slices."""

    is_virtual = False

    def __init__(self, array: Any, name: str, file: ArrayFile) -> None:
        self.array, self.name, self.file, self.attrs = array, name, file, dict(getattr(array, "attrs", {}))
        self.chunks: tuple[int, ...] | None = getattr(array, "chunks", None)
        packed = None
        if array.dtype.kind in "uif":
            packed = packing(self.attrs, array.dtype, f"{name} in {file.filename}", by_cil=False)
        self._values, self.dtype = (
            packed or np.asarray,
            np.result_type(array.dtype, np.float32) if packed else array.dtype,
        )

    def __getattr__(self, name: str) -> Any:
        return getattr(self.array, name)

    def __getitem__(self, part: Any) -> Any:
        try:
            return self._values(self.array[part])
        except Exception as error:  # whatever the codecs of a Zarr raise for a damaged chunk
            raise OSError(f"{type(error).__name__}: {error}") from error


class ArrayFile(dict[str, NamedArray]):
    """The arrays of a file by the paths of their names; "" is the only one of a file."""

    def __init__(self, path: Path) -> None:
        self.filename, self.attrs, self.close = str(path), dict[str, Any](), lambda: None
        if path.suffix.lower() == _NUMPY:
            require_regular(path)
            arrays: dict[str, Any] = {"": np.load(path, mmap_mode="r", allow_pickle=False)}
        else:
            zarr, store = zarr_library(path), str(path)
            if path.is_file():
                store = zarr.storage.ZipStore(path, mode="r")
                self.close = store.close
            root = zarr.open(store=store, path=zarr_root(path) or "", mode="r")
            members = [("", root)] if hasattr(root, "chunks") else islice(root.members(max_depth=None), _MOST)
            arrays, self.attrs = {name: item for name, item in members if hasattr(item, "chunks")}, dict(root.attrs)
        self.update({name: NamedArray(array, f"/{name}", self) for name, array in arrays.items()})

    def __missing__(self, path: str) -> NamedArray:
        name = path.strip("/")
        if name not in self and (name or len(self) != 1):
            raise KeyError(path)
        return self.get(name) or next(iter(self.values()))


def open_array_file(path: Path, follow: bool = False) -> Any:
    """Open a file that has arrays by their names: HDF5, which may still grow, or `ArrayFile`."""
    return ArrayFile(path) if holds_arrays(path) else hdf5.open_hdf5(path, follow)


_NUMPY = ".npy"
_RUNS = (
    "{0} is a pickle, which is never opened here: it may run any program that its writer put into it. If you trust the "
    'writer, convert FILE (as NAF and SAX-NeRF have it): python -c "import numpy as np, pickle; d = pickle.load(open('
    "'FILE', 'rb')); np.save('views.npy', d['train']['projections']); np.save('angles.npy', d['train']['angles']); "
    'print({k: v for k, v in d.items() if np.size(v) < 9})". It prints DSO, DSD and dDetector in mm. Then: beamline '
    "recon views.npy --angles angles.npy --angles-unit rad --quantity line-integrals --cone DSO:DSD --pixel-size-um "
    "1000*dDetector. Nothing was read."
)
_PACKED = (
    '{0} holds arrays saved by Python, which are read from an .npy: python -c "import numpy as np; d = np.load('
    "'FILE'); [np.save(n + '.npy', d[n]) for n in d.files]; print(d.files)\" writes one for each. `beamline view` "
    "shows a volume of an .npz. Nothing was read."
)
_CONVERTED = {".npz": _PACKED, **dict.fromkeys((".pickle", ".pkl", ".pck"), _RUNS)}
"""How files that are not read become some that are, by suffix."""


def holds_arrays(path: Path) -> bool:
    """Whether a path is an .npy, or a Zarr. DataError: a file whose arrays are read once they are converted."""
    if path.is_file() and (way := _CONVERTED.get(path.suffix.lower())):
        raise DataError(way.replace("{0}", str(path)))
    return (path.suffix.lower() == _NUMPY and path.is_file()) or zarr_root(path) is not None


def zarr_root(path: Path) -> str | None:
    """Where in a folder or .zip a Zarr begins; None without one."""
    if path.is_dir():
        return "" if is_zarr(path) else None
    if path.suffix.lower() != ".zip" or not path.is_file() or not zipfile.is_zipfile(path):
        return None
    with zipfile.ZipFile(path) as packed:
        names = [name.rpartition("/") for name in packed.namelist()]
    return min((folder for folder, _, name in names if name in METADATA), key=len, default=None)
