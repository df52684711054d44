"""Scans of other programs (NXtomo, Data Exchange) with changed or additional field values."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.open import open_scan

ROWS, COLS, VIEWS = 4, 6, 5
KEY = np.r_[2, 1, [0] * VIEWS]
DETECTOR = "instrument/detector"
FRAMES = np.random.default_rng(3).integers(100, 60000, (2 + VIEWS, ROWS, COLS)).astype(np.uint16)
CONE = (("instrument/source/distance", -0.01, "m"), ("detector/distance", 0.01, "m"))


def put(parent: h5py.Group, where: str, value: Any, units: str | None = None, **attributes: Any) -> None:
    if where in parent:
        del parent[where]
    parent[where] = value
    if units is not None:
        parent[where].attrs["units"] = units
    parent[where].attrs.update(attributes)


def nxtomo(path: Path, *changes: tuple[str, Any, str | None], also: Callable[[h5py.Group], None] | None = None) -> Path:
    """An NXtomo file of another program, with changed or additional values below its entry."""
    with h5py.File(path, "w") as file:
        entry = file.create_group("entry0000")
        put(entry, "definition", "NXtomo")
        put(entry, f"{DETECTOR}/data", FRAMES)
        put(entry, f"{DETECTOR}/image_key", KEY)
        put(entry, f"{DETECTOR}/x_pixel_size", 1e-3, "mm")
        put(entry, f"{DETECTOR}/y_pixel_size", 1e-6, "m")
        put(entry, "sample/rotation_angle", np.r_[0, 0, np.arange(VIEWS) * 36.0], "degree")
        for where, value, units in changes:
            put(entry, f"instrument/{where}" if where.startswith("detector/") else where, value, units)
        if also is not None:
            also(entry)
    return path


def exchange(path: Path, *changes: tuple[str, Any, str | None], axes: str | None = None) -> Path:
    order = [["theta", "y", "x"].index(axis) for axis in (axes or "theta:y:x").split(":")]
    with h5py.File(path, "w") as file:
        for name, kind in (("data_dark", 2), ("data_white", 1), ("data", 0)):
            file[f"exchange/{name}"] = np.ascontiguousarray(FRAMES[kind == KEY].transpose(order))
        if axes is not None:
            file["exchange/data"].attrs["axes"] = axes
        put(file, "exchange/theta", np.arange(VIEWS) * 36.0, "deg")
        for where, value, units in changes:
            put(file, where, value, units)
    return path


def opened(path: Path) -> ScanSource:
    with open_scan(path) as source:
        source.read([0])
        return source
