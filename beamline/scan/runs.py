"""The runs in a folder: sample and state of each run, from the records of its parts. If an earlier version of this
program made the run, they come from its files."""

from __future__ import annotations

import os
import time
from calendar import timegm
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from beamline.core.errors import ConfigError, DataError
from beamline.core.events import Event, FrameStored, NextChosen, ScanDone, Sink, StateEntered
from beamline.core.files import CONFIG, EVENTS, SCAN, STAMP, is_below, parts_of
from beamline.core.text import one_line, size
from beamline.plan.passes import ended_by
from beamline.scan.control import State, running, series_in
from beamline.storage.interrupted import next_step
from beamline.storage.run_record import DIED, FlagCounts, RecordFile, RunRecord, alive, read_record, write_record
from beamline.storage.writer_lock import held

NOT_KNOWN = "not known"  # State of a run of an earlier version whose file is not closed

_OF_STATUS = {"complete": State.DONE, "stopped": State.STOPPED, "failed": State.FAILED}


@dataclass(frozen=True)
class Run:
    """A run, with all its parts.

    Attributes:
        folder: folder of the run. sample: name of the sample. time: time at which the run began, s since the Unix
            epoch. frames: number of frames in its files; None: not known. planned: number of frames of earlier parts,
            plus the planned frames of the newest part; None: not known. ended: who ended the scan before the end of its
            plan, and why; "" if nobody ended it. flags: number of frames that the monitor flagged, by check and level.
            state: state of the newest part, see docs/states.md; `died` if the process ended without writing its final
            state. bytes: size of all files in the folder. parts: number of parts: 1, plus one for each time that the
            run was resumed. next_step: what the user can do if the process was killed or the state is not known; ""
            otherwise.
    """

    folder: Path
    sample: str
    time: float
    frames: int | None
    planned: int | None
    flags: FlagCounts
    state: str
    bytes: int
    parts: int
    next_step: str = ""
    ended: str = ""

    @property
    def over(self) -> bool:
        """True if the run has ended. (It may still be resumed.)"""
        return self.state not in [state for state in State if not state.ended]


def runs_in(folder: Path) -> list[Path]:
    """The folders of runs in a folder, newest first, including those of a series."""
    runs = [run for place in (folder, *series_in(folder)) for run in place.glob("*/") if is_below(run, EVENTS)]
    return sorted(runs, key=lambda run: (_began(run), _sort_key(run)), reverse=True)


def newest(folder: Path) -> Path:
    """The folder of the running scan; if no scan is running, that of the newest run. Raises ConfigError if there is no
    run."""
    candidates = running(folder)[-1:] or runs_in(folder)
    if not candidates:
        raise ConfigError(f"{folder} contains no run. Name the folder of a run, or a scan file.")
    return candidates[0]


def describe(run: Path) -> Run:
    """The summary of a run from the records of its parts. No pixel is read."""
    # read first, because a new part exists before this lock is released
    locked = held(run / EVENTS, exclusively=True)
    parts = [run, *(part for part in parts_of(run)[1:] if is_below(part, EVENTS))]  # it is created after the record
    records = [record_of(part) for part in parts]
    frames: int | None = 0
    earlier_frames = frames  # of the parts before the newest one
    flags: dict[str, dict[str, int]] = {}
    for record in records:
        before, earlier_frames = 0 if record.joined else frames, frames
        frames = None if record.frames is None or before is None else before + record.frames
        for check, levels in record.flags.items():
            flags[check] = dict(Counter(flags.get(check)) + Counter(levels))
    state = State.PREPARING if locked and alive(parts[-1]) is False else records[-1].state
    return Run(
        folder=run,
        sample=records[0].sample or run.name.partition("_")[2] or run.name,
        time=_began(run),
        frames=frames,
        planned=None if records[-1].planned is None or earlier_frames is None else earlier_frames + records[-1].planned,
        flags=flags,
        state=state,
        bytes=sum(_size(Path(folder, name)) for folder, _, names in os.walk(run) for name in names),
        parts=len(parts),
        next_step=next_step(run / SCAN) if state in (DIED, NOT_KNOWN) else "",
        ended=next((record.ended for record in records if record.ended), ""),
    )


