"""Snapshots of a growing volume: a file and a picture, each replacing the last in one step."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path

from beamline.core.errors import DataError
from beamline.core.events import Sink, SnapshotWritten
from beamline.core.files import write_whole
from beamline.core.sinks import Warnings
from beamline.reconstruct.options import ReconOptions
from beamline.report.live_picture import LivePicture
from beamline.storage.readers.base import ScanSource
from beamline.storage.writers.recon_file import ReconRecord, write_reconstruction
from drivers.base.clock import Clock
from recon.base.volume import Volume
from recon.splatting.stream import StreamingFit


class Snapshots:
    """The files `<output>.snapshot.h5` and `<output>.live.png` of a followed scan."""

    def __init__(self, options: ReconOptions, source: ScanSource, sink: Sink, clock: Clock, warn: Warnings) -> None:
        self._source, self._sink, self._clock, self._warn = source, sink, clock, warn
        self._begin = clock.now()
        self._sample = str(source.attributes.get("sample", "not stated"))
        output = options.target.output
        self.path: Path = output.with_name(f"{output.stem}.snapshot.h5")
        self.picture_path = options.target.live_picture
        self.drawn = False  # the picture is of this scan
        self._unit = "mm" if source.pixel_size_mm or options.selection.pixel_size_mm else "px"

    def write(self, fit: StreamingFit, axis_col: float) -> None:
        """The volume as it stands, and its picture, in place of the last ones."""
        record = ReconRecord(
            volume=fit.snapshot(),
            length_unit=self._unit,
            raw_file=str(self._source.path.resolve()),
            title=f"Snapshot from {fit.n_views} views",
            sample=self._sample,
            time=self._clock.now(),
            parameters={"axis_col": axis_col, "n_views": fit.n_views},
        )
        try:
            write_reconstruction(self.path, record, replace=True)
            self._write_picture(fit, record.volume)
        except DataError as error:
            # Windows does not replace a file that a viewer holds open: the next snapshot will.
            self._warn(f"A snapshot was left out: {error}")
            return
        self.drawn = True
        now = self._clock.now()
        written = self.path, self.picture_path, fit.n_views, now - self._begin, fit.unlearnt
        self._sink(SnapshotWritten(*written, time=now))

    def remove(self) -> None:
        """Remove the snapshot after the volume is delivered. The picture of the growing volume stays."""
        with suppress(PermissionError):  # Windows removes no file that a viewer holds open
            self.path.unlink(missing_ok=True)

    def _write_picture(self, fit: StreamingFit, volume: Volume) -> None:
        new = f"residual of new views {fit.unlearnt:.3f}, " if math.isfinite(fit.unlearnt) else ""
        title = (
            f"{fit.n_views} views so far, {new}{fit.progress().n_gaussians} Gaussians, "
            f"{self._clock.now() - self._begin:.0f} s after the first look"
        )
        picture = LivePicture(volume, *fit.newest_view(), title, self._unit)
        write_whole(self.picture_path, picture.png(), replace=True)
