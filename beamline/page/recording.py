"""Recording: the data of the page, from a scan file that may still be growing. All calls must come from one thread
(HDF5)."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.page.tiles import MOST, TileRegion, bin_mean, lit
from beamline.storage import datasets, hdf5, scan_file
from beamline.storage.flag_legend import read_flags, read_legend
from beamline.storage.recorded_frames import frames_in
from beamline.storage.writers import layout


@dataclass(frozen=True)
class ScanProgress:
    """Number of complete frames in a scan file, its status (`running`, `complete`, `stopped` or `failed`), and the time
    of the newest frame in s since the Unix epoch (None if there is no frame)."""

    frames: int
    status: str
    newest: float | None = None


class Recording:
    """A scan file of this program, opened for reading while it may still be written.

    Raises: NotReadyError: the file is being created. DataError: the file is not a scan of this program.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.is_file() and path.stat().st_size and not hdf5.is_hdf5(path):
            raise _foreign(path)
        scan = scan_file.opened(path, follow=True)
        if scan is None:
            raise _foreign(path)
        self._scan, self.shape, self.close = scan, scan.shape, scan.close
        with hdf5.closed_on_error(scan), hdf5.readable(path):
            self._preview: h5py.Dataset = scan.file[layout.PREVIEW]  # stays open, see `ScanFile.data`
            self.preview_bin = int(self._preview.attrs["bin"])
        self._dark_and_flat: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None

    @property
    def has_references(self) -> bool:
        """True if pictures are divided by flats."""
        return self._dark_and_flat is not None

    def progress(self) -> ScanProgress:
        n, scan = self._scan.committed(), self._scan
        newest = _json_number(scan.values(layout.TIME, n - 1)) if n else None
        return ScanProgress(n, datasets.text(scan.values(layout.STATUS)) if scan.finished else "running", newest)

    def facts(self) -> dict[str, Any]:
        """Constant facts: sample, shape, pixel size in mm (null: unknown), axis, checks of the monitor."""
        scan = self._scan
        axis = datasets.dataset(scan.file, layout.AXIS_COL)
        return {
            "sample": datasets.text_at(scan.file, "/entry/sample/name"),
            "title": datasets.text_at(scan.file, "/entry/title"),
            "shape": self.shape,
            "preview_bin": self.preview_bin,
            "pixel_mm": datasets.scalar(scan.file, f"{layout.DETECTOR}/x_pixel_size", datasets.LENGTH_UNITS),
            "axis_col": None if axis is None else _json_number(axis[()]),
            "monitored": datasets.text_at(scan.file, "/entry/record/plan") not in ("", "{}"),
            "checks": [
                {"name": check.name, "unit": check.unit, "meaning": check.meaning} for check in read_legend(scan.file)
            ],
        }

    def columns(self, first: int) -> dict[str, Any]:
        """Kind, angle (deg), time (s) and mean counts of the frames from `first` on."""
        frames = self.progress().frames
        names = {"kind": layout.KIND, "angle": layout.ANGLE, "time": layout.TIME, "mean": "/entry/digest/mean"}
        return {"first": first, **{name: self._column(path, first, frames) for name, path in names.items()}}

    def flags(self) -> list[dict[str, Any]]:
        """Each flag of each frame: frame, check, whether it is an alarm, score, region [row, row, col, col] or null."""
        frame_flags = read_flags(self._scan.file, self.progress().frames)
        listed = []
        for frame in np.flatnonzero(frame_flags.flagged):
            bits = int(frame_flags.bits[frame])
            for i, check in enumerate(frame_flags.legend):
                if not bits >> check.bit & 1:
                    continue
                score, region = float(frame_flags.scores[frame, i]), frame_flags.regions[frame, i].tolist()
                listed.append(
                    {
                        "frame": int(frame),
                        "check": check.name,
                        "alarm": bool(bits >> check.alarm_bit & 1),
                        "score": _json_number(score),
                        "region": None if region[0] < 0 else region,
                    }
                )
        return listed

    def picture(
        self, frame: int, region: TileRegion, *, corrected: bool
    ) -> tuple[NDArray[np.float32], TileRegion, int]:
        """Part of a frame, binned to a tile, as counts or as transmission.

        Returns:
            Values, the region that they show, and their binning. Without darks and flats, `corrected` gives counts.

        Raises:
            DataError: the file does not have this frame, or it cannot be read.
        """
        frames = self.progress().frames
        if not 0 <= frame < frames:
            raise DataError(f"Frame {frame} is not in the file, which has {frames}.")
        region = region.inside(self.shape)
        rows, cols = region.slices
        factor = region.binning()
        pixels = bin_mean(self._scan.data[frame, rows, cols], (factor, factor))
        if corrected and (references := self._references(frames)) is not None:
            dark, flat = (bin_mean(mean[rows, cols], (factor, factor)) for mean in references)
            with np.errstate(divide="ignore", invalid="ignore"):
                pixels = (pixels - dark) / (flat - dark)
        return pixels, region, factor

    def sinogram(self, row: int, first: int) -> tuple[NDArray[np.float32], NDArray[np.int64], int]:
        """A detector row in the projections from frame `first` on; for a compressed file, means of the blocks of the
        preview.

        Returns:
            [view, col / bin] of at most 1024 columns, the frames, and the binning.
        """
        views = frames_in(self._scan.file, self.progress().frames).views
        views = views[views >= first]
        packed = self._scan.data.id.get_create_plist().get_nfilters() > 0  # each row would cost reading a whole frame
        source, bin_of_source = (self._preview, self.preview_bin) if packed else (self._scan.data, 1)
        row_of_source = min(max(row // bin_of_source, 0), source.shape[1] - 1)
        hdf5.look_again(source)
        factor = max(1, -(-source.shape[2] // MOST))
        lines = [bin_mean(source[int(view), row_of_source : row_of_source + 1], (1, factor)) for view in views]
        return (
            np.concatenate([np.empty((0, -(-source.shape[2] // factor)), np.float32), *lines]),
            views,
            bin_of_source * factor,
        )

    def trace(self, region: TileRegion, first: int) -> list[float | None]:
        """Mean counts of a region in the frames from `first` on; the region is rounded to whole blocks of the
        preview."""
        blocks = TileRegion(*(edge // self.preview_bin for edge in astuple(region)))
        rows, cols = blocks.inside((self._preview.shape[1], self._preview.shape[2])).slices
        hdf5.look_again(self._preview)
        frames = range(first, self.progress().frames)
        return [_json_number(self._preview[frame, rows, cols].mean()) for frame in frames]

    def _column(self, path: str, first: int, frames: int) -> list[Any]:
        values = self._scan.values(path, slice(first, frames))
        return [_json_number(value) for value in values] if values.dtype.kind == "f" else values.tolist()

    def _references(self, frames: int) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """Means of the first darks and flats, at most eight of each; None until there are darks and flats."""
        if self._dark_and_flat is None:
            table = frames_in(self._scan.file, frames)
            darks, flats = table.darks[:8], table.flats[:8]
            if darks.size == 0 or flats.size == 0:
                return None
            dark = self._mean(darks)
            self._dark_and_flat = dark, lit(self._mean(flats), dark)
        return self._dark_and_flat

    def _mean(self, rows: NDArray[np.intp]) -> NDArray[np.float32]:
        total = np.zeros(self.shape, np.float32)
        for row in rows:
            total += self._scan.data[int(row)]
        return total / np.float32(rows.size)


def _foreign(path: Path) -> DataError:
    return DataError(
        f"{path} was not written by `beamline scan`, so the page cannot show this scan while it runs. `beamline view "
        f"{path}` shows what it contains, and `beamline recon {path}` reconstructs a scan."
    )


def _json_number(value: Any) -> float | None:
    """The number; None for NaN and infinity, which JSON cannot represent."""
    return float(value) if np.isfinite(value) else None
