"""The record of a run: a small file in the folder of each of its parts, and locks that tell whether a process is at
work there.

The process of a part locks the part's configuration as long as it lives, that is, until the end of its final fit. The
operating system releases the lock when the process ends. A process that recovers or continues a run locks the events of
the run.
"""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from pydantic import TypeAdapter

from beamline.core.events import json_of
from beamline.core.files import CONFIG, EVENTS, RECORD, SETTINGS, bytes_below, is_below
from beamline.storage.writer_lock import WriterLock, held

DIED = "died"  # State of a part whose process has ended without writing its last one
EVERY = 1.0  # real s between two writes of the record while only its number of frames grows
_TRIES, _PAUSE = 20, 0.01  # real s between tries to write the last record: Windows replaces no file that is being read

FlagCounts = dict[str, dict[str, int]]


@dataclass(frozen=True)
class RunRecord:
    """What a part of a run is doing, and what it has.

    Attributes:
        state: see docs/states.md.
        over: True if this is the last state.
        sample: its name.
        frames: number of frames in the file of the part, or, if `joined`, in the file that joins the parts so far;
            None: not known.
        planned: planned number of frames; None: not known.
        flags: frames that the monitor flagged: their number by check, then by level; empty before its file is closed.
        ended: who ended the scan before the end of its plan, and why; "" if nobody did.
        time: when this was written, s since the Unix epoch.
    """

    state: str
    over: bool = False
    sample: str = ""
    frames: int | None = 0
    joined: bool = False
    planned: int | None = None
    flags: FlagCounts = field(default_factory=dict)
    ended: str = ""
    time: float = field(default=0.0, compare=False)


_RECORDS = TypeAdapter(RunRecord)


def read_record(part: Path) -> RunRecord | None:
    """The record of a part; its state is `died` if the process ended without writing its last state.

    None: the part has no record, because an earlier version wrote it, or the record is damaged.
    """
    lives = alive(part)  # asked first: the last record is written before the lock goes
    with suppress(OSError, ValueError):
        record = _RECORDS.validate_json(bytes_below(part, RECORD, SETTINGS), strict=True)
        return record if record.over or lives is not False else replace(record, state=DIED)
    return None


def is_series_folder(folder: Path) -> bool:
    """True if the folder has a configuration, but is not the folder of a run."""
    return (folder / CONFIG).is_file() and not is_below(folder, EVENTS) and read_record(folder) is None


def write_record(part: Path, record: RunRecord) -> None:
    """Write the record of a part. Readers see either the previous record or this one, never a part of it. Raises
    OSError."""
    path = part / RECORD
    partial = path.with_name(f".{RECORD}.new")
    partial.write_text(json_of(replace(record, time=time.time())), encoding="utf-8")
    partial.replace(path)


def alive(part: Path) -> bool | None:
    """True if the process of a part lives; None: its file system has no locks."""
    return held(part / CONFIG, exclusively=True)


class RecordFile:
    """The record of a part that this process takes, until `close`. Locks the part, whose configuration is there.

    Raises:
        OSError: the record cannot be written, or another process holds the part.
    """

    def __init__(self, part: Path, record: RunRecord) -> None:
        self._part, self.record, self._written_at = part, record, time.monotonic()
        self._lock = WriterLock(part / CONFIG, exclusive=True)
        write_record(part, record)
        self._written = record

    def close(self) -> None:
        """Release the part; if it has no last state, its state becomes `failed`."""
        last = self.record if self.record.over else replace(self.record, state="failed", over=True)
        for _ in range(_TRIES):
            self.put(last)
            time.sleep(_PAUSE * (self._written != last))
        self._lock.release()

    def put(self, record: RunRecord, *, at_once: bool = True) -> None:
        """Record what the part is doing: immediately with `at_once`, otherwise at most once in EVERY seconds. If the
        disk fails, the next call tries again."""
        self.record = record
        if record == self._written or not (at_once or time.monotonic() - self._written_at > EVERY):
            return
        with suppress(OSError):
            write_record(self._part, record)
            self._written, self._written_at = record, time.monotonic()
