"""ScanEnding: how a scan ended, which triggers gave no frame, and why. Every copy of a scan states that of the scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import h5py
import numpy as np

from beamline.storage import hdf5
from beamline.storage.writers import layout
from beamline.storage.writers.exchange_view import add_exchange_view

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
    """The ending that a scan file of ours states."""
    for path in (layout.STATUS, layout.MISSING):
        hdf5.look_again(file[path])
    status = hdf5.text_of(file[layout.STATUS]) or RUNNING
    return ScanEnding(status, tuple(file[layout.MISSING][()].tolist()), hdf5.text_at(file, layout.REASON))


def state_ending(datasets: Mapping[str, h5py.Dataset] | h5py.File, ending: ScanEnding) -> None:
    """Write the ending into a file that `layout.create` made, or into its open datasets, by path.

    Files of older versions have no place for the reason.
    """
    missing = np.asarray(ending.missing, np.int64)
    datasets[layout.MISSING].resize(missing.size, 0)
    datasets[layout.MISSING][...] = missing
    state_words(datasets, ending)


def state_words(datasets: Mapping[str, h5py.Dataset] | h5py.File, ending: ScanEnding) -> None:
    """Write only status and reason, which takes no space on the disk."""
    if layout.REASON in datasets:
        datasets[layout.REASON][()] = ending.reason.encode()[: layout.REASON_BYTES].decode(errors="ignore").encode()
    datasets[layout.STATUS][()] = ending.status.encode()


def complete(file: hdf5.NewFile, ending: ScanEnding) -> None:
    """State that a file that `layout.create` made holds all frames of its scan, and how that ended; add /exchange."""
    file[layout.COMMITTED][()] = len(file[layout.DATA])
    state_ending(file, ending)
    file[layout.FINISHED][()] = 1
    layout.state_field_of_view(file)
    add_exchange_view(file)
