"""Scans as Data Exchange: the /exchange group (De Carlo et al. 2014, J. Synchrotron Rad. 21, 1224)."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.storage import hdf5
from beamline.storage.readers.base import Opening, ScanFormat
from beamline.storage.readers.stacks import FrameStack, StacksSource
from drivers.base.frame import FrameKind

PLACES = (
    (FrameKind.DARK, "/exchange/data_dark"),
    (FrameKind.FLAT, "/exchange/data_white"),
    (FrameKind.PROJECTION, "/exchange/data"),
)


def open_exchange(path: Path, *, own_angles: bool = True) -> StacksSource:
    """Open. `own_angles` False: the caller brings the angles, so theta may be absent."""
    file = hdf5.open_hdf5(path)
    try:
        for _, where in PLACES:
            hdf5.refuse_broken(file, where)
        found = ((kind, where, hdf5.dataset(file, where)) for kind, where in PLACES)
        stacks = [FrameStack(kind, where, item) for kind, where, item in found if item is not None]
        source = StacksSource(path, file, stacks, format="data_exchange", facts=_attributes(file))
        if own_angles:
            n_views = len(stacks[-1].frames)
            source.angles[-n_views:] = _theta(file, n_views)
        pixel = file.attrs.get("pixel_size_mm")
        units = hdf5.attribute(file["exchange/data"], "units").lower().replace(" ", "_")
        if source.quantity == "unknown" and units in ("counts", "line_integrals"):
            source.quantity = "counts" if units == "counts" else "line_integrals"
        source.pixel_size_mm = float(pixel) if isinstance(pixel, int | float) and np.isfinite(pixel) else None
        return source
    except BaseException:
        file.close()
        raise


def _theta(file: h5py.File, n_views: int) -> NDArray[np.float64]:
    theta = hdf5.dataset(file, "exchange/theta")
    if theta is None:
        hdf5.refuse_broken(file, "exchange/theta")
        raise DataError(
            f"{file.filename} has no /exchange/theta. Some readers then assume 0 to 180 degrees; we do not: "
            "give them with --angles FILE (degrees, one a line)."
        )
    angles = hdf5.radians(theta, default="degrees")
    if angles.size != n_views or n_views not in (1, *theta.shape):
        raise DataError(
            f"{file.filename}: /exchange/theta has {angles.size} angles for {n_views} projections, "
            f"shape {theta.shape}; expected one angle for each."
        )
    return angles


def _attributes(file: h5py.File) -> dict[str, str | float | int]:
    said: dict[str, str | float | int] = {}
    for name, value in file.attrs.items():
        if isinstance(value, np.number):
            said[name] = float(value)
        else:
            said[name] = " ".join(hdf5.text(part) for part in np.ravel(value))
    for name, where in (("title", "exchange/title"), ("sample", "measurement/sample/name")):
        item = hdf5.dataset(file, where)
        if item is not None:
            said[name] = hdf5.text(item[()])
    said["theta_units"] = hdf5.attribute(file["exchange"].get("theta", file), "units") or "not given"
    return said


def _recognises(path: Path, opening: Opening) -> bool:
    if not hdf5.is_hdf5(path, opening.follow):
        return False
    with hdf5.open_hdf5(path, opening.follow) as file:
        return hdf5.dataset(file, "exchange/data") is not None or bool(hdf5.broken_link(file, "exchange/data"))


FORMAT = ScanFormat(
    "/exchange/data (Data Exchange)",
    _recognises,
    lambda path, opening: open_exchange(path, own_angles=opening.own_angles),
)
