"""Legend of the flags: which check of the monitor each bit of `frame_log/flags` stands for, written into every scan.

Files without a legend hold the bits of the checks as they are numbered today, because a bit is never used again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.monitor.checks import ALARM_SHIFT, CHECKS
from beamline.storage import hdf5

FLAGS = "/entry/frame_log/flags"
LEGEND = "/entry/frame_log/flag_legend"


@dataclass(frozen=True)
class FlagBit:
    """A check in a legend; see beamline.monitor.check.Check."""

    name: str
    bit: int


def write_legend(file: h5py.File) -> None:
    """Write the legend of all checks, one row a check; before SWMR writing begins."""
    file[FLAGS].attrs["description"] = "bits of the monitor's checks, see flag_legend; 0: no check flagged the frame"
    group = file.create_group(LEGEND)
    group.attrs["NX_class"] = "NXcollection"
    text = h5py.string_dtype("utf-8")
    group.create_dataset("name", data=[check.name for check in CHECKS], dtype=text)
    group.create_dataset("bit", data=[check.bit for check in CHECKS], dtype="<i4")
    group.create_dataset("alarm_bit", data=[check.bit + ALARM_SHIFT for check in CHECKS], dtype="<i4")
    group.create_dataset("unit", data=[check.unit for check in CHECKS], dtype=text)
    group.create_dataset("meaning", data=[check.meaning for check in CHECKS], dtype=text)
    group["bit"].attrs["description"] = "set in flags where the check flagged the frame; alarm_bit: and as an alarm"
    group["unit"].attrs["description"] = "of the check's score, which the events give"


def read_legend(file: h5py.File) -> tuple[FlagBit, ...]:
    """The legend of a scan file; today's checks where an older file has none."""
    names, bits = hdf5.dataset(file, f"{LEGEND}/name"), hdf5.dataset(file, f"{LEGEND}/bit")
    if names is None or bits is None:
        return tuple(FlagBit(check.name, check.bit) for check in CHECKS)
    return tuple(FlagBit(hdf5.text(name), int(bit)) for name, bit in zip(names[()], bits[()], strict=True))


def flagged_by(flags: NDArray[np.integer], legend: Sequence[FlagBit]) -> Mapping[str, int]:
    """How many frames each check flagged, by name, for the checks that flagged any; bits are u4 [frame]."""
    counts = {entry.name: int(np.count_nonzero(flags >> entry.bit & 1)) for entry in legend}
    return {name: n for name, n in counts.items() if n}
