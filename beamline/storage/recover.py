"""recover: turns the file of a writer that died into an ordinary scan file, in place, with every committed frame.

HDF5 mends the file in memory, and the result is read. Only then the few bytes that differ are written (see
storage.overlay). Whatever stops it, it can be run again. So a file of 30 GB needs a few kB of its disk and no copy.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np

from beamline.core.errors import DataError
from beamline.core.files import no_file, refuse_existing, same_file, whole_file
from beamline.core.text import count, size, spans
from beamline.monitor.digest import has_checksum
from beamline.storage import datasets, hdf5
from beamline.storage.overlay import Overlay, PartlyChangedError
from beamline.storage.parts import copy_rows, gaps_in, require_joined, views_in, views_planned
from beamline.storage.structure import require_harmless
from beamline.storage.superblock import Superblock, superblock
from beamline.storage.writer_lock import QUIET, WriterLock, held
from beamline.storage.writers import layout
from beamline.storage.writers.rows import (
    DIED,
    RUNNING,
    ScanEnding,
    altered_rows,
    ending_in,
    has_exchange_view,
    state_ending,
    state_words,
    with_exchange_view,
)

COMPARED = 2**31  # bytes of the last frames: more than a machine that loses power has not brought to the disk yet


@dataclass(frozen=True)
class Recovered:
    """Result of `recover` for a file.

    Attributes:
        changed: whether the file was changed.
        frames: committed, and kept; None: a file of another program, whose mark alone was cleared.
        dropped: frames at the end that were not committed when the writer died, and are cut off.
        missing: views that were planned and not taken; None where the file does not hold its plan.
        lost: frames that were committed and are not on the disk; they are cut off, with all after them.
        damaged: frames, of the last 2 GB, that differ from their checksum; they are kept.
        altered: frames whose row in the log differs from its checksum; likewise kept.
        remark: a step that failed although the frames are in order; "" if none failed.
    """

    path: Path
    changed: bool
    frames: int | None
    dropped: int
    missing: int | None
    lost: tuple[int, ...] = ()
    damaged: tuple[int, ...] = ()
    altered: tuple[int, ...] = ()
    remark: str = ""

    def in_words(self) -> str:
        """The result as one line of text."""
        if self.frames is None:
            return f"{self.path}: the mark of its writer is cleared, and what it had written can be read."
        wrong = f"; what it says of frames {spans(self.altered)} is not as it was written" if self.altered else ""
        if not self.changed:
            order = "cannot be mended" if wrong else "is in order"
            sentence = f"{self.path} {order}, with {count(self.frames, 'frame')}{wrong}; nothing was changed."
        else:
            gone = f", {count(self.dropped, 'frame')} not committed, left out" if self.dropped else ""
            lost = f"; frames {spans(self.lost)} were committed and are not on the disk" if self.lost else ""
            damaged = f"; frames {spans(self.damaged)} differ from their checksum" if self.damaged else ""
            views = f"; {count(self.missing, 'view')} of the plan not taken" if self.missing else ""
            sentence = f"{self.path}: {count(self.frames, 'frame')} recovered{gone}{lost}{damaged}{wrong}{views}."
        return f"{sentence} {self.remark}".strip()


def recover(path: Path, say: Callable[[str], None] = lambda _: None) -> Recovered:
    """Clear the mark of the dead writer, truncate uncommitted data, and add what a writer adds at the end.

    Of another program's file the mark is cleared alone, where all that it holds can be read.

    Args:
        say: is told what is waited for, and the room needed before anything is written.

    Raises:
        DataError: no HDF5 file, a damaged one, one that a running program has open, or that changed within 10 s: then
            nothing is changed. Or a disk that does not take it: then it can be run again.
    """
    if not path.is_file():
        raise DataError(f"{no_file(path)} Nothing was changed.")
    if held(path):
        raise DataError(
            f"{path} is open in a program that still runs: a scan that waits or pauses, or a reader. Let it end first. "
            "Nothing was changed."
        )
    lock = None
    with suppress(OSError):  # a file that nobody can write to may be in order
        lock = WriterLock(path, exclusive=True)
    try:
        head = _checked(path, say)
        if head.open_for_writing and (cleared := _of_others(path, head)) is not None:
            cleared.carry_out()
            return Recovered(path, True, None, 0, None)
        if not (head.open_for_writing or head.missing) and (done := _as_it_is(path)) is not None:
            return _with_view(done, Overlay(path), say)
        try:
            mended = _mended(path, head)
        except DataError as error:
            return _rescued(path, head, error, say)
        return _with_view(*mended, say)
    finally:
        if lock is not None:
            lock.release()


def _checked(path: Path, say: Callable[[str], None]) -> Superblock:
    head = superblock(path)
    if head is None or not head.intact:
        raise DataError(f"{path} is not an HDF5 file written by this program. Nothing was changed.")
    changed = path.stat().st_mtime
    if head.open_for_writing and not head.grows and 0 <= (age := _now_beside(path) - changed) < QUIET:
        say(f"{path} changed {age:.0f} s ago: whether it still changes is known in {QUIET - age:.0f} s.")
        time.sleep(QUIET - age)
    if head.open_for_writing and abs(age := _now_beside(path) - path.stat().st_mtime) < QUIET:
        raise DataError(
            f"{path} changed {max(age, 0):.0f} s ago and is marked as being written. If its writer is dead, try again "
            f"in {QUIET:.0f} s. Nothing was changed."
        )
    return head


def _of_others(path: Path, head: Superblock) -> Overlay | None:
    """The file of another program without the mark of its writer; None for a file of ours, or one that is damaged.

    DataError: something in it cannot be read, or it may be growing.
    """
    overlay = Overlay(path, max(head.end, head.size))
    overlay.put(0, head.closed(max(head.end, head.size)).head)
    with suppress(*hdf5.ALTERED), h5py.File(overlay, "r") as file:
        require_harmless(file)
        if layout.COMMITTED in file:
            return None
        if head.grows:
            raise DataError(
                f"{path} is of another program and can be read as it is. `h5clear -s {path}` clears its mark, once its "
                "writer has surely ended. Nothing was changed."
            )
        torn = [
            item.name for item in _datasets_in(file) if item.shape and len(item) and not _reads(item, len(item) - 1)
        ]
        if torn:
            raise DataError(f"{path} is damaged: the end of {torn[0]} cannot be read. Nothing was changed.")
        return overlay
    return None


def _as_it_is(path: Path) -> Recovered | None:
    """A file that is in order; None where its end is missing."""
    with hdf5.readable(path), h5py.File(Overlay(path), "r") as file:
        require_ours(path, file)
        if not file[layout.FINISHED][()]:
            return None
        require_joined(file)
        frames = int(file[layout.COMMITTED][()])
        return Recovered(path, False, frames, 0, None, altered=_altered(file, frames))


def _with_view(done: Recovered, mended: Overlay, say: Callable[[str], None]) -> Recovered:
    """Carry it out with the /exchange view; without it where the disk takes only that."""
    with hdf5.readable(done.path), h5py.File(mended, "r") as file:
        complete = has_exchange_view(file)
    try:
        whole = mended if complete else with_exchange_view(mended)
        if whole.changed:
            free = size(shutil.disk_usage(done.path.parent).free)
            say(f"{done.path}: to recover it takes {size(whole.room)} on its disk, {free} are free.")
        whole.carry_out()
    except PartlyChangedError:
        raise
    except DataError as error:
        if complete:
            raise
        mended.carry_out()
        return replace(done, remark=f"It has no /exchange view: {error}")
    return done if complete else replace(done, changed=True)


def _now_beside(path: Path) -> float:
    """The time of the disk's own clock, which that of a network may have: it has dated the file."""
    with suppress(OSError), tempfile.TemporaryFile(dir=path.parent) as file:
        return os.fstat(file.fileno()).st_mtime
    return time.time()


