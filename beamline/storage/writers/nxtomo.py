"""NXtomoWriter: writes the file of a scan so that the file is valid after every frame.

The file is written SWMR (single writer, multiple readers). Other programs can read flushed frames at once, and flushed
frames survive if this process is killed. Every second an fsync brings them to the disk, where they also survive a loss
of power. `frames_committed` is increased last, so that it never counts an incomplete row.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Self

import h5py
import numpy as np

from beamline.core.errors import DataError, user_message
from beamline.core.events import json_of
from beamline.core.text import size
from beamline.monitor.check import Flag
from beamline.monitor.checks import bitmask
from beamline.monitor.digest import FrameDigest, preview_shape
from beamline.storage import hdf5
from beamline.storage.disk_file import ToDisk
from beamline.storage.flag_legend import mark_of, place_of
from beamline.storage.writer_lock import LockFailure, WriterLock, lock_failure, no_locks_sentence
from beamline.storage.writers import layout
from beamline.storage.writers.layout import ScanInfo
from beamline.storage.writers.rows import (
    STATUSES,
    Rows,
    ScanEnding,
    put_exchange_view,
    state_ending,
    state_words,
)
from drivers.base.clock import Clock
from drivers.base.frame import Frame
from drivers.base.protocols import BeamReading

__all__ = ["NXtomoWriter", "ScanInfo"]

LAST = (
    layout.STATUS, layout.FINISHED, layout.END_TIME, layout.FIELD_OF_VIEW, layout.MISSING, layout.REASON,
    layout.BEAM_TIME, layout.BEAM_VALUE, layout.PASS_ENDS, layout.DECISIONS,
)  # fmt: skip
"""Datasets that are written at the end of a scan, or of a pass."""
FAILURES = (OSError, RuntimeError, ValueError)  # the classes of errors to which h5py converts errors of HDF5


class _TouchedError(OSError):
    """Another program truncated or deleted the file while it was being written."""


def _new_file(path: Path) -> h5py.File:
    """Create a new file. Raises DataError if the file exists or HDF5 cannot create it. An incomplete file is
    deleted.
    """
    try:
        return h5py.File(path, "x", libver=layout.LIBVER)
    except FileExistsError as error:
        raise DataError(
            f"{path} exists, and a scan never overwrites a file. Give another name. Nothing was written."
        ) from error
    except OSError as error:
        with suppress(OSError):  # HDF5 created it and then failed; a file that existed before raises FileExistsError
            path.unlink()
        if lock_failure(error) is LockFailure.NO_LOCKS:
            why = no_locks_sentence(path.parent, error.errno)
            raise DataError(f"{path} cannot be created: {why}. Nothing of it was left on the disk.") from error
        why = hdf5.reason(error)
        raise DataError(f"{path} cannot be created ({why}). Check that its folder exists and is writable.") from error


class NXtomoWriter:
    """Writes uint16 frames row by row; never overwrites a file.

    Each append writes the pixels, the digest and the record of a frame before `frames_committed` counts the frame.
    Attribute `remarks`: one sentence for each step that failed in close() although the data are safe.
    """

    def __init__(
        self,
        path: Path | str,
        info: ScanInfo,
        frame_shape: tuple[int, int],
        *,
        clock: Clock,
        preview_bin: int = 4,
        flush_every: int = 1,
    ) -> None:
        """Create the file. Other programs can then follow it.

        Args:
            preview_bin: binning factor of the previews in the digests.
            flush_every: number of frames between flushes. A crash loses at most the frames since the last flush.

        DataError if the file exists or cannot be made.
        """
        if flush_every < 1:
            raise ValueError(f"flush_every is {flush_every}; it must be at least 1.")
        self.path = Path(path)
        self.remarks: list[str] = []
        self._clock, self._flush_every = clock, flush_every
        self._shape = (int(frame_shape[0]), int(frame_shape[1]))
        self._preview_shape = preview_shape(self._shape, preview_bin)
        self._rows = self._committed = 0
        self._open, self._broken = True, False
        self._file = _new_file(self.path)
        try:
            layout.create(
                self._file,
                info,
                self._shape,
                np.dtype("<u2"),
                quantity="counts",
                preview_bin=preview_bin,
                start=clock.now(),
            )
            self._file.swmr_mode = True  # from now on no object may be created: Rows can only extend existing datasets
            self._lock = WriterLock(self.path)
        except BaseException as error:  # an empty file is of no use
            with suppress(*FAILURES):
                self._file.close()
            self.path.unlink()
            if isinstance(error, OSError | RuntimeError):
                raise DataError(
                    f"{self.path} cannot be created ({hdf5.reason(error)}). Nothing of it was left on the disk."
                ) from error
            raise
        self._table = Rows(self._file)
        self._handle: int = self._file.id.get_vfd_handle()
        self._to_disk, self._before = ToDisk(self._handle), os.fstat(self._handle)
        self._progress = self._file[layout.COMMITTED]
        # Kept open until the end: if the disk fails, closing a dataset would write to it again.
        self._last: dict[str, h5py.Dataset] = {path: self._file[path] for path in LAST if path in self._file}

    def append(self, frame: Frame, digest: FrameDigest, flags: Sequence[Flag] = ()) -> None:
        """Write the next row; `frame.index` must be `rows`. `flags`: flags of the monitor, for this row or for earlier
        rows.

        Raises DataError for a wrong shape, type or index; nothing is written then. Also raises DataError if the disk
        failed. Earlier frames then stay readable, and no more frames can be appended.
        """
        self._check(frame, digest)
        try:
            self._require_untouched()
            self._table.write(frame, digest, mark_of(flag for flag in flags if flag.frame == frame.index))
            for flag in flags:
                if flag.frames != range(frame.index, frame.index + 1) and (bits := bitmask([flag])):
                    self._table.add_flags(flag.frames, bits)
                    self._table.add_place(place_of(flag), flag.frame, flag.score, flag.regions())
            self._rows += 1
            if self._rows - self._committed >= self._flush_every:
                self.flush()
        except FAILURES as error:
            with suppress(*FAILURES):
                self.flush()  # flags of earlier rows may still be written
            self._broken = True
            raise self._disk_error("store the frame in", error) from error

    @property
    def rows(self) -> int:
        """Number of appended frames."""
        return self._rows

    @property
    def committed(self) -> int:
        """Number of frames that are complete in the file: readers see them, and they survive a crash of this
        process."""
        return self._committed

    @property
    def safe(self) -> int:
        """Number of committed frames that are known to be on the disk. After a failed fsync, all frames since the last
        successful fsync may be lost.
        """
        return self._to_disk.rows if self._to_disk.failed else self._committed

    def flush(self) -> None:
        """Commit all rows so far, regardless of `flush_every`. Does nothing after a failed write."""
        if self._broken:
            return
        self._require_untouched()
        self._table.flush()
        self._file.flush()
        self._progress[()] = self._rows
        self._progress.flush()
        self._committed, self._before = self._rows, os.fstat(self._handle)
        self._to_disk(self._committed)

    def end_pass(self) -> None:
        """Record that a pass ends with the last row. The file must have been created with ScanInfo.decides.

        Raises DataError if the disk failed, with the same effect as in `append`.
        """
        self._append_last(layout.PASS_ENDS, self._rows, "the end of a pass")

    def add_decision(self, values: Mapping[str, object]) -> None:
        """Record the choice after a pass. The file must have been created with ScanInfo.decides. Raises the same errors
        as `end_pass`.
        """
        self._append_last(layout.DECISIONS, json_of(values).encode(), "a decision")

    def _append_last(self, path: str, value: int | bytes, what: str) -> None:
        if self._broken or path not in self._last:
            return
        try:
            column = self._last[path]
            column.resize(len(column) + 1, 0)
            column[-1] = value
            self.flush()
        except FAILURES as error:
            self._broken = True
            raise self._disk_error(f"store {what} in", error) from error

    def close(
        self,
        status: str = "complete",
        missing: Sequence[int] = (),
        beam: Sequence[BeamReading] = (),
        reason: str = "",
    ) -> None:
        """Finish the file: write how and when the scan ended, then `finished`, then the /exchange view. A second call
        does nothing.

        After a failed write, the file only gets the status "failed" and `finished`. It stays marked as being written.

        Args:
            status, missing, reason: see ScanEnding.
            beam: readings of the beam monitor; written if the file was created with ScanInfo.beam_unit.

        Raises DataError if the disk failed. Committed frames stay readable.
        """
        if status not in STATUSES:
            raise ValueError(f"Status {status!r} is unknown; expected {', '.join(STATUSES)}.")
        if not self._open:
            return
        self._open = False
        try:
            if self._broken:
                self._let_go(reason)
                return
            self._finish(ScanEnding(status, tuple(missing), reason), beam)
            self._put_exchange_view()
        except FAILURES as error:
            if not self._broken:
                self._broken = True
                with suppress(*FAILURES):
                    self._let_go(reason or f"The file could not be finished ({hdf5.reason(error)}).")
            raise self._disk_error("finish", error) from error
        finally:
            self._lock.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, *_: object) -> None:
        self.close("complete" if error is None else "failed", reason="" if error is None else user_message(error))

    def _finish(self, ending: ScanEnding, beam: Sequence[BeamReading]) -> None:
        self.flush()
        series = {
            layout.BEAM_TIME: np.array([reading.time for reading in beam], np.float64),
            layout.BEAM_VALUE: np.array([reading.value for reading in beam], np.float64),
        }
        for path, values in series.items():
            if path in self._last:
                self._last[path].resize(values.size, 0)
                self._last[path][...] = values
        texts = {
            layout.END_TIME: layout.iso_time(self._clock.now()),
            layout.FIELD_OF_VIEW: layout.field_of_view(self._file),
        }
        for path, text in texts.items():
            if text and path in self._last:
                self._last[path][()] = text.encode()
        state_ending(self._last, ending)
        self._file.flush()
        self._last[layout.FINISHED][()] = 1
        self._file.flush()
        self._to_disk.finish(self._committed)
        try:
            self._file.close()
        except FAILURES:
            self._broken = True  # HDF5 has closed half of the file; using it again would crash
            raise

    def _let_go(self, reason: str) -> None:
        """Write the mark of the end into space that already exists in the file. Leave everything else as a killed
        process would leave it.

        Readers see every committed frame.
        """
        try:
            state_words(self._last, ScanEnding("failed", reason=reason))
            self._last[layout.FINISHED][()] = 1
            for path in (layout.REASON, layout.STATUS, layout.FINISHED):
                self._last[path].flush()
        finally:  # otherwise HDF5 would write again what the disk rejected, now and at the end of the process
            with Path(os.devnull).open("r+b") as nowhere, suppress(*FAILURES):
                os.dup2(nowhere.fileno(), self._handle)
                self._file.close()

    def _require_untouched(self) -> None:
        """Raise OSError if another program has truncated or deleted the file. HDF5 would not notice, and would continue
        to write.
        """
        now = os.fstat(self._handle)
        if now.st_nlink == 0 < self._before.st_nlink:  # if the file system supports hard links
            raise _TouchedError(errno.ENOENT, "it was deleted")
        if now.st_size < self._before.st_size:
            raise _TouchedError(errno.EIO, f"it was cut from {self._before.st_size} to {now.st_size} bytes")

    def _check(self, frame: Frame, digest: FrameDigest) -> None:
        counts, preview = frame.counts, digest.preview
        unlike = counts.dtype != np.uint16 or counts.shape != self._shape
        faults = {
            "the file is closed": not self._open,
            "an earlier write failed": self._broken,
            f"it is {counts.dtype} {counts.shape}; expected uint16 {self._shape}": unlike,
            f"its preview is {preview.shape}; expected {self._preview_shape}": preview.shape != self._preview_shape,
            f"its index is {frame.index}; expected {self._rows}, the next row": frame.index != self._rows,
        }
        if wrong := next((fault for fault, there in faults.items() if there), ""):
            raise DataError(
                f"Frame {frame.index} was not written to {self.path}: {wrong}. The earlier frames are safe."
            )

    def _disk_error(self, what: str, error: Exception) -> DataError:
        if isinstance(error, _TouchedError):
            return DataError(
                f"Another program changed {self.path} while the scan was writing it ({error.strerror}). "
                f"Some or all of the {self._committed} frames are lost. Copy the file, run `beamline "
                "recover` on the copy, and repeat the scan."
            )
        free = ""
        with suppress(OSError):  # the folder may have been moved
            free = f"; {size(shutil.disk_usage(self.path.parent).free)} are free on its disk"
        return DataError(
            f"Could not {what} {self.path} ({hdf5.reason(error)}){free}. The first {self.safe} frames are "
            "safe in this file: run `beamline recover` to make an ordinary scan file of them."
        )

    def _put_exchange_view(self) -> None:
        """Add the /exchange view. This is not possible while writing with SWMR, because it creates datasets. No frame
        depends on the view.
        """
        # if h5py still had the file open, HDF5 would remove the view again when it closes the file
        if hdf5.grows_here(self.path):
            self.remarks.append(
                f"{self.path} has no /exchange view, because this program has the file open with h5py. "
                "Close it there; then `beamline recover` adds the view."
            )
            return
        try:
            put_exchange_view(self.path)
        except DataError as error:
            self.remarks.append(
                f"{self.path} has no /exchange view: {error} Its {self._committed} frames are safe in /entry; "
                "`beamline recover` adds the view."
            )
