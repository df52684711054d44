"""Arrays behind names: a .npy or a Zarr (a folder or .zip), as an HDF5 file with its datasets is."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from beamline.core.errors import DataError
from beamline.core.files import require_regular
from beamline.storage import hdf5
from beamline.storage.foreign_zarr import METADATA, is_zarr, zarr_library

_MOST = 1000  # arrays and groups of a Zarr that are looked at


@dataclass(frozen=True)
class NamedArray:
    """An array with what is asked of a dataset of HDF5: name, file, attrs, shape, dtype, chunks; values by slices."""

    array: Any
    name: str
    file: Arrays
    attrs: Mapping[str, Any]
    chunks: tuple[int, ...] | None
    is_virtual: bool = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self.array, name)

    def __getitem__(self, part: Any) -> Any:
        try:
            return np.asarray(self.array[part])
        except Exception as error:  # whatever the codecs of a Zarr raise for a damaged chunk
            raise OSError(f"{type(error).__name__}: {error}") from error


class Arrays(dict[str, NamedArray]):
    """The arrays of a file by the paths of their names; "" is the only one of a file."""

    def __init__(self, path: Path) -> None:
        """Open. What NumPy and zarr raise for a file that cannot be read."""
        self.filename, self.attrs, self.close = str(path), dict[str, Any](), lambda: None
        if path.suffix.lower() == _NUMPY:
            require_regular(path)
            found: dict[str, Any] = {"": np.load(path, mmap_mode="r", allow_pickle=False)}
        else:
            zarr, store = zarr_library(path), str(path)
            if path.is_file():
                store = zarr.storage.ZipStore(path, mode="r")
                self.close = store.close
            root = zarr.open(store=store, path=zarr_root(path) or "", mode="r")
            members = [("", root)] if hasattr(root, "chunks") else islice(root.members(max_depth=None), _MOST)
            found, self.attrs = {name: item for name, item in members if hasattr(item, "chunks")}, dict(root.attrs)
        for name, array in found.items():
            self[name] = NamedArray(
                array, f"/{name}", self, dict(getattr(array, "attrs", {})), getattr(array, "chunks", None)
            )

    def __missing__(self, path: str) -> NamedArray:
        name = path.strip("/")
        if name not in self and (name or len(self) != 1):
            raise KeyError(path)
        return self.get(name) or next(iter(self.values()))


def opened(path: Path, follow: bool = False) -> Any:
    """A file with arrays by their names: HDF5, which may still grow, or `Arrays`."""
    return Arrays(path) if holds_arrays(path) else hdf5.open_hdf5(path, follow)


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
    with suppress(OSError, zipfile.BadZipFile):
        if path.suffix.lower() == ".zip":
            with zipfile.ZipFile(path) as packed:
                names = [name for name in packed.namelist() if name.rpartition("/")[2] in METADATA]
            return min(names, key=len).rpartition("/")[0] if names else None
    return None
