"""Plan of a queue, made without devices: which of several scans can run, the needs of each, and the needs of all
together."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beamline.config.load import Config
from beamline.core.errors import ConfigError
from beamline.core.text import aligned, count, size
from beamline.plan.limits import ROOM
from beamline.plan.needs import NOTHING, ScanNeeds, all_needs
from beamline.plan.timeline import hms_text
from beamline.scan.dry_run import DryRun


@dataclass(frozen=True)
class ScanFault:
    """The reason why a scan cannot run.

    Attributes:
        message: the reason, as a sentence.
        file, line: place of the wrong value; None if the value is not in a file, or if the reason concerns several
            lines.
    """

    message: str
    file: str | None = None
    line: int | None = None

    def __str__(self) -> str:
        place = "" if self.file is None else self.file if self.line is None else f"{self.file}:{self.line}"
        return self.message if self.message.startswith(place) else f"{place}: {self.message}"


@dataclass(frozen=True, eq=False)
class PlannedScan:
    """One scan of a queue, with its plan, which was made without devices.

    Attributes:
        source: the file of its configuration, or the line of its table (day.csv:3).
        sample: name of the sample; empty if the configuration cannot be read.
        faults: reasons why the scan cannot run; empty: the scan can run.
        warnings: sentences on unusual values, for example because of a wrong unit.
        needs: time, frames, bytes, dose, and requests to the operator; all are 0 if they cannot be computed.
        disk: an existing folder on the disk to which the scan file will be written; None: the scan writes no file.
        config: the configuration; None if it cannot be read.
        worked: the dry run of the scan, with its timeline and limits; None if the dry run fails.
    """

    source: str
    sample: str = ""
    faults: tuple[ScanFault, ...] = ()
    warnings: tuple[str, ...] = ()
    needs: ScanNeeds = NOTHING
    disk: Path | None = None
    config: Config | None = None
    worked: DryRun | None = None

    @property
    def valid(self) -> bool:
        """True if the scan can run."""
        return not self.faults

    def data(self) -> Mapping[str, Any]:
        """The values as a mapping for other programs. Times are in s, sizes in bytes, doses in Gy."""
        facts = {name: getattr(self, name) for name in ("source", "sample", "valid", "faults", "warnings")}
        return {**(self.worked.data() if self.worked else {}), **self.needs.data(), **facts}


@dataclass(frozen=True, eq=False)
class QueuePlan:
    """Several scans, one after the other, planned without devices.

    Attributes:
        scans: the scans in their order.
        faults: reasons why the scans cannot all run, although each scan could run alone; for example a disk that is
            too small for all files.
        needs: sum of the needs of all scans that can run.
        free_bytes: free space in bytes on the fullest of the disks; 0 if no scan can run.
    """

    scans: tuple[PlannedScan, ...]
    faults: tuple[ScanFault, ...] = ()
    needs: ScanNeeds = NOTHING
    free_bytes: int = 0

    @property
    def valid(self) -> bool:
        """True if all scans can run."""
        return not self.faults and all(scan.valid for scan in self.scans)

    def lines(self) -> list[str]:
        """The plan as lines to print: one line for each scan, then the time of each part, then the sums."""
        rows = [(scan.sample or "-", scan.source, "yes" if scan.valid else "no", *_cells(scan)) for scan in self.scans]
        head = ("scan", "from", "can run", "frames", "size (MB)", "time (h:min:s)", "requests", "dose (Gy)")
        needs, can_run = self.needs, sum(scan.valid for scan in self.scans)
        table = [aligned([head, *rows]), "", f"{count(len(rows), 'scan')}, {can_run or 'none'} can run"]
        if not can_run:
            return table
        parts = [(part, _hms(seconds)) for part, seconds in {**needs.parts, "all": needs.duration}.items()]
        time_besides = (
            f"at most {_hms(needs.volume_seconds)} for the live volumes, and " if needs.volume_seconds else ""
        )
        sums = f"{size(needs.total_bytes)} of {size(self.free_bytes)} free, {hms_text(needs.duration)}"
        return [
            *table[:2], aligned([("part", "time (h:min:s)"), *parts]), "",
            f"{table[2]}: {sums}, plus {time_besides}the time between them",
        ]  # fmt: skip

    def data(self) -> Mapping[str, Any]:
        """The plan as a mapping for other programs, for each scan and for all scans together. Times are in s, sizes in
        bytes, doses in Gy."""
        facts = {"valid": self.valid, "faults": self.faults, "free_bytes": self.free_bytes}
        return {"scans": [scan.data() for scan in self.scans], **facts, **self.needs.data()}

    def refuse_impossible(self) -> None:
        """Raise ConfigError with the faults of all scans, if any scan has a fault. Nothing was started."""
        of_scans = [_fault_line(scan, fault) for scan in self.scans for fault in scan.faults]
        if of_scans or self.faults:
            bad = count(sum(not scan.valid for scan in self.scans), "scan")
            failure = f"{bad} of {len(self.scans)} cannot run" if of_scans else "the scans do not fit on the disk"
            lines = [f"\n  {line}" for line in (*of_scans, *map(str, self.faults))]
            raise ConfigError("".join([f"Nothing was started, because {failure}:", *lines]))


def queue_of(scans: Iterable[PlannedScan]) -> QueuePlan:
    """The plan of these scans together."""
    planned = tuple(scans)
    can_run = [scan for scan in planned if scan.valid]
    disks = dict[int, tuple[Path, int]]()  # for each disk, a folder on it and the bytes that are needed there
    for scan in can_run:
        if scan.disk is not None:
            folder, needed = disks.get(number := scan.disk.stat().st_dev, (scan.disk, 0))
            disks[number] = folder, needed + scan.needs.total_bytes
    disk_space = [(folder, needed, shutil.disk_usage(folder).free) for folder, needed in disks.values()]
    faults = [
        ScanFault(
            f"all scans that can run need {size(needed)} plus a reserve of a tenth on the disk of {folder}, which "
            f"has {size(free)} free. Free some space, or choose another storage.folder"
        )
        for folder, needed, free in disk_space
        if needed * ROOM > free
    ]
    free_bytes = min((free for _, _, free in disk_space), default=0)
    return QueuePlan(planned, tuple(faults), all_needs(scan.needs for scan in can_run), free_bytes)


def _fault_line(scan: PlannedScan, fault: ScanFault) -> str:
    """A line about a fault, with the name of its scan."""
    text, sample = str(fault), f" ({scan.sample})" if scan.sample else ""
    return text if text.startswith(scan.source) else f"{scan.source}{sample}: {text}"


def _cells(scan: PlannedScan) -> tuple[str, ...]:
    """Frames, MB, time, requests to the operator and dose (Gy) as text; `-` for a value that is not known."""
    needs = scan.needs
    if not needs.parts:
        return ("-",) * 5
    n_requests, dose = sum(times for _, times in needs.operator), needs.dose_gy
    sums = (str(needs.n_frames), f"{needs.total_bytes / 1e6:.1f}", _hms(needs.duration), str(n_requests))
    return (*sums, "-" if dose is None else f"{dose:.4g}")


def _hms(seconds: float) -> str:
    """`1:02:03`."""
    return hms_text(seconds).split(" ")[0]
