"""FrameFile: an HDF5 file as areaDetector's plugin NDFileHDF5 writes it. It can be read while it grows (SWMR)."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np

from beamline.core.errors import DataError
from splatline_areadetector.publish_frames import PublishedFrame

ATTRIBUTES = {
    "Angle": ("DOUBLE", "f8", "stage angle at the trigger in degrees"),
    "Kind": ("STRING", "S40", "projection, flat, dark, alignment, offset_view or invalid"),
    "HDF5FrameLocation": ("STRING", "S40", "where tomoscan stores frames of this kind"),
    "AcquireTime": ("DOUBLE", "f8", "exposure time in s"),
}
"""NDAttributes of a frame: their type for EPICS and in the file, and their meaning."""
XML = (
    "<Attributes>"
    + "".join(
        f'<Attribute name="{name}" type="PARAM" source="{name.upper()}" datatype="{kind}" description="{meaning}"/>'
        for name, (kind, _, meaning) in ATTRIBUTES.items()
    )
    + "</Attributes>"
)
"""The attributes as a client reads them from `NDAttributesFile`."""
_NUMBERS = {
    "NDArrayUniqueId": "i4", "NDArrayTimeStamp": "f8", "NDArrayEpicsTSSec": "u4", "NDArrayEpicsTSnSec": "u4",
}  # fmt: skip
_EPICS_EPOCH = 631152000  # s, 1990-01-01 after 1970-01-01
_ATTRIBUTES_PER_CHUNK = 16384  # as in areaDetector; bluesky's documents state it
_FLUSH_EVERY = 1.0  # s


class FrameFile:
    """Frames in `/entry/data/data` [frame, row, col], their attributes in `/entry/instrument/NDAttributes`.

    Raises:
        DataError: the file exists or cannot be made.
    """

    def __init__(self, path: Path, shape: tuple[int, int], dtype: np.dtype) -> None:
        self.path, self.frames, self._flushed = path, 0, time.monotonic()
        try:
            self._file = h5py.File(path, "x", libver=("v110", "v110"))
        except OSError as error:
            why = "the file already exists, and this program does not overwrite files" if path.exists() else f"{error}"
            raise DataError(f"{path} cannot be made: {why}.") from error
        self._data = self._file.create_dataset(
            "/entry/instrument/detector/data", (0, *shape), dtype, maxshape=(None, *shape), chunks=(1, *shape)
        )
        for group, kind in (
            ("/entry", "NXentry"), ("/entry/data", "NXdata"), ("/entry/instrument", "NXinstrument"),
            ("/entry/instrument/detector", "NXdetector"), ("/entry/instrument/NDAttributes", "NXcollection"),
        ):  # fmt: skip
            self._file.require_group(group).attrs["NX_class"] = kind
        self._file["/entry/data/data"] = self._data
        self._file["/entry/data"].attrs["signal"] = "data"
        types = {**{name: each[1] for name, each in ATTRIBUTES.items()}, **_NUMBERS}
        self._columns = {
            name: self._file.create_dataset(
                f"/entry/instrument/NDAttributes/{name}", (0,), kind, maxshape=(None,), chunks=(_ATTRIBUTES_PER_CHUNK,)
            )
            for name, kind in types.items()
        }
        self._file.swmr_mode = True

    def append(self, frame: PublishedFrame) -> None:
        """Write the next frame. Raises DataError if its size or type differs, or if the disk does not take it."""
        shape, dtype = self._data.shape[1:], self._data.dtype
        if frame.counts.shape != shape or frame.counts.dtype != dtype:
            raise DataError(
                f"Capture these frames in another file: the frames have the type {frame.counts.dtype} and the shape "
                f"{frame.counts.shape}, but {self.path} has frames of the type {dtype} and the shape {shape}"
            )
        seconds = int(frame.time)
        values = {
            **frame.attributes, "NDArrayUniqueId": frame.unique_id, "NDArrayTimeStamp": frame.time,
            "NDArrayEpicsTSSec": max(0, seconds - _EPICS_EPOCH),
            "NDArrayEpicsTSnSec": int(1e9 * (frame.time - seconds)),
        }  # fmt: skip
        try:
            for column, value in ((self._data, frame.counts), *((c, values[n]) for n, c in self._columns.items())):
                column.resize(self.frames + 1, 0)
                column[self.frames] = value
            self.frames += 1
            if time.monotonic() - self._flushed >= _FLUSH_EVERY:
                self.flush()
        except (OSError, RuntimeError) as error:
            raise DataError(f"frame {self.frames + 1} could not be written to {self.path}: {error}") from error

    def flush(self) -> None:
        """Let readers see all frames so far."""
        self._file.flush()
        self._flushed = time.monotonic()

    def close(self) -> None:
        with suppress(OSError, RuntimeError):
            self._file.close()
