"""Arrays behind names: a .npy, an .npz or a Zarr (a folder or .zip), with what is asked of an HDF5 file."""

from __future__ import annotations

import math
import zipfile
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from beamline.core.errors import DataError
from beamline.core.files import require_regular
from beamline.core.text import size
from beamline.storage.foreign_zarr import METADATA, is_zarr, zarr_library

_NUMPY = ".npy", ".npz"
_MOST = 1000  # arrays and groups of a Zarr that are looked at
_HELD = 2**30  # bytes of an .npz, which is read into memory
_LACKING: dict[str, Any] = {"chunks": None, "attrs": {}}  # what arrays of NumPy do not have


@dataclass(frozen=True)
class NamedArray:
    """An array, with what is asked of a dataset of HDF5: name, file, attrs, shape, dtype, chunks; values by slices."""

    array: Any
    name: str
    file: Arrays

    is_virtual = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self.array, name, _LACKING[name]) if name in _LACKING else getattr(self.array, name)

    def __getitem__(self, part: Any) -> Any:
        try:
            return np.asarray(self.array[part])
        except Exception as error:  # whatever the codecs of a Zarr raise for a damaged chunk
            raise OSError(f"{type(error).__name__}: {error}") from error


class Arrays:
    """The arrays of a file by their names, as paths of HDF5 are written; "" is the only one of a file."""

    def __init__(self, path: Path) -> None:
        """Open. DataError, or what NumPy raises, for a file that cannot be read."""
        self.filename, self._opened = str(path), list[Any]()
        found = self._of_numpy(path) if path.suffix.lower() in _NUMPY else self._of_zarr(path)
        self.items = {name.strip("/"): NamedArray(array, name, self) for name, array in found.items()}

    def get(self, name: str) -> NamedArray | None:
        """The array of this name; None if there is none."""
        only = next(iter(self.items.values())) if len(self.items) == 1 and not name.strip("/") else None
        return self.items.get(name.strip("/"), only)

    def _of_numpy(self, path: Path) -> dict[str, Any]:
        require_regular(path)
        if path.suffix.lower() == ".npy":
            return {"": np.load(path, mmap_mode="r", allow_pickle=False)}
        with np.load(path, allow_pickle=False) as packed:
            if (n := sum(member.file_size for member in packed.zip.infolist())) > _HELD:
                raise DataError(
                    f"{path} unpacks to {size(n)}, and an .npz is read as a whole, up to {size(_HELD)}. Save the "
                    "projections as .npy, which is read in parts: python -c \"import numpy as np; np.save('views.npy', "
                    f"np.load('{path}')['{packed.files[0]}'])\""
                )
            return {name: packed[name] for name in packed.files}

    def _of_zarr(self, path: Path) -> dict[str, Any]:
        zarr, store = zarr_library(path), str(path)
        if path.is_file():
            store = zarr.storage.ZipStore(path, mode="r")
            self._opened.append(store)
        root = zarr.open(store=store, path=_root_of(path) or "", mode="r")
        if hasattr(root, "chunks"):
            return {"": root}
        return {name: item for name, item in islice(root.members(max_depth=None), _MOST) if hasattr(item, "chunks")}

    def close(self) -> None:
        """Close the file."""
        for each in self._opened:
            each.close()


def holds_arrays(path: Path) -> bool:
    """Whether a path is a file of NumPy, or a Zarr."""
    return (path.suffix.lower() in _NUMPY and path.is_file()) or _root_of(path) is not None


def _root_of(path: Path) -> str | None:
    """Where in a folder or .zip a Zarr begins; None without one."""
    if path.is_dir():
        return "" if is_zarr(path) else None
    with suppress(OSError, zipfile.BadZipFile):
        if path.suffix.lower() == ".zip":
            with zipfile.ZipFile(path) as packed:
                names = [name for name in packed.namelist() if name.rpartition("/")[2] in METADATA]
            return min(names, key=len).rpartition("/")[0] if names else None
    return None


def shapes_text(arrays: list[Any]) -> str:
    """A sentence on arrays and their shapes, the largest first."""
    arrays = sorted(arrays, key=lambda item: (-item.ndim, -math.prod(item.shape)))
    shapes = [f"{item.name} ({' x '.join(map(str, item.shape))})" for item in arrays[:_LISTED]]
    more = f" and {len(arrays) - _LISTED} more" if len(arrays) > _LISTED else ""
    return f"It has {', '.join(shapes)}{more}." if shapes else "It has no arrays."


_LISTED = 10  # arrays of a file that an error names
