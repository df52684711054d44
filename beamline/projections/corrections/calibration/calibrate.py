"""Calibration: finds the geometry and the pixel sensitivities from the projections."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from beamline.core.errors import DataError
from beamline.projections.selection import SelectedScan, with_pivot
from beamline.projections.step import StepDone, StepMemory, option
from recon.base.registry import unknown

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from beamline.projections.prepared import PreparedProjections
    from beamline.projections.protocols import ScanPart
    from recon.base.arrays import I64
    from recon.base.geometry import Geometry
    from recon.features.calibration.joint import GeometryChange
    from recon.features.calibration.learn import LearntGeometry

    Progress = Callable[[int, int], None]
    GeometryOf = Callable[[SelectedScan, I64], Geometry]

GEOMETRY = "axis", "roll", "tilt", "shifts"
GAINS = "gains"  # the only term that changes line integrals and not the geometry
_COPIES = 24  # number of float32 copies of the projections while their geometry is determined


def _terms(text: str) -> tuple[str, ...]:
    """Parse the option: a list of terms without "none", in the order of their calibration."""
    names = [name.strip() for name in text.split(",")]
    if names == ["none"]:
        return ()
    all_terms = *GEOMETRY, GAINS
    if others := [name for name in names if name not in all_terms]:
        raise ValueError(unknown("term", others[0], all_terms))
    return tuple(name for name in all_terms if name in names)


@dataclass(frozen=True)
class Calibrate:
    """Selects the terms of the geometry that are found from the projections, and whether pixel sensitivities are.

    Attributes:
        terms: names of the terms; empty: nothing is calibrated.
    """

    name: ClassVar[str] = "calibrate"
    requested_by: ClassVar[str] = "--calibrate"
    follows: ClassVar[tuple[str, ...]] = ("jumps", "poses", "background")
    terms: tuple[str, ...] = option(
        "--calibrate",
        "none",
        "Find geometry errors from the projections and correct these errors. Give one or more parameters, separated "
        "by commas: axis (column of the rotation axis), roll (tilt of the axis in the detector's plane), tilt (tilt "
        "of the axis along the beam), shifts (of each projection), gains (pixel sensitivity). Projections are not "
        "resampled. A parameter changes only if the held-out projections agree better with the new value.",
        parse=_terms,
        metavar="LIST",
    )

    @property
    def geometry(self) -> frozenset[str]:
        """The calibrated terms that change the geometry."""
        return frozenset(self.terms).intersection(GEOMETRY)

    @property
    def may_roll_or_tilt(self) -> bool:
        """True if the calibration may find a roll or tilt of the projections: a detector row then shows several
        slices.
        """
        return not self.geometry.isdisjoint({"roll", "tilt"})

    @property
    def needs_finished(self) -> str:
        return "--calibrate needs a finished scan, because it uses all projections." if self.terms else ""

    def memory(self, part: ScanPart) -> StepMemory:
        if not self.terms:  # avoids loading the calibration
            return StepMemory()
        from recon.features.calibration.gains import gains_memory

        gains_bytes = gains_memory(part.geometry) if GAINS in self.terms else 0
        return StepMemory(alone=max(_search_memory(part, self.geometry), gains_bytes))

    def refuse_few(self, used: int, usable: int, cols: int) -> None:
        """Raise DataError for terms that need more projections, or more binned columns, than the scan has."""
        if not self.terms:
            return
        from recon.features.calibration import gains
        from recon.features.calibration.learn import LEAST_VIEWS

        for term in self.terms:
            least_views, least_cols, n_views = LEAST_VIEWS, 1, usable
            if term == GAINS:
                least_views, least_cols, n_views = gains.LEAST_VIEWS, gains.LEAST_COLS, used
            if n_views < least_views or cols < least_cols:
                raise DataError(
                    f"Omit --calibrate {term}: the scan has {n_views} projections of {cols} columns, and "
                    f"{term} needs {least_views} projections of {least_cols} columns. Nothing was read."
                )

    def learn(
        self,
        scan: SelectedScan,
        frames: NDArray[np.int64],
        geometry_before: GeometryOf,
        progress: Callable[[int, int], None],
    ) -> Calibrated:
        """Calibrate the geometry of these frames with the terms of this step."""
        return calibrated(scan, frames, geometry_before, self.geometry, progress)

    def apply(
        self, views: PreparedProjections, angles: NDArray[np.float64], progress: Callable[[int, int], None]
    ) -> StepDone:
        if not self.terms:
            return StepDone(parameters={})
        done = [views.origin.done[self.name]] if self.name in views.origin.done else []
        if GAINS in self.terms:
            done.append(without_learnt_gains(views, progress))
        sentence = " ".join(each.sentence for each in done if each.sentence)
        values = {key: value for each in done for key, value in (each.parameters or {}).items()}
        return StepDone(sentence, {"calibrate": ",".join(self.terms), "calibrate_said": sentence, **values})


@dataclass(frozen=True, eq=False)
class Calibrated:
    """The calibrated geometry of some projections.

    Attributes:
        frames: rows of the file, in order.
        change: the calibrated change of the geometry, in pixels of the detector, about the middle row of the band.
        pitch: size of such a pixel in mm.
        off_middle: rows from the middle of the band to the middle of the detector, about which projections roll and
            tilt.
        pivot: row of the detector about which projections are rolled and tilted, binned and counted from the first
            one used.
        binning: binning of the pixels of the band.
        learnt: the calibration, with the residuals in held-out projections.
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
        return StepDone(self.learnt.in_words(self.binning), self.learnt.parameters(self.binning))

    @property
    def axis(self) -> float:
        """Displacement of the axis in the detector's middle row, in columns."""
        return self.change.axis + self.off_middle * math.tan(self.change.roll)

    def corrected(self, geometry: Geometry, view_ids: I64) -> Geometry:
        """The calibrated geometry of these rows of the file, which may be binned."""
        index = np.searchsorted(self.frames, view_ids)
        change = replace(self.change, shifts=self.change.shifts[index], axis=self.axis)
        return with_pivot(change.scaled(self.pitch / geometry.pixel_pitch).applied(geometry), self.pivot)


