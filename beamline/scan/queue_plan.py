"""Plan of a queue: which of several scans can run, what each needs, and what all of them need, without devices."""

from __future__ import annotations

import csv
import io
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from beamline.config.load import Config, ReadConfig, override_of, read_config
from beamline.config.tree import Override
from beamline.core.errors import ConfigError, DataError, user_message
from beamline.core.files import SETTINGS, TABLE, text_in
from beamline.core.text import aligned, count, size
from beamline.plan.limits import ROOM
from beamline.plan.plan import summed
from beamline.plan.timeline import hms_text
from beamline.scan.preflight import DryRun, OperatorRequest, doubts, dry_run
from beamline.storage.writer_lock import no_locks

_CONFIG = "config"  # the column with the configuration's file
_NOTHING = " Nothing was started."
_KEY = re.compile(rf"\b(?:{'|'.join(Config.model_fields)})(?:\.[a-z]\w*)+")


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
        dose: Gy that the sample absorbs; None: `optics.dose_rate_gy_s` is not stated.
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
    dose: float | None = None
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

    def cells(self) -> tuple[str, ...]:
        """Frames, MB, time, requests to the operator and dose (Gy) as text; `-` for what is not known."""
        dose = "-" if self.dose is None else f"{self.dose:.4g}"
        if not self.parts:
            return ("-", "-", "-", "-", dose)
        asked = sum(times for _, times in self.operator)
        return (str(self.n_frames), f"{self.total_bytes / 1e6:.1f}", _hms(self.duration), str(asked), dose)

    def data(self) -> Mapping[str, Any]:
        """The values for programs: s, bytes, Gy."""
        facts = {name: getattr(self, name) for name in ("source", "sample", "valid", "duration", "warnings")}
        sums = {name: getattr(self, name) for name in ("parts", "n_frames", "total_bytes", "dose", "volume_seconds")}
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
    def dose(self) -> float | None:
        """Gy of all scans that state a dose rate; None if none does."""
        doses = [scan.dose for scan in self.can_run if scan.dose is not None]
        return sum(doses) if doses else None

    @property
    def volume_seconds(self) -> float:
        """Seconds, at most, in which the live volumes are finished after their scans."""
        return sum(scan.volume_seconds for scan in self.can_run)

    def lines(self) -> list[str]:
        """A line for each scan, the time by parts, and the sums."""
        rows = [
            (scan.sample or "-", scan.source, "yes" if scan.valid else "no", *scan.cells())
            for scan in self.scans
        ]  # fmt: skip
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
        sums = ("valid", "faults", "duration", "parts", "total_bytes", "free_bytes", "dose", "volume_seconds")
        return {"scans": [scan.data() for scan in self.scans], **{name: getattr(self, name) for name in sums}}

    def refuse_impossible(self) -> None:
        """Raise ConfigError with all faults of all scans. Nothing was started."""
        found = [_named(scan, fault) for scan in self.scans for fault in scan.faults]
        if found or self.faults:
            bad = count(len(self.scans) - len(self.can_run), "scan")
            what = f"{bad} of {len(self.scans)} cannot run" if found else "the scans do not fit on the disk"
            lines = [f"\n  {line}" for line in (*found, *map(str, self.faults))]
            raise ConfigError("".join([f"Nothing was started, because {what}:", *lines]))


def plan_queue(
    scans: Iterable[Path | Mapping[str, object] | PlannedScan],
    overrides: Sequence[Override] = (),
    *,
    place: Path | None = None,
    rehearse: bool = False,
    no_live: Callable[[str], None] | None = None,
) -> QueuePlan:
    """Plan several scans without devices. A scan that cannot run does not end the planning of the others.

    Args:
        scans: files of configurations, tables of scans, rows of such tables as mappings, and scans that were planned
            already. A table is a CSV file. Its first line names the column `config`, the file of a configuration
            (relative to the table), and keys of configurations, whose values go before those of the file; an empty cell
            changes nothing.
        overrides: of all scans, after those of a table.
        place: folder in which the folders of the runs would be created; None: the configured ones.
        rehearse, no_live: as of `load`.
    """

    locks = cache(no_locks)  # once a folder: on a network disk it takes a while

    def planned(source: str, file: Path, own: Sequence[Override]) -> PlannedScan:
        try:
            found = read_config(file, (*own, *overrides), rehearse=rehearse, no_live=no_live)
        except (ConfigError, DataError, OSError) as error:
            return PlannedScan(source, faults=_faults_of(error, str(file)))
        return plan_of_config(found.config, place, source, found, locks)

    described = (scan for each in scans for scan in _described(each))
    return queue_of(scan if isinstance(scan, PlannedScan) else planned(*scan) for scan in described)


_Described = tuple[str, Path, Sequence[Override]]
"""A scan: its source, the file of its configuration, and overrides."""


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