def require_ours(path: Path, file: h5py.File) -> None:
    """Raise DataError for a file of another program."""
    if layout.COMMITTED not in file:
        raise DataError(f"{path} is not a scan of this program: it has no {layout.COMMITTED}. Nothing was changed.")


def _mended(path: Path, head: Superblock) -> tuple[Recovered, Overlay]:
    """The recovered file, and the writes that make it."""
    end = max(head.end, head.size) if head.open_for_writing else head.end
    overlay = Overlay(path, end)
    overlay.put(0, head.closed(end).head)
    try:
        with h5py.File(overlay, "r") as file:
            require_harmless(file)
            require_ours(path, file)
            _read(file)
        with h5py.File(overlay, "r+", libver=layout.LIBVER) as file:
            committed, written = int(file[layout.COMMITTED][()]), len(file[layout.DATA])
            frames = _cut(path, file, committed, head)
        # Where bytes are missing, all that is left lies before, or the next lines would not read it. Elsewhere HDF5
        # must add nothing before the end, in the room of rows that were cut off.
        made = overlay.head
        if made.end < head.size or head.missing or frames < committed:
            overlay.put(0, made.closed(head.size).head)
            overlay.truncate(head.size)
        with h5py.File(overlay, "r") as file:
            _read(file)
            lost, dropped = tuple(range(frames, committed)), max(0, written - committed)
            done = Recovered(
                path, True, frames, dropped, _views_missing(file), lost, _damaged(file), _altered(file, frames)
            )
    except hdf5.ALTERED as error:
        raise DataError(
            f"{path} is damaged, or its writer died before the first frame ({hdf5.reason(error)}). Nothing was changed."
        ) from error
    return done, overlay


