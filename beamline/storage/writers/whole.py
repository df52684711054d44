"""Completion of a file whose frames were copied or computed: it becomes that of a scan that has ended."""

from __future__ import annotations

from beamline.storage import hdf5
from beamline.storage.writers import layout
from beamline.storage.writers.ending import ScanEnding, state_ending
from beamline.storage.writers.exchange_view import add_exchange_view


def complete(file: hdf5.NewFile, ending: ScanEnding) -> None:
    """State that a file that `layout.create` made holds all frames of its scan, and how that ended; add /exchange."""
    file[layout.COMMITTED][()] = len(file[layout.DATA])
    state_ending(file, ending)
    file[layout.FINISHED][()] = 1
    layout.state_field_of_view(file)
    add_exchange_view(file)
