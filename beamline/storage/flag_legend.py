"""Flags of the monitor in a scan file: the bits of each frame, and the legend with the meaning of each bit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.monitor.check import Flag, Level
from beamline.monitor.checks import ALARM_SHIFT, ALARMS, CHECKS, bitmask
from beamline.storage import datasets, hdf5

FLAGS = "/entry/frame_log/flags"
SCORES = "/entry/frame_log/flag_scores"
REGIONS = "/entry/frame_log/flag_regions"
VALID = "/entry/frame_log/frame_valid"
LEGEND = "/entry/frame_log/flag_legend"
NOWHERE = (-1, -1, -1, -1)  # the region of a flag that has no region


@dataclass(frozen=True)
class FlagBit:
    """A check of the monitor, as the legend of a file lists it; see beamline.monitor.check.Check."""

    name: str
    bit: int
    unit: str = ""
    meaning: str = ""

    @property
    def alarm_bit(self) -> int:
        return self.bit + ALARM_SHIFT


@dataclass(frozen=True, eq=False)
class Mark:
    """The flags of a frame in its row of a scan file.

    Attributes:
        bits: one bit for each check and level, see `beamline.monitor.checks.bitmask`.
        scores: float32 [check], in the order of the legend; NaN if the check did not flag the frame, or flagged it only
            after later frames.
        regions: int32 [check, 4], first row, row after the last, first column, column after the last; -1: the check
            flagged no region.
    """

    bits: int
    scores: NDArray[np.float32]
    regions: NDArray[np.int32]

    @property
    def valid(self) -> bool:
        """True if no check raised an alarm."""
        return self.bits & ALARMS == 0


def mark_of(flags: Iterable[Flag]) -> Mark:
    """The flags of a frame as they are stored in a row of a file."""
    flags = [flag for flag in flags if flag.level is not Level.INFO]
    scores, regions = np.full(len(CHECKS), np.nan, np.float32), np.full((len(CHECKS), 4), -1, np.int32)
    for flag in flags:
        place = _PLACES[flag.check]
        scores[place], regions[place] = flag.score, flag.region or NOWHERE
    return Mark(bitmask(flags), scores, regions)


def place_of(flag: Flag) -> int:
    """Index of the check in the legend, and in scores and regions."""
    return _PLACES[flag.check]


_PLACES = {check.name: i for i, check in enumerate(CHECKS)}
UNMARKED = mark_of(())  # the mark of a frame that no check flagged


@dataclass(frozen=True, eq=False)
class FrameFlags:
    """The monitor's flags of the frames of a scan.

    Attributes:
        bits: uint64 [frame], one bit for each check and level, see `beamline.monitor.checks.bitmask`.
        legend: the checks to which the bits belong.
        scores: [frame, check] as in `Mark`.
        regions: [frame, check, 4] as in `Mark`.
    """

    bits: NDArray[np.uint64]
    legend: tuple[FlagBit, ...]
    scores: NDArray[np.float32]
    regions: NDArray[np.int32]

    @classmethod
    def of_marks(cls, marks: Sequence[Mark]) -> FrameFlags:
        """The flags of frames as the present checks found them."""
        return cls(
            np.array([mark.bits for mark in marks], np.uint64),
            TODAY,
            np.array([mark.scores for mark in marks], np.float32).reshape(-1, len(CHECKS)),
            np.array([mark.regions for mark in marks], np.int32).reshape(-1, len(CHECKS), 4),
        )

    @classmethod
    def of_flags(cls, flags_of_frames: Sequence[Sequence[Flag]]) -> FrameFlags:
        """The marks of the frames of a file, one for each row. If a flag refers to earlier rows, these rows are marked,
        too.
        """
        flags = cls.of_marks(
            [mark_of(flag for flag in each if flag.frame == row) for row, each in enumerate(flags_of_frames)]
        )
        for flag in chain.from_iterable(flags_of_frames):
            rows, place = flag.frames, place_of(flag)
            flags.bits[rows.start : rows.stop] |= np.uint64(bitmask([flag]))
            if flag.level is not Level.INFO:
                flags.scores[flag.frame, place] = flag.score
                for row, box in flag.regions().items():
                    flags.regions[row, place] = box
        return flags

    def mark(self, frame: int) -> Mark:
        """The mark of a frame in the format of the present checks. Checks that no longer exist are omitted."""
        mark = Mark(0, UNMARKED.scores.copy(), UNMARKED.regions.copy())
        bits, row = 0, int(self.bits[frame])
        for i, entry in enumerate(self.legend):
            if (place := _PLACES.get(entry.name)) is None or not row >> entry.bit & 1:
                continue
            bits |= 1 << TODAY[place].bit | (row >> entry.alarm_bit & 1) << TODAY[place].alarm_bit
            mark.scores[place], mark.regions[place] = self.scores[frame, i], self.regions[frame, i]
        return replace(mark, bits=bits)

    def of_today(self) -> FrameFlags:
        """The same flags with the bits of the present version. Checks that no longer exist are omitted."""
        return FrameFlags.of_marks([self.mark(frame) for frame in range(self.bits.size)])

    @property
    def flagged(self) -> NDArray[np.bool_]:
        """bool [frame], True for each frame that a check flagged at any level."""
        return np.asarray(self.bits != 0)

    @property
    def alarmed(self) -> NDArray[np.bool_]:
        """bool [frame], True for each frame with an alarm."""
        mask = sum(1 << entry.alarm_bit for entry in self.legend)
        return np.asarray((self.bits & np.uint64(mask)) != 0)

    def of(self, frames: NDArray[np.integer] | NDArray[np.bool_]) -> FrameFlags:
        """The flags of some frames."""
        return FrameFlags(self.bits[frames], self.legend, self.scores[frames], self.regions[frames])

    def of_groups(self, groups: Sequence[Sequence[int]]) -> FrameFlags:
        """The combined flags of each group of frames: the scores farthest from 0, and the box around all regions."""
        each = (("bits", np.bitwise_or.reduce), ("scores", _greatest), ("regions", _box_around))
        columns: dict[str, Any] = {}
        for name, of_group in each:
            known = getattr(self, name)
            columns[name] = np.array([of_group(known[rows]) for rows in groups], known.dtype)
            columns[name] = columns[name].reshape(-1, *known.shape[1:])
        return replace(self, **columns)

    @classmethod
    def joined(cls, each: Sequence[FrameFlags | None], sizes: Sequence[int] | NDArray[np.int64]) -> FrameFlags | None:
        """The flags of several scans, one after the other. The arguments include the number of frames of each scan.
        Flags are None for a scan that the monitor did not check.

        If all scans have the same legend, the result has this legend. Otherwise it has the present legend.
        """
        known = [flags for flags in each if flags is not None]
        if not known:
            return None
        legend = known[0].legend if len({flags.legend for flags in known}) == 1 else TODAY
        parts = list[FrameFlags]()
        for flags, n in zip(each, sizes, strict=True):
            blank = np.full((n, len(legend)), np.nan, np.float32), np.full((n, len(legend), 4), -1, np.int32)
            own = cls(np.zeros(n, np.uint64), legend, *blank) if flags is None else flags
            parts.append(own if own.legend == legend else own.of_today())
        bits, scores, regions = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("bits", "scores", "regions")
        )
        return cls(bits, legend, scores, regions)

    def without(self, bit: int) -> FrameFlags:
        """The flags without those of one check."""
        removed_bits = np.array(1 << bit | 1 << bit + ALARM_SHIFT, self.bits.dtype)
        return replace(self, bits=self.bits & ~removed_bits)

    def rows(self, entry: FlagBit, level: Level) -> NDArray[np.intp]:
        """Frames that a check flagged at this level."""
        alarms = self.bits >> entry.alarm_bit & 1
        return np.flatnonzero(alarms if level is Level.ALARM else self.bits >> entry.bit & 1 & ~alarms)

    def counts(self) -> dict[str, dict[str, int]]:
        """Number of flagged frames by check and level, without zeros. A frame counts once per check, at its worst
        level.
        """
        counted: dict[str, dict[str, int]] = {}
        for entry in self.legend:
            by_level = {level: self.rows(entry, level).size for level in (Level.WARN, Level.ALARM)}
            if any(by_level.values()):
                counted[entry.name] = {str(level): n for level, n in by_level.items() if n}
        return counted


def _greatest(scores: NDArray[np.float32]) -> NDArray[np.float32]:
    """[check] the score farthest from 0 among the scores [frame, check]; NaN if no frame has a score."""
    frame = np.where(np.isfinite(scores), np.abs(scores), -1).argmax(axis=0)
    return np.asarray(scores[frame, np.arange(scores.shape[1])])


def _box_around(regions: NDArray[np.int32]) -> NDArray[np.int32]:
    """[check, 4] the box around the regions [frame, check, 4]; -1 if no frame has a region."""
    has_region = regions[..., :1] >= 0
    low = np.where(has_region, regions, np.iinfo(np.int32).max).min(axis=0)
    high = regions.max(axis=0)
    box = np.stack([low[:, 0], high[:, 1], low[:, 2], high[:, 3]], axis=1)
    return np.where(has_region.any(axis=0), box, -1).astype(np.int32)


TODAY = tuple(FlagBit(check.name, check.bit, check.unit, check.meaning) for check in CHECKS)
"""The legend of the present checks, which new files get."""


def counted(counts: Mapping[str, Mapping[str, int]]) -> str:
    """Numbers of frames by check and level as text: `beam 3 warn 20 alarm, mass 2 warn`; "none" for no frame."""
    parts = (f"{name} " + " ".join(f"{n} {level}" for level, n in levels.items()) for name, levels in counts.items())
    return ", ".join(parts) or "none"


def write_legend(file: h5py.File) -> None:
    """Write the legend of all checks, one row for each check. Call it before SWMR writing begins."""
    file[FLAGS].attrs["description"] = "bits of the monitor's checks, see flag_legend; 0: no check flagged the frame"
    group = file.create_group(LEGEND)
    group.attrs["NX_class"] = "NXcollection"
    text = h5py.string_dtype("utf-8")
    group.create_dataset("name", data=[check.name for check in CHECKS], dtype=text)
    group.create_dataset("bit", data=[check.bit for check in CHECKS], dtype="<i4")
    group.create_dataset("alarm_bit", data=[check.bit + ALARM_SHIFT for check in CHECKS], dtype="<i4")
    group.create_dataset("unit", data=[check.unit for check in CHECKS], dtype=text)
    group.create_dataset("meaning", data=[check.meaning for check in CHECKS], dtype=text)
    file[SCORES].attrs["description"] = (
        "score of each check of flag_legend; NaN if the check did not flag the frame, or flagged it only "
        "when later frames had been taken"
    )
    file[REGIONS].attrs["description"] = "first row, row after the last, first column, column after the last; -1: none"
    file[REGIONS].attrs["units"] = "pixel"
    file[VALID].attrs["description"] = "0: a check raised an alarm. The pixels are stored as the camera delivered them"
    group["bit"].attrs["description"] = (
        "this bit is set in flags if the check flagged the frame; alarm_bit is set if the check raised an alarm"
    )
    group["unit"].attrs["description"] = "of the check's score"


def read_legend(file: h5py.File) -> tuple[FlagBit, ...]:
    """The legend of a scan file. Raises ValueError for impossible bits."""
    items = [file[f"{LEGEND}/{name}"] for name in ("name", "bit", "unit", "meaning")]
    columns = (datasets.values_of(item) for item in items)
    legend = tuple(
        FlagBit(datasets.text(name), int(bit), datasets.text(unit), datasets.text(meaning))
        for name, bit, unit, meaning in zip(*columns, strict=True)
    )
    bits = [entry.bit for entry in legend]
    if len({*bits}) != len(bits) or any(not 0 <= bit < 64 - ALARM_SHIFT for bit in bits):
        last_bit = 63 - ALARM_SHIFT
        raise ValueError(f"the bits of {LEGEND} are {bits}; expected different bits from 0 to {last_bit}")
    return legend


def read_flags(file: h5py.File, n: int) -> FrameFlags:
    """The flags of the first `n` frames of a scan file of this program, which may still be growing.

    Raises:
        ValueError: the shape of a dataset of flags does not fit the number of frames and the legend.
    """
    legend = read_legend(file)
    scores, regions = _read(file, SCORES, (n, len(legend))), _read(file, REGIONS, (n, len(legend), 4))
    return FrameFlags(_read(file, FLAGS, (n,)).astype(np.uint64), legend, scores, regions)


def _read(file: h5py.File, path: str, shape: tuple[int, ...]) -> NDArray[Any]:
    column = file[path]
    hdf5.look_again(column)
    values = np.asarray(column[: shape[0]])
    if values.shape != shape:
        raise ValueError(f"{path} has shape {values.shape}, expected {shape}")
    return values