def _rescued(path: Path, head: Superblock, damage: DataError, say: Callable[[str], None]) -> Recovered:
    """Write the frames that can be read into a new file in its place, which a loss of power may leave as the only way.

    Some writes of the last second or two are on the disk then and others are not, and HDF5 cannot end such a file. The
    blocks that lead to earlier frames are there. The old file stays beside the new one.

    Raises:
        DataError: `damage`, where no frame can be read; or the disk does not take the new file. Nothing is changed.
    """
    overlay = Overlay(path, max(head.end, head.size))
    new, kept = path.with_name(f"{path.name}.recovered"), path.with_name(f"{path.name}.damaged")
    overlay.put(0, head.closed(max(head.end, head.size)).head)
    try:
        with h5py.File(overlay, "r") as file:
            require_harmless(file)
            require_ours(path, file)
            committed, frames = int(file[layout.COMMITTED][()]), _rows_readable(file)
            if not frames:
                raise damage
            say(
                f"{path} cannot be mended in place: its frames are copied to a new file of about {size(head.size)}; "
                f"the damaged file is kept as {kept.name}."
            )
            if kept.exists() and same_file(kept.stat(), path.stat()):
                kept.unlink()  # a recovery died between its last two steps
            refuse_existing(kept)
            with whole_file(new, replace=True) as partial, hdf5.created(partial, layout.LIBVER) as made:
                copy_rows(file, frames, made)
                lost = tuple(range(frames, committed))
                reason = f"{DIED} Its last frames are not whole on the disk, from frame {frames} on."
                state_ending(made, ScanEnding("failed", gaps_in(path, made), reason))
                missing, damaged, altered = _views_missing(made), _damaged(made), _altered(made, frames)
    except hdf5.ALTERED as error:
        raise damage from error
    overlay.close()  # Windows renames no open file
    _take_place(new, path, kept)
    return Recovered(path, True, frames, 0, missing, lost, damaged, altered, f"The damaged file is {kept} now.")


def _take_place(new: Path, path: Path, kept: Path) -> None:
    """`new` becomes `path`, and what `path` was `kept`; at once where the disk has links. OSError: nothing changed."""
    try:
        os.link(path, kept)
    except OSError:
        path.rename(kept)
    try:
        new.replace(path)
    except OSError:
        kept.replace(path)
        raise


def _rows_readable(file: h5py.File) -> int:
    """Number of rows from the first on whose columns and pixels can be read, up to the last that is as written."""
    n = int(file[layout.COMMITTED][()])
    for path in layout.growing(file):
        n = _most_rows(file[path], n)
    images = file[layout.DATA], file[layout.PREVIEW]
    n = min(n, *map(len, images))
    n = next((row for row in range(n) if not all(_reads(item, row) for item in images)), n)
    good = np.setdiff1d(np.arange(n), altered_rows(file, 0, n))
    return int(good[-1]) + 1 if good.size else 0