def calibrated(
    scan: SelectedScan,
    frames: I64,
    geometry_before: GeometryOf,
    terms: frozenset[str],
    progress: Callable[[int, int], None],
) -> Calibrated:
    """Calibrate the geometry of these frames from a band in the middle of the rows used.

    Args:
        frames: rows of the file, in order.
        geometry_before: the geometry of frames of a part of the scan, with its rows and binning, before calibration.
        progress: function that gets the number of steps done and the largest number of steps.

    Raises:
        DataError: there are too few projections, or no sample is in the beam.
    """
    from beamline.projections.correction import line_integrals_of
    from recon.base.masks import areas
    from recon.features.calibration.learn import learn_geometry

    source, selection, band = scan.source, scan.selection, _band(scan)
    views = line_integrals_of(band, frames)
    ids = views.view_ids
    geometry = geometry_before(band, ids)
    measured = ~areas(views.masked)
    try:
        learnt = learn_geometry(
            views.data, geometry, terms, progress, None if measured.all() else measured.astype(np.float32)
        )  # fmt: skip
    except ValueError as error:
        raise DataError(f"{source.path}: the geometry could not be calibrated: {error}. Omit --calibrate.") from error
    band_rows, middle = band.selection.detector_rows, (source.shape[0] - 1) / 2
    unbinned = replace(selection, binning=1, rows=None).geometry(0.0, np.zeros(1))
    off_middle = 0.0 if geometry.is_cone else middle - (band_rows.start + band_rows.stop - 1) / 2
    change = learnt.change.scaled(band.selection.binning)
    return Calibrated(ids, change, unbinned.pixel_pitch, off_middle, selection.pivot, band.selection.binning, learnt)


def _search_memory(part: ScanPart, terms: frozenset[str]) -> int:
    """Largest memory in bytes that `calibrated` needs."""
    if not terms:
        return 0
    from beamline.projections.correction import at_once_memory

    band = _band(part.scan)
    rows, frames = band.selection.detector_rows, part.geometry.n_views
    pixels = (rows.stop - rows.start) * band.source.shape[1] // band.selection.binning**2
    return at_once_memory(band, frames) + 4 * _COPIES * frames * pixels


def _band(scan: SelectedScan) -> SelectedScan:
    """The scan with rows around the middle of the rows used, binned so that a volume is reconstructed quickly.

    For a region of interest, the rows around it are those of the whole volume, and the region is cut out.
    """
    from recon.features.calibration.learn import COLS, ROWS

    selection = scan.selection
    used = replace(selection, rows=selection.axis_rows or selection.rows).detector_rows
    height = used.stop - used.start
    binning = max(selection.binning, min(math.ceil(scan.source.shape[1] / COLS), height))
    n = min(height, ROWS * binning)
    first = (used.start + used.stop - n) // 2
    return scan.part(rows=(first, first + n), binning=binning)


def without_learnt_gains(views: PreparedProjections, progress: Progress) -> StepDone:
    """Correct the projections for pixel sensitivities if held-out projections confirm them, see `learn_gains`."""
    from recon.features.calibration.gains import NEAR_AXIS, learn_gains

    try:
        learnt = learn_gains(views.seen.data, views.geometry, views.sources.measured, progress)
    except ValueError as error:
        raise DataError(f"--calibrate gains: {error}. Omit --calibrate gains, or give --rings instead.") from error
    values = {"learnt_gains_held_out_before": learnt.without, "learnt_gains_held_out_after": learnt.with_gains}
    judged = (
        f"the residual in held-out projections is {learnt.without:.4g} without the correction and "
        f"{learnt.with_gains:.4g} with the correction"
    )
    if learnt.without == 0:
        judged = "the projections show no stripes that come from the detector"
    if not learnt.confirmed:
        sentence = f"Pixel sensitivities were not corrected: {judged}."
        return StepDone(sentence, {"learnt_gains": sentence, **values})
    for view in views.lines.data:
        view -= learnt.pixels
    spread = float(learnt.pixels.std())
    sentence = (
        f"Pixel sensitivities were corrected by {spread:.4f} in line integral (standard deviation); {judged}. "
        f"Columns within {NEAR_AXIS:g} of the axis were not corrected, because a wrong sensitivity there looks like "
        "an object on the axis."
    )
    return StepDone(sentence, {"learnt_gains": sentence, "learnt_gains_of_pixels": learnt.pixels, **values})
