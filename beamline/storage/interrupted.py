"""Interrupted runs: the scan and the volume of a run, and the next step for one that ended early.

Every command that meets such a run says the same, by `next_step`.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from beamline.core.errors import DataError
from beamline.core.files import CONFIG, EVENTS, JOINED, RECON, SCAN, parts_of, run_of
from beamline.storage import hdf5
from beamline.storage.parts import files_with_frames, joined_file_of, to_join, views_in, views_planned
from beamline.storage.run_record import DIED, alive, read_record
from beamline.storage.superblock import superblock
from beamline.storage.writer_lock import abandoned, held


def scan_file(path: str | Path) -> Path:
    """The scan file at a path: the file itself, or for the folder of a run the file with all its parts.

    Raises:
        DataError: a run without a scan file, one whose parts are not joined, or a folder of runs.
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
        raise DataError(f"{path} has {len(parts)} parts that are not joined. {step}")
    return path / SCAN


def whole_scan(path: Path) -> Path:
    """The scan file that a path stands for, with links resolved. A run's folder, or any part of a resumed run, stands
    for the file that joins all parts.

    A path at which there is no scan is returned as it is: opening it raises the error that says why.
    """
    with suppress(DataError, RuntimeError):  # RuntimeError: links in a circle
        joined = None if path.is_dir() else joined_file_of(path)
        path = scan_file(path) if joined is None else joined[0]
    return Path(os.path.realpath(path))


def volume_file(path: Path) -> Path:
    """The volume file at a path: the file or folder itself, or for the folder of a run its recon.h5.

    Raises:
        DataError: a run without a volume, or a folder of runs.
    """
    if (path / RECON).is_file():
        return path / RECON
    if not (path / SCAN).is_file():
        return _no_run(path, RECON) if path.is_dir() else path
    scan = scan_file(path)
    make = f"`beamline recon {scan} -o {path / RECON}` makes one."
    raise DataError(f"{path} has no volume ({RECON}). {next_step(parts_of(path)[-1] / SCAN) or make}")


def _no_run(folder: Path, wanted: str) -> Path:
    """The folder, which may be of another kind, such as of slices. DataError: it is of a run, or of runs."""
    if (folder / EVENTS).is_file():
        raise DataError(f"{folder} is the folder of a run without a {wanted}: it ended before its first frame.")
    if runs := sorted(log.parent for log in folder.glob(f"*/{EVENTS}")):
        raise DataError(f"{folder} is a folder of runs: name one of them, such as {runs[-1]}.")
    return folder


def next_step(scan: Path) -> str:
    """A sentence on the next step for a scan that is running, died or ended early; "" if nothing is missing."""
    run = run_of(scan.parent) if scan.name in (SCAN, JOINED) and (scan.parent / CONFIG).is_file() else None
    if run is not None:
        parts = [part / SCAN for part in parts_of(run) if (part / SCAN).is_file()]
        scan = parts[-1] if parts else scan
    head = superblock(scan) if scan.is_file() else None
    resume = f"`beamline scan --resume {run}` takes what is missing"
    growing = head is not None and head.open_for_writing
    lives = None if run is None else alive(parts_of(run)[-1])
    if lives or (run is not None and held(run / EVENTS, exclusively=True)) or (growing and held(scan)):
        watch = "" if run is None else f"`beamline watch {run}` shows it, "
        return f"Its scan still runs: {watch}`beamline recon {scan} --follow` reconstructs it meanwhile."
    if run is not None and not files_with_frames(run):
        return "It ended before its first frame: start the scan anew."
    if not growing:
        if run is not None and head is not None and _lacks_views(run):
            return f"It ended early: {resume}."
        record = None if run is None else read_record(parts_of(run)[-1])
        died = f"Its process died after its scan file was closed: `beamline recover {run}` ends the run."
        return died if record is not None and record.state == DIED else ""
    sure = lives is False or abandoned(scan)  # where the disk has no locks, its program may run
    died = "Its scan has died" + ("" if sure else ", unless a program still writes to it")
    what = scan if run is None else run
    recover = f"`beamline recover {what}` makes an ordinary file of the frames that are there"
    return f"{died}: {recover if run is None else f'{resume}, {recover}'}."


def _lacks_views(run: Path) -> bool:
    """Whether the files of a run, all closed, lack views of its plan."""
    planned, views = 0, set[int]()
    try:
        for part in files_with_frames(run):
            with hdf5.open_hdf5(part) as file, hdf5.readable(part):
                planned = views_planned(file) or 0
                views |= views_in(file)
    except (DataError, *hdf5.ALTERED):
        return False
    return len(views) < planned