def _most_rows(column: h5py.Dataset, most: int) -> int:
    """Number of rows from the first on that can be read, `most` at most: those of a readable part can be, too."""
    least, most = 0, min(most, len(column))
    while least < most:
        half = (least + most + 1) // 2
        least, most = (half, most) if _reads(column, slice(half)) else (least, half - 1)
    return least


def _reads(item: h5py.Dataset, rows: slice | int) -> bool:
    try:
        item[rows]
    except hdf5.ALTERED:
        return False
    return True


def _read(file: h5py.File) -> None:
    """Read all of the file except its pixels, so that HDF5's errors come now."""
    for item in _datasets_in(file):
        if item.name not in (layout.DATA, layout.PREVIEW):
            item[()]


def _datasets_in(file: h5py.File) -> Iterator[h5py.Dataset]:
    """Each dataset with values of its own; the attributes of all objects are read meanwhile."""
    names: list[str] = []
    file.visit(names.append)
    for item in (file[name] for name in names):
        dict(item.attrs)
        if isinstance(item, h5py.Dataset) and not item.is_virtual:
            yield item


def _cut(path: Path, file: h5py.File, committed: int, head: Superblock) -> int:
    """End the file as a writer does, with the frames that are committed and on the disk; how many these are."""
    growing = (layout.DATA, layout.PREVIEW, *layout.growing(file))
    frames = min(committed, *(_rows_within(file[name], head.size) for name in growing))
    file[layout.COMMITTED][()] = frames
    ending = ending_in(file)
    if ending.status == RUNNING or ending.reason == DIED:  # which a recovery that was stopped may have stated in part
        ending = ScanEnding("failed", gaps_in(path, file), DIED)
    if frames < committed:
        lost = f"Frames {spans(range(frames, committed))} were written and are not on the disk."
        ending = replace(ending, status="failed", reason=f"{ending.reason} {lost}".strip())
    if head.missing or frames < committed:  # a list of triggers would take room beyond what is there
        state_words(file, ending)
    elif ending != ending_in(file):
        state_ending(file, ending)
    for name in growing:  # after what takes room, which HDF5 would put where these were
        if len(file[name]) != frames:
            file[name].resize(frames, 0)
    times = file[layout.TIME][()]
    if layout.END_TIME in file and not file[layout.END_TIME][()] and np.isfinite(times).any():
        file[layout.END_TIME][()] = layout.iso_time(float(np.nanmax(times))).encode()
    if layout.FIELD_OF_VIEW in file:
        layout.state_field_of_view(file)
    file[layout.FINISHED][()] = 1
    return frames


def _rows_within(item: h5py.Dataset, there: int) -> int:
    """Number of rows that lie wholly within the first so many bytes of the file."""
    if item.chunks is None:
        return len(item)
    chunks = set[int]()

    def note(chunk: h5py.h5d.StoreInfo) -> None:
        if chunk.byte_offset + chunk.size <= there:
            chunks.add(chunk.chunk_offset[0] // item.chunks[0])

    item.id.chunk_iter(note)
    n = next(i for i in range(len(chunks) + 1) if i not in chunks)
    return min(len(item), n * int(item.chunks[0]))


def _damaged(file: h5py.File) -> tuple[int, ...]:
    """The last frames that differ from their checksum."""
    data, checksums = file[layout.DATA], file["/entry/digest/checksum"][()]
    first = max(0, len(data) - COMPARED // max(1, data.id.get_storage_size() // max(1, len(data))))
    image, damaged = np.empty((1, *data.shape[1:]), data.dtype), []
    for row in range(first, len(data)):
        try:
            datasets.read_frames(data, np.array([row]), slice(None), image)
            whole = has_checksum(image[0], int(checksums[row]))
        except DataError:
            whole = False
        if not whole:
            damaged.append(row)
    return tuple(damaged)


def _altered(file: h5py.File, frames: int) -> tuple[int, ...]:
    return tuple(altered_rows(file, 0, frames).tolist())


def _views_missing(file: h5py.File) -> int | None:
    planned = views_planned(file)
    return None if planned is None else planned - len(views_in(file))
