"""Reads volumes from the Zarr files of other programs with the zarr library: versions 2 and 3, any codec.

Axes, scales and units follow ngff.openmicroscopy.org, versions 0.4 and 0.5. Translations are ignored.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.machine import free_memory
from beamline.storage.array_file import zarr_library
from beamline.storage.structure import numbers_of, shape_of

_MM = {"angstrom": 1e-7, "nanometer": 1e-6, "micrometer": 1e-3, "millimeter": 1.0, "centimeter": 10.0, "meter": 1e3}

Spacing = tuple[float, float, float]


@dataclass(frozen=True)
class ZarrScale:
    """One scale of a volume, read box by box: an array [..., z, y, x] of a Zarr store whose leading axes have length
    one.

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
        except Exception as error:  # the codecs raise errors of any class for a damaged chunk
            raise DataError(f"{self.path} cannot be read ({type(error).__name__}: {error}).") from error


def open_zarr(path: Path, dataset: str | None = None) -> tuple[ZarrScale, Spacing | None]:
    """The finest scale of an OME-Zarr, with its coarser scales; or the array `dataset`. Also the voxel size in mm, if
    it is stated.

    Raises:
        DataError: the zarr library is missing, the file is not readable, it contains no volume, or it contains several
            channels or times.
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
        raise DataError(
            f"{path} is not an OME-Zarr image. Name one of its arrays with --dataset NAME. In `beamline view`, write "
            f"{path.name}::NAME."
        )
    finest, *coarser = arrays
    _require_volume(path, finest)
    scales = [finest, *(array for array in coarser if is_halved(finest.shape[-3:], array))]
    for array in scales:
        _require_chunks(path, array)
    if spacing is not None and not all(0 < step < np.inf for step in spacing):
        raise DataError(f"{path} states voxels of {spacing} mm; expected lengths above 0. Nothing was read.")
    return ZarrScale(path, finest, tuple(ZarrScale(path, array) for array in scales[1:])), spacing


def _require_volume(path: Path, array: Any) -> None:
    """Raise DataError for an array that is not a volume of real numbers."""
    if array.ndim < 3 or any(n != 1 for n in array.shape[:-3]) or np.dtype(array.dtype).kind not in "uifb":
        raise DataError(
            f"{path} contains {array.dtype} of shape {array.shape}; expected real numbers [z, y, x] of "
            "one time and one channel. Copy one time and channel to a separate file."
        )


def _require_chunks(path: Path, array: Any) -> None:
    """Raise DataError for an impossible shape, and for chunks that do not fit into memory."""
    try:
        shape_of(array.shape[-3:])
        piece = math.prod(shape_of(array.chunks[-3:], "chunk")) * np.dtype(array.dtype).itemsize
    except ValueError as error:
        raise DataError(f"{path} cannot be read as a Zarr ({error}).") from error
    if piece > free_memory():
        chunk_gb = piece / 1e9
        raise DataError(f"{path} has chunks of {chunk_gb:.3g} GB, which is more than the free memory.")


def _spacing(image: Mapping[str, Any], axes: int, name: str) -> Spacing | None:
    """The voxel size in mm; None if the size or a unit is not stated."""
    (mine,) = [each for each in image.get("datasets", []) if each["path"] == name] or [{}]
    steps = [*mine.get("coordinateTransformations", []), *image.get("coordinateTransformations", [])]
    scales = [numbers_of(step["scale"], axes, "scale")[-3:] for step in steps if step["type"] == "scale"]
    units = [_MM.get(axis.get("unit", "")) for axis in image.get("axes", [])[axes - 3 :] if isinstance(axis, Mapping)]
    if not scales or len(units) != 3 or None in units:
        return None
    z, y, x = (np.prod(scales, axis=0) * np.asarray(units, float)).tolist()
    return z, y, x


def is_halved(finest: tuple[int, ...], array: Any) -> bool:
    """True if the shape of an array results from halving `shape` repeatedly along each axis, rounded up or down."""
    shape = getattr(array, "shape", ())[-3:]  # a group has no shape
    if len(shape) < 3 or min(*shape, *finest) < 1:
        return False
    steps = [2 ** round(np.log2(n / m)) for n, m in zip(finest, shape, strict=True)]
    return all(m in (n // by, -(-n // by)) for n, m, by in zip(finest, shape, steps, strict=True))
