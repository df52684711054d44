"""Runs of a folder: sample and outcome of each, by its log of events, or by its file if the log ends early."""

from __future__ import annotations

import os
import time
from calendar import timegm
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beamline.core.errors import ConfigError, DataError
from beamline.core.events import event_in, whole_lines
from beamline.core.files import CONFIG, CONTROL, EVENTS, SCAN, STAMP, is_below, open_below, parts_of
from beamline.core.text import one_line, size
from beamline.scan.control import State, running, state_of
from beamline.storage.interrupted import next_step

DIED = "died"  # State of a run whose process has ended without a final event

_HEAD, _TAIL = 2**20, 2**17  # bytes of a log that are read: the sample is at its head, the outcome at its end
_ENDING = 600.0  # real s since the last line of a log, within which a complete scan may still be ending
_OF_STATUS = {"complete": State.DONE, "stopped": State.STOPPED, "failed": State.FAILED}

FlagCounts = Mapping[str, Mapping[str, int]]


@dataclass(frozen=True)
class Run:
    """A run, with all its parts.

    Attributes:
        folder: of the run.
        sample: its name.
        time: s since the Unix epoch, when it began.
        frames: in its files; None: not known.
        planned: frames that the first part was to have; None: not known.
        flags: frames that the monitor flagged: their number by check, then by level.
        state: of its newest part, see docs/states.md; `died` if its process ended without a final event.
        bytes: of all files in the folder.
        parts: 1, and one for each time that it was resumed.
        next_step: what can be done with one that died; "" for others.
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

    @property
    def over(self) -> bool:
        """Whether the run has ended; it may be resumed."""
        return self.state == DIED or self.state in _ENDED


def runs_in(folder: Path) -> list[Path]:
    """The folders of runs in a folder, newest first, including those of the energies of a series."""
    within = [path for path in folder.glob("*/") if not is_below(path, EVENTS) and (path / CONFIG).is_file()]
    runs = [run for place in (folder, *within) for run in place.glob("*/") if is_below(run, EVENTS)]
    return sorted(runs, key=lambda run: (_began(run), _numbered(run)), reverse=True)


def newest(folder: Path) -> Path:
    """The folder of the scan that is running, else of the newest run. Raises ConfigError if there is no run."""
    candidates = running(folder)[-1:] or runs_in(folder)
    if not candidates:
        raise ConfigError(f"There is no run in {folder}. Name the folder of a run, or a scan file.")
    return candidates[0]


def describe(run: Path) -> Run:
    """Read the metadata of a run from its log, or from its files if the log is incomplete. Reads no pixel."""
    parts = parts_of(run)
    heads = [_head(part) for part in parts]
    frames: int | None = 0
    flags: dict[str, dict[str, int]] = {}
    state = ""
    for part in parts:
        state, n, joined, run_flags = _part(part)
        frames = n if joined or frames is None or n is None else frames + n
        for check, levels in run_flags.items():
            flags[check] = dict(Counter(flags.get(check)) + Counter(levels))
    return Run(
        folder=run,
        sample=str(heads[0].get("sample") or run.name.partition("_")[2] or run.name),
        time=_began(run),
        frames=frames,
        planned=_whole(heads[0].get("n_frames")),
        flags=flags,
        state=state,
        bytes=sum(_sizes(run)),
        parts=len(parts),
        next_step=next_step(run / SCAN) if state == DIED else "",
    )


HEAD = ("time (UTC)", "sample", "frames", "state", "size", "flags", "folder")


def cells(run: Run) -> tuple[str, ...]:
    """The row of a run in the table with header HEAD, one line of printable text for each cell."""
    from beamline.storage.flag_legend import counted

    frames = "not known" if run.frames is None else str(run.frames)
    if run.planned is not None and run.state != State.DONE:
        frames += f" of {run.planned}"
    parts = f" in {run.parts} parts" if run.parts > 1 else ""
    of_series = f"{run.folder.parent.name}/" if (run.folder.parent / CONFIG).is_file() else ""
    row = (
        time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(run.time)), run.sample, frames + parts, run.state,
        size(run.bytes), counted(run.flags) if run.flags else "-", f"{of_series}{run.folder.name}",
    )  # fmt: skip
    return tuple(map(one_line, row))


def _began(run: Path) -> float:
    """When the run began: by the folder's name, which a simulated clock does not change, or else by its log."""
    with suppress(ValueError):
        return timegm(time.strptime(run.name.partition("_")[0], STAMP))
    return float(_head(run).get("time") or 0.0)


