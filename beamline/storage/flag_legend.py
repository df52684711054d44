"""Flags of the monitor in a scan file: the bits of each frame, and the legend that says which check a bit stands for.

Files without a legend hold the bits of the checks as they are numbered today, because a bit is never used again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.monitor.check import Level
from beamline.monitor.checks import ALARM_SHIFT, CHECKS
from beamline.storage import hdf5

FLAGS = "/entry/frame_log/flags"
LEGEND = "/entry/frame_log/flag_legend"


@dataclass(frozen=True)
class FlagBit:
    """A check in a legend; see beamline.monitor.check.Check."""

    name: str
    bit: int

    @property
    def alarm_bit(self) -> int:
        return self.bit + ALARM_SHIFT


@dataclass(frozen=True, eq=False)
class FrameFlags:
    """The monitor's flags of the frames of a scan.

    Attributes:
        bits: [frame] as `beamline.monitor.checks.bitmask` makes them.
        legend: the checks behind the bits.
    """

    bits: NDArray[np.integer]
    legend: tuple[FlagBit, ...]

    @property
    def flagged(self) -> NDArray[np.bool_]:
        """[frame]: some check flagged it, at any level."""
        return np.asarray(self.bits != 0)

    @property
    def alarmed(self) -> NDArray[np.bool_]:
        """[frame]: for some check it was an alarm."""
        mask = sum(1 << entry.alarm_bit for entry in self.legend)
        return np.asarray((self.bits & np.array(mask, self.bits.dtype)) != 0)

    def of(self, frames: NDArray[np.integer] | NDArray[np.bool_]) -> FrameFlags:
        """The flags of some of the frames."""
        return FrameFlags(self.bits[frames], self.legend)

    def after(self, n: int) -> FrameFlags:
        """The flags with `n` frames that no check has seen put in front."""
        return FrameFlags(np.concatenate([np.zeros(n, self.bits.dtype), self.bits]), self.legend)

    def counts(self) -> dict[str, dict[str, int]]:
        """Frames by check and level, for the checks and levels that flagged any; a frame counts by its worst level."""
        found: dict[str, dict[str, int]] = {}
        for entry in self.legend:
            alarms = self.bits >> entry.alarm_bit & 1
            warns = self.bits >> entry.bit & 1 & ~alarms
            by_level = {Level.WARN: int(warns.sum()), Level.ALARM: int(alarms.sum())}
            if any(by_level.values()):
                found[entry.name] = {str(level): n for level, n in by_level.items() if n}
        return found


def counted(counts: Mapping[str, Mapping[str, int]]) -> str:
    """Numbers of frames by check and level as text: `beam 3 warn 20 alarm, mass 2 warn`; "none" for no frame."""
    parts = (f"{name} " + " ".join(f"{n} {level}" for level, n in levels.items()) for name, levels in counts.items())
    return ", ".join(parts) or "none"


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


def read_flags(file: h5py.File, n: int) -> FrameFlags:
    """The flags of the first `n` frames of a scan file of ours, also of one that is being written."""
    column = file[FLAGS]
    column.refresh()
    return FrameFlags(column[:n], read_legend(file))
