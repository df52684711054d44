"""The end of a scan's file: how the scan ended, which triggers gave no frame and why, and its frames as /exchange.

/exchange is the layout of De Carlo et al. (2014), "Scientific data exchange: a schema for HDF5-based storage of raw and
analyzed data", J. Synchrotron Rad. 21, 1224: data, data_white, data_dark [frame, row, col] and theta in degrees, as
virtual datasets without a copy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.storage import datasets, hdf5
from beamline.storage.overlay import Overlay
from beamline.storage.writers import layout
from drivers.base.frame import FrameKind

NAMES = {FrameKind.PROJECTION: "data", FrameKind.FLAT: "data_white", FrameKind.DARK: "data_dark"}
THETA = {"data": "theta", "data_white": "theta_white", "data_dark": "theta_dark"}


def add_exchange_view(file: h5py.File) -> None:
    """Add to /exchange the rows recorded so far. Kinds without a frame get no dataset; invalid frames are omitted."""
    source, angles, group = file[layout.DATA], file[layout.ANGLE][()], file.require_group(layout.EXCHANGE)
    units = file["/entry/record/quantity"].asstr()[()]
    there = {*group}  # of a recovery that was stopped
    for name, rows in _rows(file).items():
        if {name, THETA[name]} <= there:
            continue
        virtual = h5py.VirtualLayout((rows.size, *source.shape[1:]), source.dtype)
        filled = 0
        for first, last in datasets.runs(rows):
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
    """A closed scan file with the view, as an overlay still to be written.

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


STATUSES = ("complete", "stopped", "failed")
RUNNING = "running"  # of a scan that goes on, or whose program died
DIED = "The program that took the scan died."


@dataclass(frozen=True)
class ScanEnding:
    """How a scan ended.

    Attributes:
        status: "complete", "stopped" (by the operator, an alarm, or references that cannot be used), "failed", or
            RUNNING where nothing was stated.
        missing: triggers that gave no frame, counted over the whole scan from 0.
        reason: why it did not take all its frames, in words; "" where it did, or where nothing says it.
    """

    status: str = "complete"
    missing: tuple[int, ...] = ()
    reason: str = ""


def ending_in(file: h5py.File) -> ScanEnding:
    """The ending stated by a scan file of this program."""
    for path in (layout.STATUS, layout.MISSING):
        hdf5.look_again(file[path])
    status = datasets.text_of(file[layout.STATUS]) or RUNNING
    return ScanEnding(status, tuple(file[layout.MISSING][()].tolist()), datasets.text_at(file, layout.REASON))


def state_ending(fields: Mapping[str, h5py.Dataset] | h5py.File, ending: ScanEnding) -> None:
    """Write the ending into a file created by `layout.create`, or into its open datasets, by path.

    Files of older versions have no place for the reason.
    """
    missing = np.asarray(ending.missing, np.int64)
    fields[layout.MISSING].resize(missing.size, 0)
    fields[layout.MISSING][...] = missing
    state_words(fields, ending)


def state_words(fields: Mapping[str, h5py.Dataset] | h5py.File, ending: ScanEnding) -> None:
    """Write only status and reason, which needs no further space on the disk."""
    if layout.REASON in fields:
        fields[layout.REASON][()] = ending.reason.encode()[: layout.REASON_BYTES].decode(errors="ignore").encode()
    fields[layout.STATUS][()] = ending.status.encode()


def complete(file: hdf5.NewFile, ending: ScanEnding) -> None:
    """State that a file created by `layout.create` has all frames of its scan, and how the scan ended; add
    /exchange."""
    file[layout.COMMITTED][()] = len(file[layout.DATA])
    state_ending(file, ending)
    file[layout.FINISHED][()] = 1
    layout.state_field_of_view(file)
    add_exchange_view(file)
