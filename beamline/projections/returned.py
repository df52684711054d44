"""Views that were taken a second time on the way back (alignment frames): by how much the sample has moved since."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beamline.projections.read import read_binned
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.references import groups_of
from drivers.base.frame import FrameKind
from recon.prep.shift import UNKNOWN, ViewShift, shift_between

MOVED = 0.5
"""Pixels: edges are doubled as far as the resolution, as for the monitor's `motion`."""
_SIDE = 512  # pixels of a view, binned, at most: 0.4 s a view
_BESIDE = 0.5  # pixels that the sample's rim may turn between both
_REFERENCES = 8  # darks and flats that are read


@dataclass(frozen=True)
class ReturnedView:
    """A view on the way back, and the sample's displacement since the first one, on the detector.

    Attributes:
        frame, first: rows of both in the file.
        angle: rad.
        across, down: pixels towards higher columns and rows; NaN: not told by the views.
        sigma: pixels, the larger of their uncertainties by noise.
        pixel_mm: edge of a pixel at the rotation axis; None: not known.
    """

    frame: int
    first: int
    angle: float
    across: float
    down: float
    sigma: float
    pixel_mm: float | None

    @property
    def moved(self) -> bool:
        """The sample stands elsewhere than in the first view, by more than `MOVED` pixels."""
        return max(abs(x) for x in (self.across, self.down, 0.0) if math.isfinite(x)) > MOVED

    def in_words(self) -> str:
        """In words."""
        parts = [f"{self._length(x)} {way}" for x, way in ((self.across, "across"), (self.down, "down"))]
        sure = f" (± {self.sigma:.2g} px)" if math.isfinite(self.sigma) else ""
        moved = ", the sample has moved" if self.moved else ""
        pair = f"{round(math.degrees(self.angle), 3) + 0:g}°, frame {self.frame} against {self.first}"
        return f"{pair}: {', '.join(parts)}{sure}{moved}"

    def _length(self, pixels: float) -> str:
        if not math.isfinite(pixels):
            return "not known"
        return f"{pixels:+.2f} px" + ("" if self.pixel_mm is None else f" = {pixels * self.pixel_mm:+.5f} mm")


def returned_views(source: ScanSource) -> list[ReturnedView]:
    """Each view on the way back, compared with the view of its angle; those without one are left out.

    Empty for a scan without darks and flats, and where nobody says what pixels hold.

    Raises:
        DataError: frames cannot be read.
    """
    keys, angles = source.image_key, source.angles
    back, views = (
        np.flatnonzero((keys == kind) & np.isfinite(angles)) for kind in (FrameKind.ALIGNMENT, FrameKind.PROJECTION)
    )
    darks, flats = (groups_of(source, kind) for kind in (FrameKind.DARK, FrameKind.FLAT))
    counts = source.quantity == "counts"
    if not (back.size and views.size) or source.quantity == "unknown" or (counts and not (darks and flats)):
        return []
    binning = max(1, -(-max(source.shape) // _SIDE))

    def read(rows: NDArray[np.int64]) -> NDArray[np.float32]:
        return np.asarray(read_binned(source, rows, slice(0, source.shape[0]), binning), np.float32)

    dark = read(np.concatenate(darks)[:_REFERENCES]).mean(0) if counts else None
    pixel = source.pixel_size_mm
    if pixel is not None and source.cone is not None:
        pixel *= source.cone[0] / source.cone[1]

    def line_integrals(row: int) -> NDArray[np.float32]:
        view = read(np.array([row]))[0]
        if dark is None:
            return view
        light = read(min(flats, key=lambda group: abs(float(np.mean(group)) - row))[:_REFERENCES]).mean(0) - dark
        good = (light > 0) & (view > dark)
        return np.where(good, -np.log(np.where(good, view - dark, 1) / np.where(good, light, 1)), np.nan)

    returned = []
    for row in back.tolist():
        apart = np.abs(np.remainder(angles[views] - angles[row] + np.pi, 2 * np.pi) - np.pi)
        if apart.min() * source.shape[1] / 2 > _BESIDE:
            continue
        first = int(views[apart.argmin()])
        shift = _unbinned(shift_between(line_integrals(first), line_integrals(row)), binning)
        sigma = float(np.fmax(shift.across_sigma, shift.down_sigma))
        returned.append(ReturnedView(row, first, float(angles[row]), shift.across, shift.down, sigma, pixel))
    return returned


def _unbinned(shift: ViewShift, binning: int) -> ViewShift:
    if shift is UNKNOWN or binning == 1:
        return shift
    return ViewShift(*(binning * value for value in (shift.across, shift.down, shift.across_sigma, shift.down_sigma)))
