"""DataExchangeSource: the /exchange group of Data Exchange files (De Carlo et al. 2014, J. Synchrotron Rad. 21, 1224).

The format keeps darks, flats and projections apart and does not say when the references were taken: the frames are
numbered darks first, then flats, then projections.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.storage import hdf5
from beamline.storage.hdf5 import require_real
from beamline.storage.readers.base import WHOLE, Format, Opening, ScanReader, frame_indices
from drivers.frame import FrameKind

PARTS = (
    (FrameKind.DARK, "exchange/data_dark"),
    (FrameKind.FLAT, "exchange/data_white"),
    (FrameKind.PROJECTION, "exchange/data"),
)


class DataExchangeSource(ScanReader):
    """A Data Exchange scan; see ScanSource. `finished` is always True: the format has no way to grow.

    Quantity: "counts" where darks and flats are there to make something of them, else "unknown".
    """

    format = "data_exchange"

    def __init__(self, path: Path, *, own_angles: bool = True) -> None:
        """Open. `own_angles` False: the caller brings the angles, so theta may be absent."""
        self.path = path
        self._file = hdf5.open_hdf5(path)
        try:
            found = ((kind, hdf5.dataset(self._file, where)) for kind, where in PARTS)
            self._parts = [(kind, item) for kind, item in found if item is not None]
            self._check()
            sizes = [len(item) for _, item in self._parts]
            self._starts = np.cumsum([0, *sizes])
            n_views = sizes[-1]
            self.shape = tuple(self._parts[-1][1].shape[1:])
            self.dtype = np.result_type(*(item.dtype for _, item in self._parts))
            self.image_key = np.repeat([kind for kind, _ in self._parts], sizes).astype(np.int32)
            self.angles = np.full(self.image_key.size, np.nan)
            self.exposures = np.full(self.image_key.size, np.nan)
            if own_angles:
                self.angles[-n_views:] = self._theta(n_views)
            kinds = {kind for kind, _ in self._parts}
            self.quantity = "counts" if {FrameKind.DARK, FrameKind.FLAT} <= kinds else "unknown"
            self.facts = self._attributes()
            pixel = self._file.attrs.get("pixel_size_mm")
            self.pixel_size_mm = float(pixel) if isinstance(pixel, int | float) and np.isfinite(pixel) else None
        except BaseException:
            self._file.close()
            raise

    def _check(self) -> None:
        for _, item in self._parts:
            require_real(item.dtype, f"{item.name} in {self.path}")
            if item.ndim != 3 or item.shape[1:] != self._parts[-1][1].shape[1:]:
                shapes = ", ".join(f"{part.name} {part.shape}" for _, part in self._parts)
                raise DataError(f"{self.path}: expected frames [frame, row, col] of one shape, found {shapes}.")
            hdf5.require_possible(item)
            lost = hdf5.missing_links(item)
            if lost:
                raise DataError(f"{self.path} draws its frames from {lost[0]}, which is not there or differs.")
        if not len(self._parts[-1][1]):
            raise DataError(f"{self.path} holds no projections: /exchange/data has shape {self._parts[-1][1].shape}.")

    def _theta(self, n_views: int) -> NDArray[np.float64]:
        theta = hdf5.dataset(self._file, "exchange/theta")
        if theta is None:
            raise DataError(
                f"{self.path} has no /exchange/theta. Some readers then assume 0 to 180 degrees; we do not: "
                "give them with --angles FILE (degrees, one a line)."
            )
        angles = hdf5.radians(theta, default="degrees")
        if angles.size != n_views or n_views not in (1, *theta.shape):
            raise DataError(
                f"{self.path}: /exchange/theta has {angles.size} angles for {n_views} projections, "
                f"shape {theta.shape}; expected one angle for each."
            )
        return angles

    def _attributes(self) -> dict[str, str | float | int]:
        said: dict[str, str | float | int] = {}
        for name, value in self._file.attrs.items():
            if isinstance(value, np.number):
                said[name] = float(value)
            else:
                said[name] = " ".join(hdf5.text(part) for part in np.ravel(value))
        for name, where in (("title", "exchange/title"), ("sample", "measurement/sample/name")):
            item = hdf5.dataset(self._file, where)
            if item is not None:
                said[name] = hdf5.text(item[()])
        said["theta_units"] = hdf5.attribute(self._file["exchange"].get("theta", self._file), "units") or "not given"
        return said

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        """Pixels [frame, row, col] of the frames asked for, in that order; darks and flats are cast to dtype."""
        indices = frame_indices(frames, self.image_key.size)
        out = np.empty((indices.size, len(range(self.shape[0])[rows]), self.shape[1]), self.dtype)
        for (_, item), first, last in zip(self._parts, self._starts[:-1], self._starts[1:], strict=True):
            wanted = np.flatnonzero((indices >= first) & (indices < last))
            if wanted.size:
                part = np.empty((wanted.size, *out.shape[1:]), item.dtype)
                hdf5.read_frames(item, indices[wanted] - first, rows, part)
                out[wanted] = part
        return out

    def close(self) -> None:
        self._file.close()


def _recognises(path: Path, opening: Opening) -> bool:
    if not hdf5.is_hdf5(path, opening.follow):
        return False
    with hdf5.open_hdf5(path, opening.follow) as file:
        return hdf5.dataset(file, "exchange/data") is not None


FORMAT = Format(
    "/exchange/data (Data Exchange)",
    _recognises,
    lambda path, opening: DataExchangeSource(path, own_angles=opening.own_angles),
)
