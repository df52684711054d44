"""NXtomoWriter: a scan's file while it grows, in a state that a reader can trust after every frame.

The file is written SWMR (single writer, multiple readers): what was flushed can be read by others at once, and
survives the death of this process; every second it is brought to the disk (fsync), where it survives a loss of power.
`frames_committed` is advanced last, so that it never counts half a row.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import to_disk
from beamline.core.text import size
from beamline.monitor.check import Flag
from beamline.monitor.checks import bitmask
from beamline.monitor.digest import FrameDigest, preview_shape
from beamline.storage import hdf5
from beamline.storage.flag_legend import mark_of
from beamline.storage.writer_lock import WriterLock
from beamline.storage.writers import layout
from beamline.storage.writers.exchange_view import add_exchange_view
from beamline.storage.writers.layout import ScanInfo
from beamline.storage.writers.to_disk import ToDisk
from drivers.clock import Clock
from drivers.frame import Frame
from drivers.protocols import BeamReading

__all__ = ["NXtomoWriter", "ScanInfo"]

STATUSES = ("complete", "stopped", "failed")
FAILURES = (OSError, RuntimeError, ValueError)  # what h5py makes of HDF5's errors
VIEW_ROOM = 10_000_000  # bytes that must be free: more than the /exchange view ever takes


class NXtomoWriter:
    """Writes uint16 frames row by row; never overwrites a file.

    Every append leaves pixels, digest and record of the frame in the file before `frames_committed` counts it.
    Attribute `remarks`: what close() could not do though the data are safe, one sentence each.
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
        """Create the file, ready to be followed.

        Args:
            frame_shape: (rows, cols) of every frame.
            preview_bin: the bin that the digests' previews are made with.
            flush_every: frames between flushes; a crash loses at most the frames since the last one.

        DataError where the file exists or cannot be made.
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
        try:
            self._file = h5py.File(self.path, "x", libver=layout.LIBVER)
        except FileExistsError as error:
            raise DataError(
                f"{self.path} exists. A scan never overwrites a file: name a new one. Nothing was written."
            ) from error
        except OSError as error:
            why = hdf5.reason(error)
            raise DataError(f"{self.path} cannot be created ({why}). Is its folder there and writable?") from error
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
            self._file.swmr_mode = True  # from here on nothing may be created: Rows can only grow what it holds
            self._lock = WriterLock(self.path)
        except BaseException as error:  # without a frame in it, it is no use to anybody
            with suppress(*FAILURES):
                self._file.close()
            self.path.unlink()
            if isinstance(error, OSError | RuntimeError):
                raise DataError(
                    f"{self.path} cannot be created ({hdf5.reason(error)}). Nothing is left of it."
                ) from error
            raise
        self._table = layout.Rows(self._file)
        self._to_disk = ToDisk(self._file.id.get_vfd_handle())
        self._progress = self._file[layout.COMMITTED]

    def append(self, frame: Frame, digest: FrameDigest, flags: Sequence[Flag] = ()) -> None:
        """Write the next row; `frame.index` must be `rows`. `flags`: what the monitor found, in rows before it too.

        DataError for a wrong shape, type or index (nothing is written), or a disk that does not take it (the frames
        before stay readable; nothing more can be appended).
        """
        self._check(frame, digest)
        record = layout.Record(
            frame.kind, frame.angle, frame.exposure, frame.trigger, frame.framestamp, frame.time, mark_of(flags),
            frame.replaces,
        )  # fmt: skip
        try:
            self._table.write(self._rows, frame.counts, digest, record)
            for flag in flags:
                if len(flag.frames) > 1:
                    self._table.add_flags(flag.frames, bitmask([flag]))
            self._rows += 1
            if self._rows - self._committed >= self._flush_every:
                self.flush()
        except FAILURES as error:
            with suppress(*FAILURES):
                self.flush()  # the rows before may still fit
            self._broken = True
            raise self._disk_error("take the frame", error) from error

    @property
    def rows(self) -> int:
        """Frames appended."""
        return self._rows

    @property
    def committed(self) -> int:
        """Frames that are complete in the file, seen by readers and safe from a crash of this process."""
        return self._committed

    @property
    def safe(self) -> int:
        """Of these, what the disk has, as far as is known: after a failed fsync it may have lost what came since the
        last one that succeeded."""
        return self._to_disk.rows if self._to_disk.failed else self._committed

    def flush(self) -> None:
        """Commit the rows appended so far, whatever `flush_every` says; nothing after a failed write."""
        if self._broken:
            return
        self._table.flush()
        self._file.flush()
        self._progress[()] = self._rows
        self._progress.flush()
        self._committed = self._rows
        self._to_disk(self._committed)

    def close(self, status: str = "complete", missing: Sequence[int] = (), beam: Sequence[BeamReading] = ()) -> None:
        """Finish: missing triggers, end time and status, then `finished`, then the /exchange view. Twice is once.

        After a failed write the file only gets status "failed" and `finished`, and is not closed.

        Args:
            status: "complete", "stopped" (by the operator) or "failed".
            missing: triggers, counted over the whole scan from 0, that gave no frame.
            beam: readings of the beam monitor; kept where the file was made for them (ScanInfo.beam_unit).

        DataError where the disk does not take it; the frames committed stay readable.
        """
        if status not in STATUSES:
            raise ValueError(f"Status {status!r} is none of {', '.join(STATUSES)}.")
        if not self._open:
            return
        self._open = False
        try:
            if self._broken:
                self._let_go()
                return
            self._finish(status, np.asarray(missing, np.int64), beam)
        except FAILURES as error:
            if not self._broken:
                self._broken = True
                with suppress(*FAILURES):
                    self._let_go()
            raise self._disk_error("be finished", error) from error
        finally:
            self._lock.release()
        self._add_exchange_view()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close("complete" if kind is None else "failed")

    def _finish(self, status: str, missing: NDArray[np.int64], beam: Sequence[BeamReading]) -> None:
        self.flush()
        series: dict[str, NDArray[Any]] = {layout.MISSING: missing}
        if f"{layout.BEAM}/value" in self._file:
            series[f"{layout.BEAM}/time"] = np.array([reading.time for reading in beam], np.float64)
            series[f"{layout.BEAM}/value"] = np.array([reading.value for reading in beam], np.float64)
        for path, values in series.items():
            self._file[path].resize(values.size, 0)
            self._file[path][...] = values
        self._file[layout.END_TIME][()] = layout.iso_time(self._clock.now()).encode()
        self._file[layout.STATUS][()] = status.encode()
        self._file.flush()
        self._file[layout.FINISHED][()] = 1
        self._file.flush()
        self._to_disk.finish(self._committed)
        self._file.close()

    def _let_go(self) -> None:
        """Mark the end where there is room for it already, and leave the rest as a dead writer would.

        Readers see every frame committed.
        """
        hdf5.never_close(self._file)
        for path, value in ((layout.STATUS, b"failed"), (layout.FINISHED, 1)):
            dataset = self._file[path]
            dataset[()] = value
            dataset.flush()

    def _check(self, frame: Frame, digest: FrameDigest) -> None:
        counts, wrong = frame.counts, ""
        if not self._open or self._broken:
            wrong = "the file is closed" if not self._open else "an earlier write failed"
        elif counts.dtype != np.uint16 or counts.shape != self._shape:
            wrong = f"it is {counts.dtype} {counts.shape}, expected uint16 {self._shape}"
        elif digest.preview.shape != self._preview_shape:
            wrong = f"its preview is {digest.preview.shape}, expected {self._preview_shape}"
        elif frame.index != self._rows:
            wrong = f"its index is {frame.index}, expected {self._rows}, the next row"
        if wrong:
            raise DataError(f"Frame {frame.index} is not written to {self.path}: {wrong}. The rows before are safe.")

    def _disk_error(self, what: str, error: Exception) -> DataError:
        free = shutil.disk_usage(self.path.parent).free
        return DataError(
            f"{self.path} could not {what} ({hdf5.reason(error)}); {size(free)} are free on its disk. "
            f"The first {self.safe} frames are safe in it and can be read."
        )

    def _add_exchange_view(self) -> None:
        # Groups cannot be made under SWMR, so this needs the file once more, and must not fail half-way: that would
        # leave it marked as open for writing. A foreign reader may hold a lock on it; our own followers hold none.
        free = shutil.disk_usage(self.path.parent).free
        if free < VIEW_ROOM:
            self._remark_no_view(f"only {size(free)} are free on its disk")
            return
        try:
            file = h5py.File(self.path, "r+", libver=layout.LIBVER)
        except OSError as error:
            held = "another program holds it open: " if isinstance(error, BlockingIOError | PermissionError) else ""
            self._remark_no_view(held + hdf5.reason(error))
            return
        with file:
            layout.settle(file)
            add_exchange_view(file)
            file.flush()
            to_disk(file.id.get_vfd_handle())

    def _remark_no_view(self, why: str) -> None:
        self.remarks.append(
            f"{self.path} has no /exchange view ({why}). Its {self._committed} frames are safe in /entry."
        )
