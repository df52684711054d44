"""The /exchange view: an NXtomo file's frames once more as Data Exchange, by virtual datasets and without a copy.

Layout after De Carlo et al. (2014), "Scientific data exchange: a schema for HDF5-based storage of raw and analyzed
data", J. Synchrotron Rad. 21, 1224: data, data_white, data_dark [frame, row, col] and theta in degrees.
"""

from __future__ import annotations

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.storage.writers import layout
from drivers.frame import FrameKind

NAMES = {FrameKind.PROJECTION: "data", FrameKind.FLAT: "data_white", FrameKind.DARK: "data_dark"}
THETA = {"data": "theta", "data_white": "theta_white", "data_dark": "theta_dark"}


def runs(rows: NDArray[np.integer]) -> list[tuple[int, int]]:
    """Half-open runs [a, b) of consecutive numbers, in order: 3 4 5 9 -> (3, 6), (9, 10)."""
    if rows.size == 0:
        return []
    cuts = np.flatnonzero(np.diff(rows) != 1) + 1
    return [(int(part[0]), int(part[-1]) + 1) for part in np.split(rows, cuts)]


def add_exchange_view(file: h5py.File) -> None:
    """Add /exchange for the rows that exist. Kinds without a frame get no dataset, and neither do invalid frames."""
    source = file[layout.DATA]
    kinds = file[layout.KIND][()]
    angles = file[layout.ANGLE][()]
    n = int(file[layout.COMMITTED][()])
    file["implements"] = "exchange"
    group = file.create_group("exchange")
    units = file["/entry/record/quantity"].asstr()[()]
    for kind, name in NAMES.items():
        rows = np.flatnonzero(kinds[:n] == kind)
        if rows.size == 0:
            continue
        virtual = h5py.VirtualLayout((rows.size, *source.shape[1:]), source.dtype)
        filled = 0
        for first, last in runs(rows):
            virtual[filled : filled + last - first] = h5py.VirtualSource(source)[first:last]
            filled += last - first
        dataset = group.create_virtual_dataset(name, virtual)
        dataset.attrs["axes"] = f"{THETA[name]}:y:x"
        dataset.attrs["units"] = units
        theta = group.create_dataset(THETA[name], data=angles[rows])
        theta.attrs["units"] = "deg"
