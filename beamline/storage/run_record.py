"""The record of a run: a small file in the folder of each part, and locks that show whether a process is working there.

The process of a part keeps a lock on the part's configuration until it ends, that is, until after the final fit. The
operating system releases the lock when the process ends. A process that recovers or continues a run locks the event
file of the run.
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

DIED = "died"  # state of a part whose process ended without writing its last state
EVERY = 1.0  # real s between two writes of the record if only the number of frames changed
# real s between attempts to write the last record: Windows cannot replace a file that is being read
_TRIES, _PAUSE = 20, 0.01

FlagCounts = dict[str, dict[str, int]]


@dataclass(frozen=True)
class RunRecord:
    """What a part of a run is doing, and which data it contains.

    Attributes:
        state: see docs/states.md.
        over: True if the state cannot change any more.
        sample: name of the sample.
        frames: number of frames in the file of the part; with `joined`, in the file that joins the parts so far; None:
            not known.
        planned: planned number of frames; None: not known.
        flags: number of frames that the monitor flagged, by check and level. Empty before the file is closed.
        ended: who ended the scan before the end of its plan, and why; "" if the plan was completed.
        time: time at which the record was written, in s since the Unix epoch.
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

    None: the part has no record because an earlier version of the program wrote it, or the record is damaged.
    """
    lives = alive(part)  # checked first, because the last record is written before the lock is released
    with suppress(OSError, ValueError):
        record = _RECORDS.validate_json(bytes_below(part, RECORD, SETTINGS), strict=True)
        return record if record.over or lives is not False else replace(record, state=DIED)
    return None


def is_series_folder(folder: Path) -> bool:
    """True if the folder contains a configuration but is not the folder of a run."""
    return (folder / CONFIG).is_file() and not is_below(folder, EVENTS) and read_record(folder) is None


def write_record(part: Path, record: RunRecord) -> None:
    """Write the record of a part. Readers see either the previous record or this one, never an incomplete one. Raises
    OSError.
    """
    path = part / RECORD
    partial = path.with_name(f".{RECORD}.new")
    partial.write_text(json_of(replace(record, time=time.time())), encoding="utf-8")
    partial.replace(path)


def alive(part: Path) -> bool | None:
    """True if the process of a part is running. None: the file system has no locks."""
    return held(part / CONFIG, exclusively=True)


class RecordFile:
    """Writes the record of the part that this process works on. The part is locked until `close`; its configuration
    file must exist.

    Raises:
        OSError: the record cannot be written, or another process has locked the part.
    """

    def __init__(self, part: Path, record: RunRecord) -> None:
        self._part, self.record, self._written_at = part, record, time.monotonic()
        self._lock = WriterLock(part / CONFIG, exclusive=True)
        write_record(part, record)
        self._written = record

    def close(self) -> None:
        """Release the lock. If the part has not reached a last state, its state becomes `failed`."""
        last = self.record if self.record.over else replace(self.record, state="failed", over=True)
        for _ in range(_TRIES):
            self.put(last)
            time.sleep(_PAUSE * (self._written != last))
        self._lock.release()

    def put(self, record: RunRecord, *, at_once: bool = True) -> None:
        """Record what the part is doing: immediately with `at_once`, otherwise at most every EVERY seconds. If the disk
        fails, the next call tries again.
        """
        self.record = record
        if record == self._written or not (at_once or time.monotonic() - self._written_at > EVERY):
            return
        with suppress(OSError):
            write_record(self._part, record)
            self._written, self._written_at = record, time.monotonic()
