"""ShownScan: a scan in any format on the page: its flat-field corrected projections as a stack, means, and one slice
for any axis.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.page.tiles import TileRegion, lit
from beamline.page.volume import ShownVolume, VolumeTile
from beamline.projections.correction import ScanCorrectionPlan, apply, survey
from beamline.projections.corrections.resampling import TiltAndLens
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.storage.readers.base import ScanSource, read_known
from beamline.storage.volumes.base import bare_record
from drivers.base.frame import FrameKind
from recon.base.geometry import Geometry
from recon.base.views import spread, spread_views
from recon.base.volume import Grid
from recon.prep.align import closest_pair, find_axis

F32 = NDArray[np.float32]
_REFERENCES = 8  # largest number of darks and of flats that are averaged
_VIEWS, _FAST_VIEWS = 360, 120  # largest number of projections for a slice; the same while a slider moves
_MOST, _FAST_MOST = 768, 256  # largest number of voxels along a side of the slice
# share of the columns: if the axis is farther from the detector's middle, the field of view of the slice is larger
_CENTRED = 1 / 8
_BESIDE = 2  # number of rows, next to that of the slice, from which the axis is found
_MISSES = math.radians(2)  # largest difference of a pair from 180 degrees


class _OverFlats:
    """Projections [view, row, col] as transmission; if there are no flats, as stored.

    Attributes:
        dark, flat: means [row, col] of the first darks and flats; None if there are none. light: [view] mean intensity
            of each projection that was read; NaN for the others.
    """

    dtype = np.dtype(np.float32)

    def __init__(self, source: ScanSource) -> None:
        self.source, self.frames = source, source.table.views
        if not self.frames.size:
            raise DataError(f"{source.path} has no projections to show: `beamline info` lists the kinds of its frames.")
        self.shape = self.frames.size, *source.shape
        self.dark, self.flat = self._mean(FrameKind.DARK), self._mean(FrameKind.FLAT)
        self._zero = np.zeros(source.shape, np.float32) if self.dark is None else self.dark
        self._light = None if self.flat is None else lit(self.flat, self._zero) - self._zero
        self.light = np.full(self.frames.size, np.nan)
        self.total = np.zeros(source.shape)

    def __getitem__(self, part: slice) -> F32:
        views = read_known(self.source, self.frames[part]).astype(np.float32)
        if self._light is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                views = (views - self._zero) / self._light
        for number, view in zip(np.arange(self.shape[0])[part], views, strict=True):
            if np.isnan(self.light[number]):
                finite = np.isfinite(view)
                self.light[number] = view[finite].mean() if finite.any() else 0.0
                self.total += np.where(finite, view, self.light[number])
        return views

    def _mean(self, kind: FrameKind) -> F32 | None:
        rows = spread(self.source.table.of_kind(kind), _REFERENCES)
        return read_known(self.source, rows).mean(axis=0, dtype=np.float32) if rows.size else None


class ShownScan:
    """An opened scan. All calls must come from one thread (HDF5).

    Attributes:
        stack: the projections of the scan as slices across projections, rows and columns.

    Raises: DataError: the scan has no projections.
    """

    def __init__(self, source: ScanSource) -> None:
        self._source, self._views = source, _OverFlats(source)
        self._scan = select(source, Selection())
        self._degrees = np.degrees(source.table.angles[self._views.frames])
        record = bare_record(source.path, self._views)
        self.stack = ShownVolume(source.path, record=replace(record, parameters={"angles_deg": self._degrees}))
        self._plan: ScanCorrectionPlan | None = None
        self._row, self._beside, self._band = -1, 0, range(0)  # of the rows that are kept
        self._lines, self._ids = np.empty((0, 0, 0), np.float32), np.empty(0, np.int64)

    def close(self) -> None:
        self.stack.close()
        self._source.close()

    def facts(self) -> dict[str, Any]:
        """Facts about the scan for the page: a sentence on format and angles; the kinds of frames that have a mean; the
        mean intensity of each projection so far (null: not read); and two projections about 180 degrees apart, with the
        difference of their angles from 180 degrees (null: the scan has no such pair)."""
        known = self._degrees[np.isfinite(self._degrees)]
        angles = f"{known.min():.2f} to {known.max():.2f} degrees" if known.size else "angles unknown: give --angles"
        over = "shown as stored, because there are no flats" if self._views.flat is None else "over flats"
        return {
            "said": f"{self._source.format}, {known.size} of {self._degrees.size} projections with angles, "
            f"{angles}; {over}",
            "means": [name for name, mean in self._means().items() if mean is not None],
            "light": [float(each) if np.isfinite(each) else None for each in self._views.light],
            "pair": self._pair(),
        }

    def mean(self, kind: str) -> F32:
        """The mean [row, col] of the projections that were read so far, or of the first flats or darks.

        Raises:
            DataError: the scan has no frames of this kind.
        """
        if (mean := self._means().get(kind)) is None:
            raise DataError(f"There are no {kind} to average.")
        return mean

    def axis(self, row: int) -> dict[str, Any]:
        """The axis in columns, from the file or found from one row; a text on its source; and True if the axis may be
        tilted.

        Raises:
            DataError: the projections cannot be corrected, or have no angles.
        """
        self._read(row, 0.0)
        axis, origin, is_cone = (self._source.shape[1] - 1) / 2, "the middle of the detector", self._cone is not None
        if self._source.axis_col is not None:
            axis, origin = self._source.axis_col, "from the file"
        elif not is_cone:
            with suppress(ValueError):
                estimate = find_axis(self._lines, self._source.table.angles[self._ids])
                axis, origin = (
                    estimate.value,
                    f"found from row {row}{'' if estimate.confident else ', not a clear optimum'}",
                )
        return {"axis": round(axis, 2), "said": origin, "leans": not is_cone}

    def fbp(self, row: int, axis_col: float, tilt_deg: float, region: TileRegion, *, fast: bool) -> VolumeTile:
        """A part of the FBP slice of one row, with this axis. `fast`: use fewer projections and larger voxels.

        Raises:
            DataError: as `axis`.
        """
        # imported here, because it loads numba, which slices of projections do not need
        from recon.voxels.direct import direct

        self._read(row, tilt_deg)
        view_stride = max(1, -(-len(self._ids) // _FAST_VIEWS)) if fast else 1
        data, angles = self._lines[::view_stride], self._source.table.angles[self._ids[::view_stride]]
        geometry = self._scan.part(rows=(self._band.start, self._band.stop)).selection.geometry(axis_col, angles)
        whole = Grid.matching(geometry)
        cols, voxel, height = self._source.shape[1], whole.voxel_size, 0.0
        centred = abs(axis_col - (cols - 1) / 2) < _CENTRED * cols
        n = cols if centred else whole.shape[1]  # otherwise the slice would jump with each column
        shown, most_voxels = region.inside((n, n)), _FAST_MOST if fast else _MOST
        ends = (shown.first_row, shown.last_row), (shown.first_col, shown.last_col)
        step = -(-max(last - begin for begin, last in ends) // most_voxels)
        if geometry.is_cone:
            height = (row - (self._source.shape[0] - 1) / 2) * voxel
        else:
            line = self._line(data, row, tilt_deg)[:, : data.shape[2] // step * step]
            data = line.reshape(len(line), 1, -1, step).mean(axis=3)
            binned_axis, pitch = (axis_col - (step - 1) / 2) / step, step * geometry.pixel_pitch
            geometry = Geometry.parallel(angles, data.shape[1:], pixel_pitch=pitch, axis_col=binned_axis)
        ny, nx = (-(-(last - begin) // step) for begin, last in ends)
        y, x = ((begin + (m * step - n) / 2) * voxel for (begin, _), m in zip(ends, (ny, nx), strict=True))
        values = direct(np.ascontiguousarray(data), geometry, Grid((1, ny, nx), step * voxel, (height, y, x)), "hann")
        (top, _), (left, _) = ends
        return VolumeTile(values[0], TileRegion(top, top + ny * step, left, left + nx * step), step, 1.0)

    def _means(self) -> dict[str, F32 | None]:
        seen = int(np.isfinite(self._views.light).sum())
        views = (self._views.total / seen).astype(np.float32) if seen else None
        return {"views": views, "flats": self._views.flat, "darks": self._views.dark}

    def _pair(self) -> tuple[int, int, float] | None:
        known = np.flatnonzero(np.isfinite(self._degrees))
        pair = closest_pair(np.radians(self._degrees[known]), _MISSES) if known.size else None
        if pair is None:
            return None
        one, other = known[list(pair)].tolist()
        return one, other, float((self._degrees[other] - self._degrees[one]) % 360 - 180)

    @property
    def _cone(self) -> tuple[float, float] | None:
        return self._source.cone

    def _read(self, row: int, tilt_deg: float) -> None:
        """Correct the rows that a slice needs, which are kept for the next slices."""
        rows, cols = self._source.shape
        if not 0 <= row < rows:
            raise DataError(f"Row {row} is outside the detector, which has {rows} rows.")
        neighbour_rows = _BESIDE + math.ceil(cols / 2 * math.sin(math.radians(abs(tilt_deg))))
        if row == self._row and neighbour_rows <= self._beside:
            return
        neighbour_rows = 1 << (neighbour_rows - 1).bit_length()  # so that the rows are ready if the slider moves on
        near, far = row - neighbour_rows, row + neighbour_rows
        if (cone := self._cone) is not None:
            middle, half = (rows - 1) / 2, cols / 2 * (self._source.pixel_size_mm or 0.0) / cone[1]
            edges = [middle + (row - middle) / (1 + side * half) for side in (-1, 1)]
            near, far = min(near, math.floor(min(edges))), max(far, math.ceil(max(edges)))
        frames = self._views.frames[np.isfinite(self._degrees)]
        if not frames.size:
            raise DataError(f"Give --angles FILE: a slice needs angles, and {self._source.path} states none.")
        chosen = spread_views(self._source.table.angles[frames], _VIEWS, frames)
        band = range(max(near, 0), min(far + 1, rows))
        try:
            self._plan = self._plan or survey(self._scan, chosen)
            corrected = apply(self._plan, chosen, slice(band.start, band.stop))
        except ValueError as error:
            raise DataError(f"The projections cannot be corrected: {error}.") from error
        self._lines, self._ids = corrected.data, corrected.view_ids
        self._row, self._beside, self._band = row, neighbour_rows, band

    def _line(self, data: F32, row: int, tilt_deg: float) -> F32:
        """The row [view, col] of the projections after rotation by the tilt, with linear interpolation between
        pixels."""
        if not tilt_deg:
            return data[:, row - self._band.start]
        turned = TiltAndLens(tilt_deg).of(self._scan)
        assert turned is not None
        (rows,), (cols,) = turned.positions((1, data.shape[2]), row)
        rows, cols = np.clip(rows - self._band.start, 0, data.shape[1] - 1), np.clip(cols, 0, data.shape[2] - 1)
        r, c = (
            np.minimum(positions, n - 2).astype(int) for positions, n in ((rows, data.shape[1]), (cols, data.shape[2]))
        )
        down, across = (rows - r).astype(np.float32), (cols - c).astype(np.float32)
        upper, lower = ((1 - across) * data[:, k, c] + across * data[:, k, c + 1] for k in (r, r + 1))
        return np.asarray((1 - down) * upper + down * lower)
