"""calibrated: the geometry of a scan's views, learnt from a band of its rows by `recon.calibration`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from beamline.core.errors import DataError
from beamline.projections.correction import ScanCorrection, at_once_memory
from beamline.projections.poses import about, pivot_of
from beamline.projections.protocols import ScanPart
from beamline.projections.selection import Selection, geometry_of, rows_of
from beamline.projections.step import StepDone
from beamline.storage.readers.base import ScanSource
from recon.base.arrays import I64
from recon.base.geometry import Geometry
from recon.base.masks import areas
from recon.calibration.freedom import GeometryChange
from recon.calibration.learn import COLS, ROWS, LearntGeometry, learn_geometry

_COPIES = 24  # float32 copies of the views looked at while their geometry is learnt

Seen = Callable[[Selection, I64], Geometry]


@dataclass(frozen=True, eq=False)
class Calibrated:
    """What was learnt of the geometry of some views.

    Attributes:
        frames: rows of the file, in order.
        change: in pixels of the detector, about the middle row of the band.
        pitch: mm of such a pixel.
        off_middle: rows from the middle of the band to that of the detector, about which views roll and tilt.
        pivot: row of the detector, binned and counted from the first one used, that views are rolled and tilted about.
        binning: of the pixels of the band.
        learnt: with what views held out say of it.
    """

    frames: I64
    change: GeometryChange
    pitch: float
    off_middle: float
    pivot: float
    binning: int
    learnt: LearntGeometry

    @property
    def done(self) -> StepDone:
        return StepDone(self.learnt.said(self.binning), self.learnt.parameters(self.binning))

    @property
    def axis(self) -> float:
        """Displacement of the axis in the detector's middle row, in columns."""
        return self.change.axis + self.off_middle * math.tan(self.change.roll)

    def corrected(self, geometry: Geometry, view_ids: I64) -> Geometry:
        """The geometry of these rows of the file, which may be binned, as it was learnt."""
        at = np.searchsorted(self.frames, view_ids)
        own = replace(self.change, shifts=self.change.shifts[at], axis=self.axis)
        return about(own.scaled(self.pitch / geometry.pixel_pitch).applied(geometry), self.pivot)


def calibrated(
    source: ScanSource,
    selection: Selection,
    frames: I64,
    seen: Seen,
    terms: frozenset[str],
    progress: Callable[[int, int], None],
) -> Calibrated:
    """The geometry of these frames, learnt from a band in the middle of the rows used.

    Args:
        frames: rows of the file, in order.
        seen: the geometry of frames in the rows and with the binning of a selection, as far as it is known.
        progress: how many steps are done, of how many at most.

    Raises:
        DataError: too few views, or nothing in the beam.
    """
    band = _band(source, selection)
    views = ScanCorrection(source, band, lambda _: None).at_once(frames)
    ids = views.view_ids
    before = seen(band, ids)
    known = ~areas(views.masked)
    try:
        learnt = learn_geometry(
            views.data, before, terms, progress, None if known.all() else known.astype(np.float32)
        )  # fmt: skip
    except ValueError as error:
        raise DataError(f"{source.path}: the geometry was not learnt: {error}. Leave out --calibrate.") from error
    looked, middle = rows_of(source, band), (source.shape[0] - 1) / 2
    whole = geometry_of(source, replace(selection, binning=1, rows=None), 0.0, np.zeros(1))
    off = 0.0 if before.is_cone else middle - (looked.start + looked.stop - 1) / 2
    change = learnt.change.scaled(band.binning)
    return Calibrated(ids, change, whole.pixel_pitch, off, pivot_of(source, selection), band.binning, learnt)


def search_memory(part: ScanPart, terms: frozenset[str]) -> int:
    """Bytes that `calibrated` takes at most."""
    if not terms:
        return 0
    band = _band(part.source, part.selection)
    rows, frames = rows_of(part.source, band), part.geometry.n_views
    pixels = (rows.stop - rows.start) * part.source.shape[1] // band.binning**2
    return at_once_memory(part.source, band, frames) + 4 * _COPIES * frames * pixels


def _band(source: ScanSource, selection: Selection) -> Selection:
    """Rows around the middle of those used, with pixels binned so that a volume of them is quick.

    Of the rows around a region it takes those of the whole volume, for which the region is cut out of it.
    """
    used = rows_of(source, replace(selection, rows=selection.axis_rows or selection.rows))
    height = used.stop - used.start
    binning = max(selection.binning, min(math.ceil(source.shape[1] / COLS), height))
    n = min(height, ROWS * binning)
    first = (used.start + used.stop - n) // 2
    return replace(selection, rows=(first, first + n), binning=binning)