def _numbered(run: Path) -> tuple[int, str]:
    """The number that tells runs of one second and sample apart, then the name."""
    number = run.name.rpartition("-")[2]
    return (int(number) if number.isdecimal() and "_" in run.name.rpartition("-")[0] else 1), run.name


def _part(part: Path) -> tuple[str, int | None, bool, FlagCounts]:
    """State, frames, whether these are of all parts so far, and flags."""
    last_events = _last_events(part)
    done = last_events.get("done") or last_events.get("scan_done") or {}
    state = str(last_events.get("state", {}).get("state", ""))
    if not (state in _ENDED or "failed" in last_events):
        state = _unended(part, done)
    if (frames := _whole(done.get("n_frames"))) is not None:
        flags = done.get("flags")
        return state, frames, Path(str(done.get("path"))).name != SCAN, _flags(flags)
    if state != DIED and state not in _ENDED:  # it runs
        return state, _whole(last_events.get("frame", {}).get("n")) or 0, False, {}
    frames, flags = _of_file(part / SCAN)
    return state, frames, False, flags


_ENDED = frozenset(state for state in State if state.ended)


def _unended(part: Path, done: Mapping[str, Any]) -> str:
    """The state of a part whose log has no end: it runs, or its process has died."""
    from beamline.storage.writer_lock import held

    if not (part / CONTROL).is_dir():
        return DIED
    if held(part / SCAN):
        return state_of(part)
    if not done:
        return DIED
    with suppress(OSError):  # the volume is finished after the scan's file was closed
        if time.time() - (part / EVENTS).stat().st_mtime < _ENDING:
            return State.FINISHING
    return _OF_STATUS.get(str(done.get("status")), State.FAILED)


def _of_file(scan: Path) -> tuple[int | None, FlagCounts]:
    """Frames and flags by the head of a scan file; None where it does not open."""
    from beamline.storage import hdf5
    from beamline.storage.flag_legend import read_flags
    from beamline.storage.writers import layout

    with suppress(DataError, OSError), hdf5.open_hdf5(scan, follow=True) as file, hdf5.readable(scan):
        n = int(file[layout.COMMITTED][()])
        return n, read_flags(file, n).counts() if n else {}
    return None, {}


def _head(part: Path) -> Mapping[str, Any]:
    """The first event of a run; empty without one."""
    with suppress(OSError), open_below(part, EVENTS) as file:
        for line in whole_lines(file, _HEAD):
            if (event := _event(line, ("run_started",))) is not None:
                return event
    return {}


def _last_events(part: Path) -> Mapping[str, Mapping[str, Any]]:
    """The last event of each kind that tells the outcome of a part, from the end of its log."""
    last_events: dict[str, Mapping[str, Any]] = {}
    with suppress(OSError), open_below(part, EVENTS) as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - _TAIL))
        for line in reversed(file.read(_TAIL).splitlines()):
            kinds = tuple(kind for kind in ("done", "failed", "scan_done", "state", "frame") if kind not in last_events)
            if (event := _event(line, kinds)) is not None and "source" not in event:  # an event of the live volume
                last_events[event["event"]] = event
            if last_events.keys() & {"done", "scan_done"} and "state" in last_events:
                break
    return last_events


def _event(line: bytes, kinds: Iterable[str]) -> dict[str, Any] | None:
    """The event in a line, if it is of one of these kinds; keys have the order of `Event.to_json`."""
    return event_in(line) if any(line.startswith(f'{{"event": "{kind}"'.encode()) for kind in kinds) else None


def _whole(value: object) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def _flags(value: object) -> FlagCounts:
    flags = value if isinstance(value, dict) else {}
    return {
        str(check): {str(level): n for level, n in levels.items() if isinstance(n, int)}
        for check, levels in flags.items()
        if isinstance(levels, dict)
    }


def _sizes(folder: Path) -> Iterator[int]:
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            with suppress(OSError):
                if entry.is_dir(follow_symlinks=False):
                    yield from _sizes(Path(entry.path))
                else:
                    yield entry.stat(follow_symlinks=False).st_size
