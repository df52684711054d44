"""NXtomoWriter: a scan's file while it grows, in a state that a reader can trust after every frame.

The file is written SWMR (single writer, multiple readers): what was flushed can be read by others at once, and
survives the death of this process. `frames_committed` is advanced last, so that it never counts half a row.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import h5py
import numpy as np

from beamline.digest import FrameDigest, preview_shape
from beamline.errors import DataError
from beamline.storage import nxtomo_layout as layout
from beamline.storage.exchange_view import add_exchange_view
from beamline.storage.nxtomo_layout import ScanInfo
from drivers.clock import Clock
from drivers.frame import Frame

__all__ = ["NXtomoWriter", "ScanInfo"]

STATUSES = ("complete", "stopped", "failed")


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
            raise DataError(f"{self.path} cannot be created ({error}). Is its folder there and writable?") from error
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
        except BaseException:  # without a frame in it, it is no use to anybody
            self._file.close()
            self.path.unlink()
            raise
        self._table = layout.Rows(self._file)
        self._progress = self._file[layout.COMMITTED]

    def append(self, frame: Frame, digest: FrameDigest, flags: int = 0) -> None:
        """Write the next row; `frame.index` must be `rows`. `flags`: 32-bit mask of the monitor's checks.

        DataError for a wrong shape, type or index (nothing is written), or a disk that does not take it (the frames
        before stay readable; nothing more can be appended).
        """
        self._check(frame, digest, flags)
        record = layout.Record(
            frame.kind, frame.angle, frame.exposure, frame.trigger, frame.framestamp, frame.time, flags
        )
        try:
            self._table.write(self._rows, frame.counts, digest, record)
            self._rows += 1
            if self._rows - self._committed >= self._flush_every:
                self.flush()
        except (OSError, RuntimeError, ValueError) as error:  # what h5py makes of HDF5's errors
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

    def flush(self) -> None:
        """Commit the rows appended so far, whatever `flush_every` says."""
        self._file.flush()
        self._progress[()] = self._rows
        self._progress.flush()
        self._committed = self._rows

    def close(self, status: str = "complete", missing: Sequence[int] = ()) -> None:
        """Finish: missing triggers, end time and status, then `finished`, then the /exchange view. Twice is once.

        Args:
            status: "complete", "stopped" (by the operator) or "failed".
            missing: triggers, counted over the whole scan from 0, that gave no frame.
        """
        if status not in STATUSES:
            raise ValueError(f"Status {status!r} is none of {', '.join(STATUSES)}.")
        lost = np.asarray(missing, np.int64)
        if not self._open:
            return
        self._open = False
        try:
            if not self._broken:
                self.flush()
            triggers = self._file[layout.MISSING]
            triggers.resize(lost.size, 0)
            triggers[...] = lost
            self._file[layout.END_TIME][()] = layout.iso_time(self._clock.now()).encode()
            self._file[layout.STATUS][()] = ("failed" if self._broken else status).encode()
            self._file.flush()
            self._file[layout.FINISHED][()] = 1
            self._file.close()
        except (OSError, RuntimeError, ValueError) as error:
            raise self._disk_error("be finished", error) from error
        self._add_exchange_view()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close("complete" if kind is None else "failed")

    def _check(self, frame: Frame, digest: FrameDigest, flags: int) -> None:
        counts, wrong = frame.counts, ""
        if not self._open or self._broken:
            wrong = "the file is closed" if not self._open else "an earlier write failed"
        elif counts.dtype != np.uint16 or counts.shape != self._shape:
            wrong = f"it is {counts.dtype} {counts.shape}, expected uint16 {self._shape}"
        elif digest.preview.shape != self._preview_shape:
            wrong = f"its preview is {digest.preview.shape}, expected {self._preview_shape}"
        elif frame.index != self._rows:
            wrong = f"its index is {frame.index}, expected {self._rows}, the next row"
        elif not 0 <= flags < 2**32:
            wrong = f"its flags are {flags}, expected a 32-bit mask"
        if wrong:
            raise DataError(f"Frame {frame.index} is not written to {self.path}: {wrong}. The rows before are safe.")

    def _disk_error(self, what: str, error: Exception) -> DataError:
        free = shutil.disk_usage(self.path.parent).free
        return DataError(
            f"{self.path} could not {what} ({error}); {free / 1e9:.1f} GB are free on its disk. "
            f"The first {self._committed} frames are in the file and can be read."
        )

    def _add_exchange_view(self) -> None:
        # Groups cannot be made under SWMR, so this needs the file once more. A foreign reader may hold a lock on it;
        # our own followers hold none.
        try:
            with h5py.File(self.path, "r+", libver=layout.LIBVER) as file:
                layout.settle(file)
                add_exchange_view(file)
        except OSError as error:
            self.remarks.append(
                f"{self.path} has no /exchange view ({error}): another program holds it open. "
                "The scan itself is complete in /entry."
            )
