"""Interface of a format of volume files; conversion of voxels to grey values; metadata of a volume as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.installed import version
from beamline.core.quantities import VoxelKind
from beamline.storage.readers.tiff import VOLUME
from beamline.storage.recon_record import ReconRecord
from recon.base.volume import Grid, Volume


@dataclass(frozen=True)
class Pixels:
    """How a voxel is stored.

    Attributes:
        bits: 32: float32, the value itself; 16 or 8: a grey value.
        window: for grey values, the two values that become 0 and the largest grey value; values outside are clipped.
    """

    bits: int = 32
    window: tuple[float, float] | None = None

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype({32: "<f4", 16: "<u2", 8: "u1"}[self.bits])


class Slices:
    """Yields the slices of a volume in the form in which they are stored.

    `outside` is the number of voxels so far that the window clipped, or that are not finite.
    """

    def __init__(self, volume: Volume, pixels: Pixels) -> None:
        self._data, self.pixels, self.shape, self.outside = volume.data, pixels, volume.grid.shape, 0

    def __iter__(self) -> Iterator[NDArray[Any]]:
        for z in range(self.shape[0]):
            try:
                values = np.asarray(self._data[z : z + 1][0], np.float32)
            except OSError as error:
                raise DataError(f"Slice {z} of the volume cannot be read ({error}).") from error
            yield self._stored(values)

    def _stored(self, values: NDArray[np.float32]) -> NDArray[Any]:
        dtype, window = self.pixels.dtype, self.pixels.window
        if window is None:
            return np.ascontiguousarray(values, dtype)
        low, high = window
        inside = (values >= low) & (values <= high)
        self.outside += values.size - int(inside.sum())
        greatest = np.iinfo(dtype).max
        grey = (np.nan_to_num(values, nan=low).astype(np.float64) - low) * (greatest / (high - low))
        return np.clip(np.rint(grey), 0, greatest).astype(dtype)


class VolumeFormat(Protocol):
    """A format of volume files."""

    @property
    def name(self) -> str: ...
    @property
    def suffixes(self) -> tuple[str, ...]:
        """Suffixes of a file's name; "" for a folder."""

    @property
    def greys(self) -> bool:
        """True if the format can store grey values of 8 and 16 bits."""

    def write(self, path: Path, record: ReconRecord, slices: Slices) -> None:
        """Write a new file, slice by slice. Raises OSError if the disk failed."""

    def holds(self, path: Path) -> bool:
        """True if this program wrote the file as a volume in this format. False also if the file cannot be read."""

    def open(self, path: Path) -> AbstractContextManager[ReconRecord]:
        """The record of such a file. Voxels are read when the volume is sliced along z.

        Raises:
            DataError: the file is cut off or damaged.
        """


def facts_of(record: ReconRecord, pixels: Pixels) -> dict[str, Any]:
    """Metadata of a volume as JSON, for formats that have no fields for them. Arrays and the history are not
    included.
    """
    grid = record.volume.grid
    return {
        "format": VOLUME,
        "program": f"splatline {version()}",
        "title": record.title,
        "sample": record.sample,
        "raw_file": record.raw_file,
        "date": datetime.fromtimestamp(record.time, UTC).isoformat(timespec="seconds"),
        "length_unit": record.length_unit,
        "values": record.unit,
        **({} if pixels.window is None else {"window": pixels.window}),
        "voxel_size": grid.voxel_size,
        "slice_pitch": grid.slice_pitch,
        "centre_zyx": grid.centre,
        "parameters": {k: v for k, v in record.parameters.items() if not isinstance(v, np.ndarray)},
        "metrics": dict(record.metrics),
    }


def marked(text: str) -> dict[str, Any] | None:
    """The metadata in a description; None if another program wrote the description."""
    if VOLUME not in text:
        return None
    try:
        facts = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return facts if isinstance(facts, dict) and facts.get("format") == VOLUME else None


def record_of(path: Path, facts: Mapping[str, Any], values: Any) -> ReconRecord:
    """The record with the metadata from `facts_of` and the values [z, y, x]. If voxels are grey values, the parameters
    contain their window.

    Raises:
        DataError: another program changed the metadata.
    """
    try:
        z, y, x = map(float, facts["centre_zyx"])
        pitch = facts["slice_pitch"]
        grid = Grid(values.shape, float(facts["voxel_size"]), (z, y, x), None if pitch is None else float(pitch))
        window = {"window": np.asarray(facts["window"], float).reshape(2)} if "window" in facts else {}
        return ReconRecord(
            volume=Volume(values, grid),
            length_unit=str(facts["length_unit"]),
            raw_file=str(facts["raw_file"]),
            title=str(facts["title"]),
            sample=str(facts["sample"]),
            time=datetime.fromisoformat(facts["date"]).timestamp(),
            parameters={**{k: v for k, v in facts["parameters"].items() if v is not None}, **window},
            metrics={name: math.nan if value is None else float(value) for name, value in facts["metrics"].items()},
            kind=VoxelKind.of_unit(str(facts.get("values"))),
        )
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError, OSError) as error:
        raise DataError(
            f"{path} was changed by another program: metadata that every volume of this program has are missing "
            f"({type(error).__name__}: {error})."
        ) from error


def bare_record(path: Path, values: Any, spacing: tuple[float, float, float] | None = None) -> ReconRecord:
    """The record of a volume that has no metadata. `spacing` is (z, y, x) in mm."""
    dz, dy, dx = spacing or (1.0, 1.0, 1.0)
    if 0 in values.shape:
        raise DataError(f"{path} has no voxels: its shape is {values.shape}; expected [z, y, x].")
    if not math.isclose(dy, dx, rel_tol=1e-3):
        raise DataError(
            f"{path} has voxels of {dy:g} x {dx:g} mm in a slice; only voxels that are square in a slice can be stored."
        )
    return ReconRecord(
        volume=Volume(values, Grid(values.shape, dx, slice_pitch=dz)),
        length_unit="px" if spacing is None else "mm",
        raw_file="not stated",
        title=path.name,
        sample="not stated",
        time=path.stat().st_mtime,
        parameters={},
    )