def _described(scan: Path | Mapping[str, object] | PlannedScan) -> Iterator[_Described | PlannedScan]:
    """The scans of a file, a table or a row; those that are not described as expected are planned with that fault."""
    if isinstance(scan, PlannedScan):
        yield scan
        return
    if isinstance(scan, Path):
        yield from _rows(scan) if scan.suffix.lower() == TABLE else [(str(scan), scan, ())]
        return
    source = str(scan.get(_CONFIG, "a mapping"))
    try:
        if not isinstance(file := scan.get(_CONFIG), str | Path):
            raise ConfigError(
                f"the mapping {dict(scan)} names no configuration; expected its file under {_CONFIG!r}.{_NOTHING}"
            )
        yield source, Path(file), [override_of(key, value) for key, value in scan.items() if key != _CONFIG]
    except ConfigError as error:
        yield PlannedScan(source, faults=_faults_of(error))


def _rows(table: Path) -> Iterator[_Described | PlannedScan]:
    """The scan of each line of a table."""
    try:
        reader = csv.reader(io.StringIO(text_in(table, SETTINGS), newline=""), strict=True)
        numbered = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except (OSError, csv.Error) as error:
        yield PlannedScan(str(table), faults=(ScanFault(f"{table} cannot be read as a table ({error})", str(table)),))
        return
    head = numbered[0][1] if numbered else []
    if _CONFIG not in head or "" in head or len(set(head)) < len(head) or not any(any(row) for _, row in numbered[1:]):
        fault = (
            f"{table} is not a table of scans. Expected a first line with names, such as "
            "config,sample.name,scan.exposure_s, each only once, then one line per scan"
        )
        yield PlannedScan(str(table), faults=(ScanFault(fault, str(table)),))
        return
    for number, row in numbered[1:]:
        if not any(row):
            continue
        cells, place = dict(zip(head, row, strict=False)), f"{table}:{number}"
        if len(row) > len(head) or not cells.get(_CONFIG):
            fault = (
                f"{','.join(row)!r} has {count(len(row), 'cell')}; expected {len(head)}, with a file under {_CONFIG}"
            )
            yield PlannedScan(place, faults=(ScanFault(fault, str(table), number),))
            continue
        own = [(f"{key}={value}", place) for key, value in cells.items() if key != _CONFIG and value]
        yield place, table.parent / cells[_CONFIG], own


def plan_of_config(
    config: Config,
    place: Path | None,
    source: str,
    read: ReadConfig | None = None,
    locks: Callable[[Path], str] = no_locks,
) -> PlannedScan:
    """The planned scan of a configuration.

    Args:
        place, source: as in `plan_queue` and `PlannedScan`.
        read: the configuration with its places, and with what is wrong with it; None: nothing is known to be.
        locks: as in `dry_run`.
    """
    faults = [] if read is None else [_placed_at(at, sentence) for at, sentence in read.faults]
    sample, worked, warnings = config.sample.name, None, list[str]()
    try:
        warnings = doubts(config)
        worked = dry_run(config, place, locks=locks)
    except (ConfigError, DataError, OSError) as error:
        if not faults:  # those may be its cause
            faults += [_named_in(read, fault) for fault in _faults_of(error)]
    if worked is None:
        return PlannedScan(source, sample, tuple(faults), tuple(warnings), config=config)
    warnings = [warning for warning in warnings if all(warning not in fault.message for fault in faults)]
    faults += [_named_in(read, ScanFault(sentence)) for sentence in worked.timeline.violations]
    return PlannedScan(
        source,
        sample,
        tuple(faults),
        tuple(warnings),
        parts=worked.parts,
        n_frames=worked.n_frames,
        total_bytes=worked.total_bytes,
        dose=worked.dose,
        volume_seconds=worked.volume_seconds,
        operator=worked.requests,
        disk=worked.disk,
        config=config,
        worked=worked,
    )


def _faults_of(error: Exception, file: str | None = None) -> tuple[ScanFault, ...]:
    if isinstance(error, ConfigError) and error.faults:
        return tuple(_placed_at(place, sentence) for place, sentence in error.faults)
    return (ScanFault(user_message(error).removesuffix(_NOTHING).removesuffix("."), file),)


def _placed_at(place: str, sentence: str) -> ScanFault:
    """The fault of a value by its place: file:line, or an option or a variable."""
    file, _, line = place.rpartition(":")
    is_file = line.isdecimal() and not place.startswith("--")
    return ScanFault(sentence, file, int(line)) if is_file else ScanFault(f"{place}: {sentence}")


def _named_in(read: ReadConfig | None, fault: ScanFault) -> ScanFault:
    """The fault with the place of the first key that its sentence names."""
    key = _KEY.search(fault.message)
    return fault if read is None or key is None else _placed_at(read.tree.origin((*key[0].split("."),)), fault.message)


def _named(scan: PlannedScan, fault: ScanFault) -> str:
    """A line about a fault, which names its scan."""
    text, sample = str(fault), f" ({scan.sample})" if scan.sample else ""
    return text if text.startswith(scan.source) else f"{scan.source}{sample}: {text}"


def _hms(seconds: float) -> str:
    """`1:02:03`."""
    return hms_text(seconds).split(" ")[0]
