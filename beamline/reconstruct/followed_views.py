"""Projections of a growing file: which frames they are, their geometry, and how many of them the fit has used."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum, auto

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.events import Sink
from beamline.core.recon_events import LawMeasured
from beamline.core.sinks import Warnings
from beamline.projections.axis import locate_axis, stated_axis
from beamline.projections.correction import ScanCorrection
from beamline.projections.corrections.preparation import Preparation
from beamline.projections.corrections.width import Width
from beamline.projections.selection import ScanSelection
from beamline.projections.step import StepDone
from beamline.projections.usable_views import UsableViews, usable_views
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.evidence import ScanEvidence
from drivers.base.clock import Clock
from drivers.base.frame import FrameKind
from recon.base.geometry import Geometry
from recon.base.views import parse_views
from recon.prep.align import AxisEstimate
from recon.prep.projections import Projections
from recon.voxels.measured_law import measured_law


class FollowState(Enum):
    """State of the fit of a running scan."""

    WAITS_FOR_REFERENCES = auto()
    WAITS_FOR_AXIS = auto()
    FEEDS = auto()
    ENDED = auto()


@dataclass(frozen=True, eq=False)
class Cursor:
    """Progress of the fit in a growing file.

    Attributes:
        frames: number of frames in the file when it was last read.
        taken: number of these frames that were corrected, or that are not projections.
        part: the part of the file whose projections were corrected last.
        batches: line integrals of the projections with their final correction, from which the volume grows.
        newest: the projection after them. The fit uses it already, but it is corrected again together with the next
            one.
    """

    frames: int = 0
    taken: int = 0
    part: int = 0
    batches: tuple[Projections, ...] = ()
    newest: Projections | None = None

    @property
    def behind(self) -> bool:
        """Whether the file has frames that the fit has not read yet."""
        return self.taken < self.frames

    @property
    def view_ids(self) -> NDArray[np.int64]:
        """Rows in the file of the projections in `batches`."""
        return np.concatenate([batch.view_ids for batch in self.batches])


@dataclass(frozen=True, eq=False)
class FollowedViews:
    """The selected projections of a scan file that is still growing."""

    source: ScanSource
    selection: ScanSelection

    @property
    def n(self) -> int:
        """Number of projections in the file, including flagged ones."""
        return self.source.table.views.size

    def usable(self) -> UsableViews:
        """The projections in the file that may be used."""
        return usable_views(ScanEvidence(self.source), self.selection.step(Preparation).uses_flags)

    def chosen(self, frames: NDArray[np.int64]) -> NDArray[np.int64]:
        """Those of these frames that the selection uses. It selects by the index among all projections so far, which
        does not change when later ones arrive.
        """
        taken = self.source.table.of_kind(FrameKind.PROJECTION, FrameKind.INVALID)
        chosen = parse_views(self.selection.views, np.zeros(taken.size))
        return frames[np.isin(frames, taken[chosen])]

    def geometry(self, axis_col: float, view_ids: NDArray[np.int64]) -> tuple[Geometry, StepDone]:
        """The geometry of these projections with the width of their rays, and what the step for it did."""
        geometry = self.selection.geometry(axis_col, self.source.table.angles[view_ids])
        return self.selection.step(Width).rays(self.source, self.selection, geometry)

    def angles(self, axis_col: float, view_ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """Angles for the fit [view] in radians, at mid-exposure and for the middle row. The fit ignores motion."""
        geometry, _ = self.geometry(axis_col, view_ids)
        return np.asarray(geometry.angles + geometry.skew * (geometry.detector_shape[0] - 1) / 2)


_FIRST_VIEWS = 12  # fewer projections do not determine an axis
_UNKNOWN = (
    "If you know the rotation axis, use --axis COLUMN, or optics.axis_col in the configuration of later scans. "
    "The projections do not show the axis yet, because the sample is wider than the field of view; after 180° it can "
    "be found. Until then the slices use the middle of the detector as axis, and the volume does not start."
)


class AxisSearch:
    """Repeats the search for the rotation axis each time the number of projections has grown by half, at 90°, at 180°,
    and at the end.

    Attributes:
        col: the axis in pixels of the file; None while it is unknown.
        estimate: how it was found; None if it was given or stated.
        settled: the search is over.
    """

    def __init__(self, source: ScanSource, selection: ScanSelection, warn: Warnings) -> None:
        self._source, self._selection, self._warn = source, selection, warn
        self.col = source.axis_col if selection.axis_col is None else selection.axis_col
        self.estimate: AxisEstimate | None = None
        self.settled = self.col is not None
        self._next, self._turned, self._told = _FIRST_VIEWS, 0.0, False

    def look(self, correction: ScanCorrection, views: NDArray[np.int64], ended: bool) -> None:
        """Search the axis in these projections (rows of the file), if a search is due. While the scan runs, only a
        clear optimum is accepted.

        Raises:
            DataError: the scan has ended, and no axis is found.
        """
        if self._selection.cone is not None:
            self.col, self.settled = stated_axis(self._source), True
            return
        before, self._turned = self._turned, float(np.ptp(self._source.table.angles[views])) * (1 + 1.5 / views.size)
        passed = any(before < turn <= self._turned for turn in (np.pi / 2, np.pi)) and views.size > _FIRST_VIEWS
        if views.size < self._next and not passed and not ended:
            return
        self._next, self.settled = views.size + views.size // 2, ended
        self._search(correction, views, ended)
        if self.col is None and np.pi / 2 <= self._turned < np.pi and not self._told:
            self._told = True
            self._warn(_UNKNOWN)

    def _search(self, correction: ScanCorrection, views: NDArray[np.int64], ended: bool) -> None:
        last_chance = ended and self.col is None
        warn = self._warn if last_chance else lambda sentence: None  # the axis will be searched again
        try:
            axis_col, estimate = locate_axis(correction, views, warn, all_there=ended)
        except DataError:  # the views do not cover enough angles yet
            if last_chance:
                raise
            return
        if estimate.confident or last_chance:
            self.col, self.estimate = axis_col, estimate
            self._warn.withdraw(_UNKNOWN)


_NOISE_FLATS = 8  # at most, which show the noise of a frame
_NO_GAIN = "The improvement by further projections is not predicted"


class PassLaws:
    """Measures at the end of each pass how the error of the volume depends on the number of projections (the law of the
    error), once all usable projections until then are corrected.

    If the next pass ends before the law of a pass is measured, this pass is left out, because only the newest law is
    used.
    """

    def __init__(self, views: FollowedViews, seed: int, sink: Sink, clock: Clock, warn: Warnings) -> None:
        self._views, self._sink, self._clock, self._warn = views, sink, clock, warn
        self._rng = np.random.default_rng(seed)
        self._end = 0  # rows of the file at the end of the last pass whose law was looked for

    def look(self, cursor: Cursor, axis_col: float | None, correction: ScanCorrection | None) -> None:
        """Measure and report the law at the end of the newest pass, unless this was done already.

        The law is measured on ordinary projections. If there are also laterally offset projections, the density outside
        the field of view is known, and the offset of the law is 0. If no law can be measured, a warning gives the
        reason, and an event has the reason instead of the numbers.
        """
        ends = self._views.source.table.pass_ends
        if not ends.size or (end := int(ends[-1])) == self._end:
            return
        references_follow = correction is None and cursor.behind
        if (cursor.frames if references_follow or axis_col is None else cursor.taken) < end:
            return
        self._end = end
        if references_follow or axis_col is None:  # a scan that waits for the law takes no frame that might show it
            missing = "darks or flats have not been taken" if references_follow else "the rotation axis is not known"
            self._no_law(ends.size, 0, f"{missing} yet")
            return
        usable = {row for row in self._views.usable().frames.tolist() if row < end}
        parts = cursor.batches if cursor.newest is None else (*cursor.batches, cursor.newest)
        images = {
            row: image
            for part in parts
            for row, image in zip(part.view_ids.tolist(), part.data, strict=True)
            if row in usable
        }
        rows = np.array([*images], np.int64)
        if not rows.size or correction is None:
            self._no_law(ends.size, 0, "none of the projections can be used")
            return
        views_at_ends = [n for n in np.searchsorted(rows, ends).tolist() if n]
        try:
            geometry, _ = self._views.geometry(axis_col, rows)
            open_beam = correction.open_beam(_NOISE_FLATS)
            law, gained = measured_law(np.stack([*images.values()]), geometry, views_at_ends, self._rng, open_beam)
        except (ValueError, DataError, MemoryError) as error:
            self._no_law(ends.size, rows.size, str(error) or "there is not enough memory")
            return
        if (self._views.source.table.offset_views < end).any() and law.offset < 1:
            law = replace(law, noise=law.noise / (1 - law.offset), offset=0.0)
        self._warn.withdraw(_NO_GAIN)
        self._sink(LawMeasured(ends.size, **vars(law), gained=gained, time=self._clock.now()))

    def _no_law(self, number: int, n_views: int, why: str) -> None:
        self._warn(f"{_NO_GAIN}: {why}.")
        self._sink(
            LawMeasured(number, n_views, math.nan, math.nan, math.nan, math.nan, reason=why, time=self._clock.now())
        )
