"""NXtomoWriter: writes the file of a scan so that the file is valid after every frame.

The file is written SWMR (single writer, multiple readers). Other programs can read flushed frames at once, and flushed
frames survive if this process is killed. Every second an fsync brings them to the disk, where they also survive a loss
of power. `frames_committed` is increased last, so that it never counts an incomplete row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError, user_message
from beamline.core.events import json_of
from beamline.monitor.check import Flag
from beamline.monitor.checks import bitmask
from beamline.monitor.digest import FrameDigest, preview_shape
from beamline.storage import hdf5
from beamline.storage.flag_legend import mark_of, place_of
from beamline.storage.writers import layout
from beamline.storage.writers.layout import ScanInfo
from beamline.storage.writers.rows import STATUSES, Rows, ScanEnding, put_exchange_view
from beamline.storage.writers.swmr_file import FAILURES, SwmrFile
from drivers.base.clock import Clock
from drivers.base.frame import Frame
from drivers.base.protocols import BeamReading

__all__ = ["NXtomoWriter", "ScanInfo"]


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
        self._clock, self._flush_every, self._rows, self._open = clock, flush_every, 0, True
        self._shape = (int(frame_shape[0]), int(frame_shape[1]))
        self._preview_shape = preview_shape(self._shape, preview_bin)
        create = partial(layout.create, quantity="counts", preview_bin=preview_bin, start=clock.now())
        self._file = SwmrFile(self.path, lambda file: create(file, info, self._shape, np.dtype("<u2")))
        self._table = Rows(self._file.file)

    def append(self, frame: Frame, digest: FrameDigest, flags: Sequence[Flag] = ()) -> None:
        """Write the next row; `frame.index` must be `rows`. `flags`: flags of the monitor, for this row or for earlier
        rows.

        Raises DataError for a wrong shape, type or index; nothing is written then. Also raises DataError if the disk
        failed. Earlier frames then stay readable, and no more frames can be appended.
        """
        self._check(frame, digest)
        try:
            self._file.require_untouched()
            self._table.write(frame, digest, mark_of(flag for flag in flags if flag.frame == frame.index))
            for flag in flags:
                if flag.frames != range(frame.index, frame.index + 1) and (bits := bitmask([flag])):
                    self._table.add_flags(flag.frames, bits)
                    self._table.add_place(place_of(flag), flag.frame, flag.score, flag.regions())
            self._rows += 1
            if self._rows - self.committed >= self._flush_every:
                self.flush()
        except FAILURES as error:
            with suppress(*FAILURES):
                self.flush()  # flags of earlier rows may still be written
            self._file.broken = True
            raise self._file.disk_error("store the frame in", error) from error

    @property
    def rows(self) -> int:
        """Number of appended frames."""
        return self._rows

    @property
    def committed(self) -> int:
        """Number of frames that are complete in the file: readers see them, and they survive a crash of this
        process."""
        return self._file.committed

    @property
    def safe(self) -> int:
        """Number of committed frames that are known to be on the disk. After a failed fsync, all frames since the last
        successful fsync may be lost.
        """
        return self._file.safe

    def flush(self) -> None:
        """Commit all rows so far, regardless of `flush_every`. Does nothing after a failed write."""
        if not self._file.broken:
            self._file.require_untouched()
            self._table.flush()
            self._file.commit(self._rows)

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
        if self._file.broken or path not in self._file.last:
            return
        try:
            self._file.grow(path, value)
            self.flush()
        except FAILURES as error:
            self._file.broken = True
            raise self._file.disk_error(f"store {what} in", error) from error

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
            if self._file.broken:
                self._file.let_go(reason)
                return
            self.flush()
            self._file.finish(self._at_the_end(beam), ScanEnding(status, tuple(missing), reason))
            self._put_exchange_view()
        except FAILURES as error:
            if not self._file.broken:
                self._file.broken = True
                with suppress(*FAILURES):
                    self._file.let_go(reason or f"The file could not be finished ({hdf5.reason(error)}).")
            raise self._file.disk_error("finish", error) from error
        finally:
            self._file.lock.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, *_: object) -> None:
        self.close("complete" if error is None else "failed", reason="" if error is None else user_message(error))

    def _at_the_end(self, beam: Sequence[BeamReading]) -> dict[str, NDArray[np.float64] | bytes]:
        """Values that are known at the end, by the path of their dataset."""
        texts = {
            layout.END_TIME: layout.iso_time(self._clock.now()),
            layout.FIELD_OF_VIEW: layout.field_of_view(self._file.file),
        }
        return {
            layout.BEAM_TIME: np.array([reading.time for reading in beam], np.float64),
            layout.BEAM_VALUE: np.array([reading.value for reading in beam], np.float64),
            **{path: text.encode() for path, text in texts.items() if text},
        }

    def _check(self, frame: Frame, digest: FrameDigest) -> None:
        counts, preview = frame.counts, digest.preview
        unlike = counts.dtype != np.uint16 or counts.shape != self._shape
        faults = {
            "the file is closed": not self._open,
            "an earlier write failed": self._file.broken,
            f"it is {counts.dtype} {counts.shape}; expected uint16 {self._shape}": unlike,
            f"its preview is {preview.shape}; expected {self._preview_shape}": preview.shape != self._preview_shape,
            f"the index of the frame is {frame.index}; expected {self._rows}, the next row": frame.index != self._rows,
        }
        if wrong := next((fault for fault, there in faults.items() if there), ""):
            raise DataError(
                f"Frame {frame.index} was not written to {self.path}: {wrong}. The earlier frames are safe."
            )

    def _put_exchange_view(self) -> None:
        """Add the /exchange view. This is not possible while writing with SWMR, because it creates datasets. No frame
        depends on the view.
        """
        # if h5py still had the file open, HDF5 would remove the view again when it closes the file
        if hdf5.grows_here(self.path):
            self.remarks.append(
                f"{self.path} has no /exchange view, because this program has the file open with h5py. Close the "
                "h5py file in this program; then `beamline recover` adds the view."
            )
            return
        try:
            put_exchange_view(self.path)
        except DataError as error:
            self.remarks.append(
                f"{self.path} has no /exchange view: {error} Its {self.committed} frames are safe in /entry; "
                "`beamline recover` adds the view."
            )
