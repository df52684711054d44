"""Plan of a queue: which of several scans can run, what each needs, and what all of them need, without devices."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from beamline.config.load import Config
from beamline.core.errors import ConfigError
from beamline.core.text import aligned, count, size
from beamline.plan.limits import ROOM
from beamline.plan.plan import summed
from beamline.plan.timeline import hms_text
from beamline.scan.preflight import DryRun, OperatorRequest


@dataclass(frozen=True)
class ScanFault:
    """Why a scan cannot run: a sentence. file, line: where the value is given; None: it is not in a file, or the
    sentence is about no single line."""

    message: str
    file: str | None = None
    line: int | None = None

    def __str__(self) -> str:
        place = "" if self.file is None else self.file if self.line is None else f"{self.file}:{self.line}"
        return self.message if self.message.startswith(place) else f"{place}: {self.message}"


@dataclass(frozen=True, eq=False)
class PlannedScan:
    """A scan of a queue, planned without devices.

    Attributes:
        source: the file of its configuration, or the line of its table (day.csv:3).
        sample: name of the sample; empty if the configuration cannot be read.
        faults: why the scan cannot run; empty: it can.
        warnings: sentences on values that are unusual, for example because of a wrong unit.
        parts: s by what they are spent on: `dark`, `flat`, `projection`, `offset_view` (each with the moves of the
            stage), `warm_up`, `return`. The time for moving shutter and sample is not known.
        n_frames, total_bytes: of its file, or of its files if it is a series of energies.
        dose_gy: dose that the sample absorbs; None: `optics.dose_rate_gy_s` is not stated.
        volume_seconds: s, at most, for which the queue waits afterwards until the live volume is finished.
        operator: what the scan asks the operator to do.
        disk: an existing folder on the disk of the file; None: there is no file.
        config: None if it cannot be read.
        worked: timeline and limits; None if they cannot be computed.
    """

    source: str
    sample: str = ""
    faults: tuple[ScanFault, ...] = ()
    warnings: tuple[str, ...] = ()
    parts: Mapping[str, float] = field(default_factory=dict)
    n_frames: int = 0
    total_bytes: int = 0
    dose_gy: float | None = None
    volume_seconds: float = 0.0
    operator: tuple[OperatorRequest, ...] = ()
    disk: Path | None = None
    config: Config | None = None
    worked: DryRun | None = None

    @property
    def valid(self) -> bool:
        """True if the scan can run."""
        return not self.faults

    @property
    def duration(self) -> float:
        """Seconds of the scan, without moves of shutter and sample; 0 if they cannot be computed."""
        return sum(self.parts.values())

    def data(self) -> Mapping[str, Any]:
        """The values for programs: s, bytes, Gy."""
        facts = {name: getattr(self, name) for name in ("source", "sample", "valid", "duration", "warnings")}
        sums = {name: getattr(self, name) for name in ("parts", "n_frames", "total_bytes", "dose_gy", "volume_seconds")}
        asked = {"operator": [request._asdict() for request in self.operator]}
        return {**(self.worked.data() if self.worked else {}), **facts, **sums, **asked, "faults": self.faults}


@dataclass(frozen=True, eq=False)
class QueuePlan:
    """Several scans, one after the other, planned without devices. Sums are those of the scans that can run.

    Attributes:
        scans: in their order.
        faults: why the scans cannot all run, though each alone can: a disk is too small for all of them.
        free_bytes: of the fullest disk; 0 without a scan that can run.
    """

    scans: tuple[PlannedScan, ...]
    faults: tuple[ScanFault, ...] = ()
    free_bytes: int = 0

    @property
    def can_run(self) -> tuple[PlannedScan, ...]:
        """The scans without faults."""
        return tuple(scan for scan in self.scans if scan.valid)

    @property
    def valid(self) -> bool:
        """True if all scans can run."""
        return not self.faults and len(self.can_run) == len(self.scans)

    @property
    def parts(self) -> Mapping[str, float]:
        """s by what they are spent on, as in `PlannedScan.parts`."""
        return summed(*(part for scan in self.can_run for part in scan.parts.items()))

    @property
    def duration(self) -> float:
        """Seconds of the scans, without changes of samples and moves of shutter and sample."""
        return sum(scan.duration for scan in self.can_run)

    @property
    def total_bytes(self) -> int:
        """Bytes of all files."""
        return sum(scan.total_bytes for scan in self.can_run)

    @property
    def dose_gy(self) -> float | None:
        """Gy of all scans that state a dose rate; None if none does."""
        doses = [scan.dose_gy for scan in self.can_run if scan.dose_gy is not None]
        return sum(doses) if doses else None

    @property
    def volume_seconds(self) -> float:
        """Seconds, at most, in which the live volumes are finished after their scans."""
        return sum(scan.volume_seconds for scan in self.can_run)

    def lines(self) -> list[str]:
        """A line for each scan, the time by parts, and the sums."""
        rows = [(scan.sample or "-", scan.source, "yes" if scan.valid else "no", *_cells(scan)) for scan in self.scans]
        head = ("scan", "from", "can run", "frames", "size (MB)", "time (h:min:s)", "requests", "dose (Gy)")
        table = [aligned([head, *rows]), ""]
        whole = f"{count(len(self.scans), 'scan')}, {len(self.can_run) or 'none'} can run"
        if not self.can_run:
            return [*table, whole]
        parts = [(part, _hms(seconds)) for part, seconds in {**self.parts, "all": self.duration}.items()]
        rest = f"at most {_hms(self.volume_seconds)} for the live volumes, and " if self.volume_seconds else ""
        return [
            *table,
            aligned([("part", "time (h:min:s)"), *parts]),
            "",
            f"{whole}: {size(self.total_bytes)} of {size(self.free_bytes)} free, {hms_text(self.duration)}, plus "
            f"{rest}the time between them",
        ]

    def data(self) -> Mapping[str, Any]:
        """The plan for programs: s, bytes and Gy of each scan and of all."""
        sums = ("valid", "faults", "duration", "parts", "total_bytes", "free_bytes", "dose_gy", "volume_seconds")
        return {"scans": [scan.data() for scan in self.scans], **{name: getattr(self, name) for name in sums}}

    def refuse_impossible(self) -> None:
        """Raise ConfigError with all faults of all scans. Nothing was started."""
        found = [_named(scan, fault) for scan in self.scans for fault in scan.faults]
        if found or self.faults:
            bad = count(len(self.scans) - len(self.can_run), "scan")
            what = f"{bad} of {len(self.scans)} cannot run" if found else "the scans do not fit on the disk"
            lines = [f"\n  {line}" for line in (*found, *map(str, self.faults))]
            raise ConfigError("".join([f"Nothing was started, because {what}:", *lines]))


def queue_of(scans: Iterable[PlannedScan]) -> QueuePlan:
    """The plan of these scans together."""
    planned = tuple(scans)
    disks = dict[int, tuple[Path, int]]()  # a folder on each, and the bytes that are needed there
    for scan in planned:
        if scan.disk is not None and scan.valid:
            folder, needed = disks.get(number := scan.disk.stat().st_dev, (scan.disk, 0))
            disks[number] = folder, needed + scan.total_bytes
    room = [(folder, needed, shutil.disk_usage(folder).free) for folder, needed in disks.values()]
    faults = [
        ScanFault(
            f"all scans that can run need {size(needed)} plus a tenth on the disk of {folder}, which has {size(free)} "
            "free. Free some space, or choose another storage.folder"
        )
        for folder, needed, free in room
        if needed * ROOM > free
    ]
    return QueuePlan(planned, tuple(faults), min((free for _, _, free in room), default=0))


def _named(scan: PlannedScan, fault: ScanFault) -> str:
    """A line about a fault, which names its scan."""
    text, sample = str(fault), f" ({scan.sample})" if scan.sample else ""
    return text if text.startswith(scan.source) else f"{scan.source}{sample}: {text}"


def _cells(scan: PlannedScan) -> tuple[str, ...]:
    """Frames, MB, time, requests to the operator and dose (Gy) as text; `-` for what is not known."""
    dose = "-" if scan.dose_gy is None else f"{scan.dose_gy:.4g}"
    if not scan.parts:
        return ("-", "-", "-", "-", dose)
    asked = sum(times for _, times in scan.operator)
    return (str(scan.n_frames), f"{scan.total_bytes / 1e6:.1f}", _hms(scan.duration), str(asked), dose)


def _hms(seconds: float) -> str:
    """`1:02:03`."""
    return hms_text(seconds).split(" ")[0]
