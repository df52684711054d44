"""The /exchange view: an NXtomo file's frames a second time as Data Exchange, by virtual datasets without a copy.

Layout after De Carlo et al. (2014), "Scientific data exchange: a schema for HDF5-based storage of raw and analyzed
data", J. Synchrotron Rad. 21, 1224: data, data_white, data_dark [frame, row, col] and theta in degrees.
"""

from __future__ import annotations

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.storage import hdf5
from beamline.storage.overlay import Overlay
from beamline.storage.writers import layout
from drivers.base.frame import FrameKind

NAMES = {FrameKind.PROJECTION: "data", FrameKind.FLAT: "data_white", FrameKind.DARK: "data_dark"}
THETA = {"data": "theta", "data_white": "theta_white", "data_dark": "theta_dark"}


def add_exchange_view(file: h5py.File) -> None:
    """Fill /exchange with the rows that exist. Kinds without a frame get no dataset, and neither do invalid frames."""
    source, angles, group = file[layout.DATA], file[layout.ANGLE][()], file.require_group(layout.EXCHANGE)
    units = file["/entry/record/quantity"].asstr()[()]
    there = {*group}  # of a recovery that was stopped
    for name, rows in _rows(file).items():
        if {name, THETA[name]} <= there:
            continue
        virtual = h5py.VirtualLayout((rows.size, *source.shape[1:]), source.dtype)
        filled = 0
        for first, last in hdf5.runs(rows):
            virtual[filled : filled + last - first] = h5py.VirtualSource(source)[first:last]
            filled += last - first
        dataset = group.create_virtual_dataset(name, virtual)
        dataset.attrs["axes"] = f"{THETA[name]}:y:x"
        dataset.attrs["units"] = units
        theta = group.create_dataset(THETA[name], data=angles[rows])
        theta.attrs["units"] = "deg"


def has_exchange_view(file: h5py.File) -> bool:
    """Whether /exchange is complete."""
    return layout.EXCHANGE in file and set(_rows(file)) <= set(file[layout.EXCHANGE])


def with_exchange_view(overlay: Overlay) -> Overlay:
    """A closed file of a scan with the view, to be carried out.

    What changes are the group, which frames do not hang on, and the head; all else is added at the end.

    Raises:
        DataError: the file cannot be read.
    """
    made = overlay.copy()
    try:
        with h5py.File(made, "r+", libver=layout.LIBVER) as file:
            add_exchange_view(file)
    except hdf5.ALTERED as error:
        raise DataError(f"{made.path} does not take the view ({hdf5.reason(error)}). Nothing was changed.") from error
    return made


def _rows(file: h5py.File) -> dict[str, NDArray[np.intp]]:
    """Rows of each dataset of the view."""
    kinds = file[layout.KIND][: int(file[layout.COMMITTED][()])]
    rows = {name: np.flatnonzero(kinds == kind) for kind, name in NAMES.items()}
    return {name: rows_of_kind for name, rows_of_kind in rows.items() if rows_of_kind.size}
