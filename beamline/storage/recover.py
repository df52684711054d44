"""recover: an ordinary scan file of one whose writer died, in its place; every frame that was committed is kept."""

from __future__ import annotations

import os
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import h5py

from beamline.core.errors import DataError
from beamline.core.text import count
from beamline.storage import hdf5
from beamline.storage.parts import views_in, views_planned
from beamline.storage.structure import require_harmless
from beamline.storage.superblock import SIZE, Superblock, superblock
from beamline.storage.writer_lock import held
from beamline.storage.writers import layout
from beamline.storage.writers.exchange_view import add_exchange_view

QUIET = 10.0  # s without a change, after which no program is taken to write the file, where locks do not say it


@dataclass(frozen=True)
class Recovered:
    """What became of a file.

    Attributes:
        changed: it was not in order before.
        frames: committed, and kept.
        dropped: frames at the end that were not committed when the writer died, and are cut off.
        missing: views that were planned and not taken; None where the file does not hold its plan.
    """

    path: Path
    changed: bool
    frames: int
    dropped: int
    missing: int | None

    def said(self) -> str:
        """One line for people."""
        if not self.changed:
            return f"{self.path} is in order, with {count(self.frames, 'frame')}; nothing was changed."
        gone = f", {count(self.dropped, 'frame')} not committed, left out" if self.dropped else ""
        views = f"; {count(self.missing, 'view')} of the plan not taken" if self.missing else ""
        return f"{self.path}: {count(self.frames, 'frame')} recovered{gone}{views}."


def recover(path: Path) -> Recovered:
    """Clear the mark of the dead writer, cut what was not committed, and add what a writer adds at the end.

    Only the 48 bytes of the head are written before the file was read; where it cannot be read, they are put back.

    Raises:
        DataError: no scan of ours, a file that is cut off or damaged, one that a running program has open, or one that
            changed within 10 s: then nothing is changed.
    """
    head = _checked(path)
    if not head.open_for_writing:
        with hdf5.open_hdf5(path) as file, hdf5.readable(path):
            _require_ours(path, file)
            if file[layout.FINISHED][()] and "exchange" in file:
                return Recovered(path, False, int(file[layout.COMMITTED][()]), 0, None)
    _write_head(path, head.closed())
    try:
        with h5py.File(path, "r") as file:
            require_harmless(file)
            _require_ours(path, file)
            for name in layout.GROWING:
                file[name][:]
            hdf5.text(file[layout.STATUS][()]), len(file[layout.DATA]), _views_missing(file)  # it must be able to end
    except (*hdf5.ALTERED, DataError) as error:
        _write_head(path, head)
        if isinstance(error, DataError):
            raise
        raise DataError(
            f"{path} is damaged, or its writer died before the first frame ({hdf5.reason(error)}). Nothing was changed."
        ) from error
    with h5py.File(path, "r+", libver=layout.LIBVER) as file:
        return _finished(path, file)


def _checked(path: Path) -> Superblock:
    head = superblock(path) if path.is_file() else None
    if head is None or not head.intact:
        raise DataError(f"{path} is not there, or no HDF5 file that this program wrote. Nothing was changed.")
    if head.missing:
        raise DataError(
            f"{path} is cut off: {head.missing} bytes are missing at its end, as its head says. Nothing was changed."
        )
    if held(path):
        raise DataError(
            f"{path} is open in a program that still runs: a scan that waits or pauses, or a reader. Let it end first. "
            "Nothing was changed."
        )
    if head.open_for_writing and abs(age := _now_beside(path) - path.stat().st_mtime) < QUIET:
        raise DataError(
            f"{path} changed {max(age, 0):.0f} s ago and is marked as being written. If its writer is dead, try again "
            f"in {QUIET:.0f} s. Nothing was changed."
        )
    return head


def _now_beside(path: Path) -> float:
    """The time of the disk's own clock, which that of a network may have: it has dated the file."""
    with suppress(OSError), tempfile.TemporaryFile(dir=path.parent) as file:
        return os.fstat(file.fileno()).st_mtime
    return time.time()


def _require_ours(path: Path, file: h5py.File) -> None:
    if layout.COMMITTED not in file:
        raise DataError(f"{path} is no scan of this program: it has no {layout.COMMITTED}. Nothing was changed.")


def _finished(path: Path, file: h5py.File) -> Recovered:
    frames, written = int(file[layout.COMMITTED][()]), len(file[layout.DATA])
    for name in (layout.DATA, layout.PREVIEW, *layout.GROWING):
        if len(file[name]) != frames:
            file[name].resize(frames, 0)
    if not file[layout.FINISHED][()]:
        if hdf5.text(file[layout.STATUS][()]) == "running":
            file[layout.STATUS][()] = b"failed"
        file[layout.FINISHED][()] = 1
    for name in ("exchange", "implements"):  # where the writer died in these
        with suppress(KeyError):
            del file[name]
    layout.settle(file)
    add_exchange_view(file)
    return Recovered(path, True, frames, max(0, written - frames), _views_missing(file))


def _views_missing(file: h5py.File) -> int | None:
    planned = views_planned(file)
    return None if planned is None else planned - len(views_in(file))


def _write_head(path: Path, head: Superblock) -> None:
    with path.open("r+b") as file:
        file.write(head.head[:SIZE])
