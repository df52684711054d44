"""Interrupted runs: finds the scan file and the volume of a run, and tells the user the next step if the run ended
early.

Every command that finds such a run prints the same advice, from `next_step`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

import h5py
import numpy as np

from beamline.core.errors import DataError
from beamline.core.files import CONFIG, EVENTS, JOINED, RECON, SCAN, parts_of, run_of
from beamline.plan.passes import Choice, Passes, passes_at_start, triggers_to_take
from beamline.plan.plan import Block, Mode
from beamline.storage import hdf5
from beamline.storage.parts import (
    files_with_frames,
    joined_file_of,
    offset_planned,
    plan_in,
    to_join,
    views_planned,
)
from beamline.storage.recorded_frames import decisions_in, frames_in
from beamline.storage.run_record import DIED, alive, read_record
from beamline.storage.superblock import marked_as_being_written, superblock
from beamline.storage.writer_lock import QUIET, abandoned, held
from beamline.storage.writers import layout
from drivers.base.frame import FrameKind


def scan_file(path: str | Path) -> Path:
    """The scan file at a path: the file itself, or for the folder of a run the file with all its parts.

    Raises:
        DataError: the path is a run without a scan file, a run whose parts are not joined, or a folder of several runs.
    """
    path = Path(path)
    if not path.is_dir():
        return path
    if not (path / SCAN).is_file():
        return _no_run(path, SCAN)
    if (path / JOINED).is_file():
        return path / JOINED
    if len(parts := files_with_frames(path)) > 1:
        step = next_step(parts[-1]) or f"{to_join(path)}."
        raise DataError(f"{path} has {len(parts)} parts that were not joined. {step}")
    return path / SCAN


def whole_scan(path: Path) -> Path:
    """The scan file of a path, with links resolved. For the folder of a run, or for any part of a resumed run, it is
    the file that joins all parts.

    If there is no scan at the path, the path itself is returned. Opening it then raises an error with the reason.
    """
    with suppress(DataError, RuntimeError):  # RuntimeError: links in a circle
        joined = None if path.is_dir() else joined_file_of(path)
        path = scan_file(path) if joined is None else joined[0]
    return Path(os.path.realpath(path))


def volume_file(path: Path) -> Path:
    """The volume file at a path: the file or folder itself, or for the folder of a run its recon.h5.

    Raises:
        DataError: the path is a run without a volume, or a folder of several runs.
    """
    if (path / RECON).is_file():
        return path / RECON
    if not (path / SCAN).is_file():
        return _no_run(path, RECON) if path.is_dir() else path
    scan = scan_file(path)
    make = f"`beamline recon {scan} -o {path / RECON}` makes it."
    raise DataError(f"{path} has no volume ({RECON}). {next_step(parts_of(path)[-1] / SCAN) or make}")


def _no_run(folder: Path, wanted: str) -> Path:
    """The folder itself, which may contain slices. Raises DataError if the folder is that of a run, or contains several
    runs.
    """
    if (folder / EVENTS).is_file():
        raise DataError(
            f"{folder} is the folder of a run without a {wanted}, because the run ended before its first frame."
        )
    if runs := sorted(log.parent for log in folder.glob(f"*/{EVENTS}")):
        newest = runs[-1]
        raise DataError(f"{folder} contains several runs. Name one of these runs, such as {newest}.")
    return folder


def next_step(scan: Path) -> str:
    """A sentence on the next step for a scan that is running, died or ended early; "" if nothing is missing."""
    if scan.name in (SCAN, JOINED) and (scan.parent / CONFIG).is_file():
        return _step_of_run(run_of(scan.parent))
    if not scan.is_file() or not marked_as_being_written(scan):
        return ""
    with suppress(DataError, *hdf5.ALTERED), hdf5.open_hdf5(scan) as file:
        # if another program writes the file, no lock shows whether that program is alive
        if layout.COMMITTED not in file:
            return (
                f"The file is marked as being written, but has not changed for {QUIET:.0f} s or longer. If the "
                f"program that wrote the file has ended, `h5clear -s {scan}` clears the mark."
                if abandoned(scan)
                else f"Another program is still writing the scan file: `beamline recon {scan} --follow` reconstructs "
                "the scan while it runs."
            )
    if held(scan):
        return f"The scan is still running: `beamline recon {scan} --follow` reconstructs the scan while it runs."
    return f"{_died(abandoned(scan))}: `beamline recover {scan}` {_MAKES}."


def _step_of_run(run: Path) -> str:
    parts = parts_of(run)
    scan = next((part / SCAN for part in reversed(parts) if (part / SCAN).is_file()), run / SCAN)
    head, lives = superblock(scan) if scan.is_file() else None, alive(parts[-1])
    growing = head is not None and head.open_for_writing
    if lives or held(run / EVENTS, exclusively=True) or (growing and held(scan)):
        return (
            f"The scan is still running: `beamline watch {run}` shows the scan, and `beamline recon {scan} --follow` "
            "reconstructs the scan while it runs."
        )
    if not files_with_frames(run):
        return "The run ended before its first frame: start the scan again."
    ride, resume = is_ride(run), f"`beamline scan --resume {run}` takes the missing projections"
    if growing:
        resume = "" if ride else f"{resume}, "
        return f"{_died(lives is False or abandoned(scan))}: {resume}`beamline recover {run}` {_MAKES}."
    if head is not None and _lacks_views(run):
        return (
            "The run ended early. The run recorded the scan of another program, so `beamline` cannot continue it."
            if ride
            else f"The run ended early: {resume}."
        )
    record = read_record(parts[-1])
    died = record is not None and record.state == DIED
    return (
        f"The process of the run was killed after the scan file was closed: `beamline recover {run}` marks the run "
        f"as ended."
        if died
        else ""
    )


def is_ride(run: Path) -> bool:
    """True if a run recorded the scan of another program; only that program can continue it."""
    config = run / CONFIG
    return config.is_file() and "\nride:" in config.read_text(encoding="utf-8", errors="replace")


_MAKES = "makes an ordinary file of the complete frames"


def _died(sure: bool) -> str:
    """A sentence on a process that was killed; on a disk without locks, it may still be running."""
    return "The process of the scan was killed" + ("" if sure else ", unless a program is still writing to it")


def _lacks_views(run: Path) -> bool:
    """True if projections, or offset projections, are missing in the files of a run. All files must be closed."""
    with suppress(DataError, *hdf5.ALTERED), ExitStack() as opened:
        files = [opened.enter_context(hdf5.open_hdf5(part)) for part in files_with_frames(run)]
        return bool(still_to_take(files)[0]) or offset_planned(files[0]) > len(offset_taken(files))
    return False


def still_to_take(files: Sequence[h5py.File]) -> tuple[frozenset[int], tuple[str, ...], bool]:
    """The projections that a scan still has to take, from its plan and the decisions after its passes. A file without a
    plan gives no projections.

    Args:
        files: all files of the scan, in the order of acquisition, or the file that joins them.

    Returns:
        Three values. (1) The triggers of these projections, counted from 0. Projections that the scan decided to omit
        are not included; projections of a pass that is being repeated are. (2) The choice after each pass that has
        ended; `Choice.NEXT` if the files do not state it. (3) True if a choice is due, because the last pass has ended
        and neither a choice nor a projection follows.
    """
    views, since_pass_end, chosen, n_ended = set[int](), set[int](), dict[str, str](), 0
    for file in files:
        table = frames_in(file)
        ends, taken = table.pass_ends, table.numbers_taken()
        since_pass_end = {*table.numbers_taken(int(ends[-1]))} if ends.size else since_pass_end | taken
        views, n_ended = views | taken, n_ended + ends.size
        chosen |= {str(values.get("number")): values["choice"] for values in decisions_in(file) if "choice" in values}
    if layout.PASS_ENDS not in files[0]:
        return frozenset(range(views_planned(files[0]) or 0)) - views, (), False
    due = str(n_ended) not in chosen and n_ended > 0 and not since_pass_end
    choices = tuple(chosen.get(str(number), Choice.NEXT) for number in range(1, n_ended + 1 - due))
    passes = _passes_of(files[0], choices)
    missing = triggers_to_take(*passes.done) - views | triggers_to_take(*passes.to_come)
    if choices[-1:] == (Choice.AGAIN,) and not due:
        missing |= triggers_to_take(passes.done[-1]) - since_pass_end
    return missing, choices, due


def n_still_to_take(file: h5py.File) -> int | None:
    """Number of projections that `still_to_take` returns for a file. None if the choices stored in the file are
    damaged.
    """
    with suppress(*hdf5.ALTERED):
        return len(still_to_take([file])[0])
    return None


def offset_taken(files: Sequence[h5py.File]) -> frozenset[int]:
    """Triggers of the offset projections in the files of a scan."""
    return frozenset[int]().union(*(frames_in(file).numbers_taken(kind=FrameKind.OFFSET_VIEW) for file in files))


def _passes_of(file: h5py.File, choices: Iterable[str]) -> Passes:
    """The passes of the plan in a file, after these choices. The configuration in the file states how many projections
    a pass of a step scan has.
    """
    plan, config = plan_in(file), file["/entry/record/config"].asstr()[()]
    angles, stated = np.radians(plan["angles_deg"]), re.search(r"^  pass_views: (\d+)", config, re.MULTILINE)
    steps = np.diff(angles)
    turns = np.flatnonzero(steps * steps[:1] < 0)  # first projections of the next sweeps of a fly scan
    sweep = int(turns[0]) + 1 if turns.size else 0
    pass_views = int(stated[1]) if stated else 0
    size = pass_views * plan.get("frames_per_view", 1) if plan.get("mode") == Mode.STEP else sweep
    return passes_at_start(Block(FrameKind.PROJECTION, Mode.STEP, 0, angles, 0.0, 0.0), size, choices)
