"""Opens the arrays of a Zarr, .npz or .npy file by name, in the same way as the datasets of an HDF5 file."""

from __future__ import annotations

import zipfile
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import require_regular
from beamline.core.machine import free_memory
from beamline.storage import hdf5
from beamline.storage.packing import packing
from beamline.storage.structure import require_npy

METADATA = "zarr.json", ".zgroup", ".zarray"  # the folder of a Zarr store contains one of these files


def is_zarr(path: Path) -> bool:
    """True if a folder is a Zarr store, written by any program."""
    return any((path / name).is_file() for name in METADATA)


def zarr_library(path: Path) -> Any:
    """The package zarr. Raises DataError if it cannot be loaded."""
    try:
        import zarr
    except ImportError as error:
        raise DataError(
            f"{path}: reading a Zarr needs the package zarr, which cannot be loaded ({error}): pip "
            "install splatline[zarr]."
        ) from error
    return zarr


_MOST = 1000  # most arrays and groups of a Zarr store that are searched


class NamedArray:
    """An array with the interface of an HDF5 dataset: it has name, file, attrs, shape, dtype and chunks, and a slice of
    it returns the values.
    """

    is_virtual = False

    def __init__(self, array: Any, name: str, file: ArrayFile) -> None:
        self.array, self.name, self.file, self.attrs = array, name, file, dict(getattr(array, "attrs", {}))
        self.chunks: tuple[int, ...] | None = getattr(array, "chunks", None)
        packed = None
        if array.dtype.kind in "uif":
            packed = packing(self.attrs, array.dtype, f"{name} in {file.filename}", by_cil=False)
        self._values = packed or np.asarray
        self.dtype = np.result_type(array.dtype, np.float32) if packed else array.dtype

    def __getattr__(self, name: str) -> Any:
        return getattr(self.array, name)

    def __getitem__(self, part: Any) -> Any:
        try:
            return self._values(self.array[part])
        except Exception as error:  # the codecs of a Zarr raise errors of any class for a damaged chunk
            raise OSError(f"{type(error).__name__}: {error}") from error


class ArrayFile(dict[str, NamedArray]):
    """The arrays of a file by their paths. If a file has a single array without a name, its path is ""."""

    def __init__(self, path: Path) -> None:
        self.filename, self.attrs, self.close = str(path), dict[str, Any](), lambda: None
        if path.suffix.lower() in _NUMPY:
            require_regular(path)
            arrays = dict[str, Any](numpy_arrays(path, "r"))
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


def numpy_arrays(path: Path, mapped: Literal["r"] | None = None) -> dict[str, NDArray[Any]]:
    """Reads the arrays of an .npz into memory, by name. The array of an .npy has the name "".

    Raises:
        DataError: the arrays do not fit into memory, or some of them contain Python objects.
        ValueError, OSError, ...: a damaged file.
    """
    try:
        # opened here, because numpy does not close an archive that turns out to be damaged
        with path.open("rb") as file:
            if file.peek(1)[:1] == b"\x93":
                require_npy(file)
                return {"": np.load(path, mmap_mode=mapped, allow_pickle=False)}
            with np.load(file, allow_pickle=False) as packed:
                members = [each for each in packed.zip.infolist() if each.filename.endswith(".npy")]
                require_room(path, sum(each.file_size for each in members))
                return {name: packed[name] for name in (each.filename.removesuffix(".npy") for each in members)}
    except ValueError as error:
        if "bject" not in str(error):
            raise
        raise DataError(
            f"Save the arrays alone (numpy.save, numpy.savez): {path} contains Python objects among its arrays. Such "
            "objects are pickles, which this program never opens, because a pickle can run any program. Nothing was "
            "read."
        ) from error


def require_room(path: Path, n: int) -> None:
    """Raise DataError if `n` bytes exceed the free memory. A damaged file may state any size."""
    if n > (free := free_memory()):
        needed_gb = n / 1e9
        free_gb = free / 1e9
        raise DataError(
            f"{path} does not fit in memory: its header states {needed_gb:.3g} GB, and {free_gb:.3g} GB are free. "
            "Crop or bin the volume."
        )


def open_array_file(path: Path, follow: bool = False) -> Any:
    """Open a file with named arrays: an HDF5 file, which may still grow, or an `ArrayFile`."""
    return ArrayFile(path) if holds_arrays(path) else hdf5.open_hdf5(path, follow)


_PICKLE = (
    "{0} is a pickle, which this program never opens, because a pickle can run any program that its "
    "author put into it. If you trust the author, convert FILE (in the layout of NAF and SAX-NeRF) "
    "yourself: python -c \"import numpy as np, pickle; d = pickle.load(open('FILE', 'rb')); "
    "np.save('views.npy', d['train']['projections']); np.save('angles.npy', d['train']['angles']); "
    'print({k: v for k, v in d.items() if np.size(v) < 9})". This command prints DSO, DSD and dDetector in mm. '
    "Then: beamline recon views.npy --angles angles.npy --angles-unit rad --quantity line-integrals "
    "--cone DSO:DSD --pixel-size-um 1000*dDetector. Nothing was read."
)
_PICKLES, _NUMPY = (".pickle", ".pkl", ".pck"), (".npy", ".npz")


def holds_arrays(path: Path) -> bool:
    """True for the path of an .npy, an .npz or a Zarr. Raises DataError for a pickle; the message says how to convert
    it.
    """
    if path.is_file() and path.suffix.lower() in _PICKLES:
        raise DataError(_PICKLE.replace("{0}", str(path)))
    return (path.suffix.lower() in _NUMPY and path.is_file()) or zarr_root(path) is not None


def zarr_root(path: Path) -> str | None:
    """Path of the Zarr within a folder or .zip; None if there is none."""
    if path.is_dir():
        return "" if is_zarr(path) else None
    if path.suffix.lower() != ".zip" or not path.is_file() or not zipfile.is_zipfile(path):
        return None
    with zipfile.ZipFile(path) as packed:
        names = [name.rpartition("/") for name in packed.namelist()]
    return min((folder for folder, _, name in names if name in METADATA), key=len, default=None)