HEAD = ("time (UTC)", "sample", "frames", "state", "size", "flags", "folder")


def cells(run: Run) -> tuple[str, ...]:
    """The row of a run in the table with the header HEAD. Each cell is one line of printable text."""
    from beamline.storage.flag_legend import counted

    frames = "not known" if run.frames is None else str(run.frames)
    if run.planned is not None and (run.ended or run.state != State.DONE):
        frames += f" of {run.planned}"
    parts = f" in {run.parts} parts" if run.parts > 1 else ""
    of_series = f"{run.folder.parent.name}/" if (run.folder.parent / CONFIG).is_file() else ""
    row = (
        time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(run.time)), run.sample, frames + parts, run.state,
        size(run.bytes), counted(run.flags) if run.flags else "-", f"{of_series}{run.folder.name}",
    )  # fmt: skip
    return tuple(map(one_line, row))


def record_sink(file: RecordFile) -> Sink:
    """A sink that keeps the record of a part up to date with the events of its scan."""

    def keep(event: Event) -> None:
        record = file.record
        match event:
            case StateEntered(state=state, source=None) if state in [*State]:
                record = replace(record, state=state, over=State(state).ended)
            case NextChosen():
                record = replace(record, ended=ended_by([event.data]))
            case FrameStored(n=n):
                record = replace(record, frames=n)
            case ScanDone(result=scan):
                flags = {check: dict(levels) for check, levels in scan.flags.items()}
                record = replace(record, frames=scan.n_frames, joined=scan.path.name != SCAN, flags=flags)
        file.put(record, at_once=isinstance(event, StateEntered | ScanDone) or not file.record.frames)

    return keep


def record_of(part: Path) -> RunRecord:
    """The record of a part. If its process was killed, or if it has no record, the file is read.

    If the file cannot be read, for example because the process was killed while it created the file, the number of
    frames is the last one in the record. If the record has flags, they are used, because the file does not contain
    flags of the level `info`.
    """
    record = read_record(part)
    if record is not None and record.state != DIED:
        return record
    by_file = _record_of_file(part / SCAN)
    if record is None:
        return by_file
    frames = record.frames if by_file.frames is None else by_file.frames
    return replace(record, frames=frames, flags=record.flags or by_file.flags, joined=False)


def end_record(part: Path) -> None:
    """Give the record of a part whose process was killed the state of its closed file."""
    if (record := record_of(part)).state == DIED and (state := _record_of_file(part / SCAN).state) != NOT_KNOWN:
        write_record(part, replace(record, state=state, over=True))


def _record_of_file(scan: Path) -> RunRecord:
    """Values from the beginning of a scan file."""
    from beamline.storage import hdf5
    from beamline.storage.flag_legend import read_flags
    from beamline.storage.writers import layout
    from beamline.storage.writers.rows import ending_in

    with suppress(DataError, OSError), hdf5.open_hdf5(scan, follow=True) as file, hdf5.readable(scan):
        n, state = int(file[layout.COMMITTED][()]), NOT_KNOWN
        if file[layout.FINISHED][()]:
            state = _OF_STATUS.get(ending_in(file).status, State.FAILED)
        return RunRecord(state, frames=n, flags=read_flags(file, n).counts() if n else {})
    return RunRecord(NOT_KNOWN, frames=None)


def _began(run: Path) -> float:
    """The time at which the run began. It comes from the name of the folder, which a simulated clock does not change;
    otherwise from the first file."""
    with suppress(ValueError):
        return timegm(time.strptime(run.name.partition("_")[0], STAMP))
    return (run / CONFIG).stat().st_mtime if (run / CONFIG).exists() else 0.0


def _sort_key(run: Path) -> tuple[int, str]:
    """Sort key for runs of the same second and sample: the number that distinguishes them, then the name."""
    number = run.name.rpartition("-")[2]
    return (int(number) if number.isdecimal() and "_" in run.name.rpartition("-")[0] else 1), run.name


def _size(path: Path) -> int:
    """Bytes of a file; 0 if it was removed in the meantime."""
    with suppress(OSError):
        return path.lstat().st_size
    return 0
