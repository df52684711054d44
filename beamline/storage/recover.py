"""recover: if the process of a scan was killed, replaces the scan file by an ordinary file with all complete frames.

The frames are copied to a new file, which takes the place of the old one once it is on the disk. If the copy is
interrupted for any reason, the old file stays unchanged.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np

from beamline.core.errors import DataError
from beamline.core.files import atomic_file, no_file, refuse_existing, run_of
from beamline.core.text import count, frames_text, size
from beamline.storage import hdf5
from beamline.storage.disk_file import GrowingFile
from beamline.storage.interrupted import n_still_to_take
from beamline.storage.parts import copy_rows, gaps_in, is_whole, require_joined, views_planned
from beamline.storage.recorded_frames import altered_rows
from beamline.storage.structure import require_harmless
from beamline.storage.superblock import Superblock, superblock
from beamline.storage.writer_lock import QUIET, WriterLock, held
from beamline.storage.writers import layout
from beamline.storage.writers.rows import (
    DIED,
    RUNNING,
    ScanEnding,
    ending_in,
    has_exchange_view,
    put_exchange_view,
    state_ending,
)


@dataclass(frozen=True)
class Recovered:
    """Result of `recover` for a file.

    Attributes:
        changed: True if the file was changed.
        frames: number of committed frames; all of them are kept.
        dropped: number of frames at the end that were not committed when the process was killed. They are removed.
        missing: number of projections that were planned or chosen but not taken; None if the file does not contain its
            plan, and for a later part of a run.
        lost: rows of the frames that were committed but did not reach the disk, and of all frames after them. They are
            removed.
        damaged: rows of the frames whose pixels differ from their checksum. They are kept.
        altered: rows of the frames whose row in the log differs from its checksum. They are kept.
        remark: a step that failed although the frames are complete; "" if no step failed.
    """

    path: Path
    changed: bool
    frames: int
    dropped: int
    missing: int | None
    lost: tuple[int, ...] = ()
    damaged: tuple[int, ...] = ()
    altered: tuple[int, ...] = ()
    remark: str = ""

    def in_words(self) -> str:
        """The result as one line of text."""
        wrong = (
            f"; records differ from the checksum stored with them: {frames_text(self.altered)}" if self.altered else ""
        )
        if not self.changed:
            order = "cannot be repaired" if wrong else "is intact"
            sentence = f"{self.path} {order}, with {count(self.frames, 'frame')}{wrong}. Nothing was changed."
        else:
            dropped_text = f", {count(self.dropped, 'incomplete frame')} left out" if self.dropped else ""
            lost = f"; written by the scan but lost on the disk: {frames_text(self.lost)}" if self.lost else ""
            damaged = (
                f"; pixels differ from the checksum stored with them: {frames_text(self.damaged)}"
                if self.damaged
                else ""
            )
            views = f"; {count(self.missing, 'planned projection')} not taken" if self.missing else ""
            sentence = (
                f"{self.path}: {count(self.frames, 'frame')} recovered{dropped_text}{lost}{damaged}{wrong}{views}."
            )
        return f"{sentence} {self.remark}".strip()


def recover(path: Path, say: Callable[[str], None] = lambda _: None) -> Recovered:
    """Replace a scan file whose process was killed, or that was cut off, by a closed file with the committed frames. If
    a closed file has no /exchange view, add it.

    Args:
        say: function that gets a sentence about the disk space that the copy needs.

    Raises:
        DataError: the file is not a scan of this program, it is damaged, or a running program has it open. On a file
            system without locks, the error is also raised if the file changed within the last 10 s. It is also raised
            if the disk failed during the copy. In all cases the file is unchanged.
    """
    if not path.is_file():
        raise DataError(f"{no_file(path)} Nothing was changed.")
    if in_use := held(path):
        raise DataError(
            f"{path} is open in a program that is still running: a scan that waits or pauses, or a reader. End that "
            "program first. Nothing was changed."
        )
    lock = None
    with suppress(OSError):  # a file without write permission may be complete
        lock = WriterLock(path, exclusive=True)
    try:
        head = superblock(path)
        if head is None:
            raise DataError(f"{path} is not an HDF5 file written by this program. Nothing was changed.")
        if not head.open_for_writing and head.end == head.size:
            with suppress(*hdf5.ALTERED):  # its writer may have been killed while it added the view
                return _with_view(path, head)
        if in_use is None and head.open_for_writing and (age := abs(time.time() - path.stat().st_mtime)) < QUIET:
            raise DataError(
                f"{path} changed {age:.0f} s ago and is marked as being written, and the disk has no file locks. If "
                f"the program that wrote it was killed, try again in {QUIET:.0f} s. Nothing was changed."
            )
        free = size(shutil.disk_usage(path.parent).free)
        say(
            f"Free some space on the disk of {path}: its frames are copied, which needs up to "
            f"{size(head.size)}, and {free} are free."
        )
        with atomic_file(path, replace=True) as partial:
            done = _copied(path, head, partial)
            if done.lost or done.damaged:
                done = replace(done, remark=_kept_aside(path))
            if lock is not None:
                lock.release()  # Windows cannot replace an open file
        return done
    finally:
        if lock is not None:
            lock.release()


def require_ours(path: Path, file: h5py.File) -> None:
    """Raise DataError for a file of another program."""
    if layout.COMMITTED not in file:
        raise DataError(f"{path} is not a scan of this program: it has no {layout.COMMITTED}. Nothing was changed.")


def _with_view(path: Path, head: Superblock) -> Recovered:
    """The result for a closed file. The /exchange view is added if the file does not have it."""
    with closing(GrowingFile(path, head)) as disk, h5py.File(disk, "r") as file:
        require_ours(path, file)
        require_joined(file)
        frames, complete = int(file[layout.COMMITTED][()]), has_exchange_view(file)
        altered = tuple(altered_rows(file, frames).tolist())
    if not complete:
        put_exchange_view(path)
    return Recovered(path, not complete, frames, 0, None, altered=altered)


def _copied(path: Path, head: Superblock, target: Path) -> Recovered:
    """Copy the readable frames to a new file. Returns the facts about these frames."""
    try:
        with closing(GrowingFile(path, head)) as disk, h5py.File(disk, "r") as file:
            require_harmless(file)
            require_ours(path, file)
            committed, frames = int(file[layout.COMMITTED][()]), _frames_there(file)
            if frames == 0 < committed:
                raise ValueError(f"all of its {committed} complete frames are damaged")
            ending, lost = ending_in(file), tuple(range(frames, committed))
            with hdf5.created(target, layout.LIBVER) as copy:
                damaged = copy_rows(file, frames, copy)
                if ending.status == RUNNING:
                    ending = ScanEnding("failed", gaps_in(path, copy), DIED)
                if lost:
                    reason = (
                        f"{ending.reason} Lost frames, which the scan wrote but which did not reach the disk: "
                        f"{frames_text(lost)}."
                    )
                    ending = replace(ending, status="failed", reason=reason.strip())
                state_ending(copy, ending)
                times = copy[layout.TIME][()]
                if layout.END_TIME in copy and not copy[layout.END_TIME][()] and np.isfinite(times).any():
                    copy[layout.END_TIME][()] = layout.iso_time(float(np.nanmax(times))).encode()
                planned, dropped = views_planned(copy), max(0, len(file[layout.DATA]) - committed)
                alone = planned is not None and run_of(path.resolve().parent) == path.resolve().parent
                missing = n_still_to_take(copy) if alone else None
                altered = tuple(altered_rows(copy, frames).tolist())
    except hdf5.ALTERED as error:
        if isinstance(error, OSError) and error.filename == str(target):
            raise
        raise DataError(
            f"{path} is damaged, or the program that wrote it was killed before the first frame "
            f"({hdf5.reason(error)}). Nothing was changed."
        ) from error
    return Recovered(path, True, frames, dropped, missing, lost, damaged, altered)


def _kept_aside(path: Path) -> str:
    """A sentence about the second name that a damaged file keeps, because some of its frames are lost."""
    kept = path.with_name(f"{path.name}.damaged")
    try:
        # also true after a recovery that was killed before its last step
        if not (kept.exists() and kept.samefile(path)):
            refuse_existing(kept)
            kept.hardlink_to(path)
    except OSError:  # a disk without hard links
        shutil.copy2(path, kept)
    return f"The damaged file was renamed to {kept}."


def _frames_there(file: h5py.File) -> int:
    """Number of frames up to the last committed frame whose row and pixels match their checksums."""
    n = min(int(file[layout.COMMITTED][()]), len(file[layout.DATA]), len(file[layout.PREVIEW]))
    for path in layout.growing(file):
        n = _most_rows(file[path], n)
    good = np.setdiff1d(np.arange(n), altered_rows(file, n))[::-1].tolist()
    return next((row + 1 for row in good if is_whole(file, row)), 0)


def _most_rows(column: h5py.Dataset, largest: int) -> int:
    """Number of rows, counted from the first row, that can be read; at most `largest`. Found by bisection: if the first
    n rows can be read, the first n - 1 can be read, too.
    """
    smallest, largest = 0, min(largest, len(column))
    while smallest < largest:
        half = (smallest + largest + 1) // 2
        try:
            column[:half]
            smallest = half
        except hdf5.ALTERED:
            largest = half - 1
    return smallest
