"""Followed views: which frames of a growing file are views, their geometry, and how far the fit has come with them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.events import EnoughReached, Sink, StateEntered
from beamline.core.sinks import Warnings
from beamline.projections.axis import locate_axis, stated_axis
from beamline.projections.correction import ScanCorrection
from beamline.projections.corrections.preparation import Preparation
from beamline.projections.corrections.width import Width
from beamline.projections.selection import Selection, cone_of, geometry_of
from beamline.projections.step import StepDone
from beamline.projections.usable_views import UsableViews, usable_views
from beamline.storage.readers.base import ScanSource
from drivers.base.clock import Clock
from drivers.base.frame import FrameKind
from recon.base.geometry import Geometry
from recon.base.views import parse_views
from recon.prep.align import AxisEstimate
from recon.prep.correct import Projections
from recon.voxels.enough_views import Gain, Goal, predicted_gains, well_spread


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
        frames: in the file at the last look.
        taken: of them, those that were corrected, or are not views.
        part: of the file, whose views were corrected last.
        batches: line integrals of the views that are corrected for good: what the volume grows from.
        newest: the view after them, provisional: it is in the fit already, and is corrected again with the next one.
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
    def n_corrected(self) -> int:
        """Number of views in `batches`."""
        return sum(batch.view_ids.size for batch in self.batches)

    @property
    def view_ids(self) -> NDArray[np.int64]:
        """Rows of the file of the views in `batches`."""
        return np.concatenate([batch.view_ids for batch in self.batches])


@dataclass(frozen=True, eq=False)
class FollowedViews:
    """The selected views of a scan file that is still growing."""

    source: ScanSource
    selection: Selection

    @property
    def n(self) -> int:
        """Number of views in the file, flagged ones included."""
        return int(np.sum(self.source.image_key == FrameKind.PROJECTION))

    def usable(self) -> UsableViews:
        """The views in the file that may be used."""
        return usable_views(self.source, self.selection.step(Preparation).uses_flags)

    def chosen(self, frames: NDArray[np.int64]) -> NDArray[np.int64]:
        """Which of these frames the selection uses, by their index among all views so far, which later views do not
        change.
        """
        taken = np.flatnonzero(np.isin(self.source.image_key, (FrameKind.PROJECTION, FrameKind.INVALID)))
        chosen = parse_views(self.selection.views, np.zeros(taken.size))
        return frames[np.isin(frames, taken[chosen])]

    def template(self, axis_col: float) -> Geometry:
        """The geometry of one view at 0 rad, with the axis in this column of the full detector."""
        return geometry_of(self.source, self.selection, axis_col, np.zeros(1))

    def geometry(self, axis_col: float, view_ids: NDArray[np.int64]) -> tuple[Geometry, StepDone]:
        """The geometry of views with the width of their rays, and what was done about that."""
        geometry = geometry_of(self.source, self.selection, axis_col, self.source.angles[view_ids])
        return self.selection.step(Width).rays(self.source, self.selection, geometry)

    def angles(self, axis_col: float, view_ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """[view] radians for the fit: mid-exposure, middle row. The fit ignores motion."""
        geometry, _ = self.geometry(axis_col, view_ids)
        return np.asarray(geometry.angles + geometry.skew * (geometry.detector_shape[0] - 1) / 2)


_FIRST_VIEWS = 12  # fewer views do not determine an axis
_UNKNOWN = (
    "These views do not show the rotation axis yet: that of a sample wider than the field is known after half a turn. "
    "Until then slices are about the middle of the detector, and no volume begins. --axis COLUMN gives the axis now; "
    "optics.axis_col in the configuration states it in the files of later scans."
)


class AxisSearch:
    """Repeats the search for the rotation axis each time the views have grown by half, at a quarter of a turn, at half
    a turn, and at the end.

    Attributes:
        col: the axis in pixels of the file; None while it is unknown.
        estimate: how it was found; None if it was given or stated.
        settled: the search is over.
    """

    def __init__(self, source: ScanSource, selection: Selection, warn: Warnings) -> None:
        self._source, self._selection, self._warn = source, selection, warn
        self.col = source.axis_col if selection.axis_col is None else selection.axis_col
        self.estimate: AxisEstimate | None = None
        self.settled = self.col is not None
        self._next, self._turned, self._told = _FIRST_VIEWS, 0.0, False

    def look(self, correction: ScanCorrection, views: NDArray[np.int64], ended: bool) -> None:
        """Search the axis in these views (rows of the file), if it is time. While the scan runs, only a clear optimum
        counts.

        Raises:
            DataError: the scan has ended, and no axis is found.
        """
        if cone_of(self._source, self._selection) is not None:
            self.col, self.settled = stated_axis(self._source), True
            return
        before, self._turned = self._turned, float(np.ptp(self._source.angles[views])) * (1 + 1.5 / views.size)
        passed = any(before < turn <= self._turned for turn in (np.pi / 2, np.pi)) and views.size > _FIRST_VIEWS
        if views.size < self._next and not passed and not ended:
            return
        self._next, self.settled = views.size + views.size // 2, ended
        self._search(correction, views, ended and self.col is None)
        if self.col is None and np.pi / 2 <= self._turned < np.pi and not self._told:
            self._told = True
            self._warn(_UNKNOWN)

    def _search(self, correction: ScanCorrection, views: NDArray[np.int64], last_chance: bool) -> None:
        warn = self._warn if last_chance else lambda sentence: None  # the axis will be searched again
        try:
            axis_col, estimate = locate_axis(self._source, correction, views, warn, all_there=last_chance)
        except DataError:  # the views do not cover enough angles yet
            if last_chance:
                raise
            return
        if estimate.confident or last_chance:
            self.col, self.estimate = axis_col, estimate


GROWTH = 1.25  # growth of the views between predictions
_FIRST, _SAMPLES = 24, 2  # views of the first look; predictions a look


def planned_views(
    source: ScanSource, selection: Selection, axis_col: float | None, taken: Sequence[NDArray[np.int64]]
) -> Geometry:
    """Geometry of the views so far and of those still to come by the plan.

    Args:
        taken: frames of the views so far, in batches.

    Raises:
        ValueError: the beam is a cone, or the file says no plan.
    """
    if cone_of(source, selection) is not None:
        raise ValueError("its beam is a cone")
    if source.part_starts.size > 1:
        raise ValueError("it resumes a run that ended early, so that its views are not in the planned order")
    angles = source.plan.get("angles_deg")
    if angles is None or axis_col is None:
        raise ValueError("its file does not state the planned views")
    places = parse_views(selection.views, np.zeros(len(angles)))
    last = max(int(ids[-1]) for ids in taken)
    n_taken = int(np.isin(source.image_key[: last + 1], (FrameKind.PROJECTION, FrameKind.INVALID)).sum())
    to_come = np.radians(np.asarray(angles, np.float64)[places[places >= n_taken]])
    so_far = [source.angles[ids] for ids in taken]
    return geometry_of(source, selection, axis_col, np.concatenate([*so_far, to_come]))


class EnoughViews:
    """Predicts the gain of further views each time the views have grown by a quarter.

    A prediction scatters by about half a decibel, so each one uses the samples of two. The earlier samples are larger,
    which errs on the side of more views.
    """

    def __init__(self, goal: Goal, seed: int) -> None:
        self._goal = goal
        self._rng = np.random.default_rng(seed)
        self._samples: list[float] = []
        self.next_look = _FIRST

    def look(self, data: NDArray[np.float32], planned: Geometry) -> Gain | None:
        """The predicted gain of further views; None if it is unknown.

        Args:
            data: line integrals [view, row, col] so far.
            planned: geometry of these views and of those to come.
        """
        n = len(data)
        if not self.next_look <= n < planned.n_views or not well_spread(planned.angles[:n]):
            return None
        self.next_look = math.ceil(GROWTH * n)
        before = self._samples
        try:
            self._samples = predicted_gains(data, planned, self._rng, _SAMPLES)
        except ValueError:  # views without matter
            return None
        return Gain.of(n, planned.n_views, before + self._samples) if before else None

    def met(self, gain: Gain) -> bool:
        """Whether the views so far suffice."""
        return self._goal.met(gain)


def report_gain(
    enough: EnoughViews,
    views: FollowedViews,
    taken: Sequence[NDArray[np.int64]],
    data: NDArray[np.float32],
    axis_col: float | None,
    sink: Sink,
    clock: Clock,
    warn: Warnings,
) -> bool:
    """Report the gain of further views, and whether those so far suffice. Returns False if nothing further can be
    asked.

    Args:
        taken: frames of the views so far, in batches.
        data: their line integrals [view, row, col].
    """
    try:
        planned = planned_views(views.source, views.selection, axis_col, taken)
    except ValueError as error:
        warn(f"The gain of further views cannot be predicted: {error}. The scan is not stopped early.")
        return False
    gain = enough.look(data, planned)
    if gain is None:
        return True
    if enough.met(gain):
        sink(EnoughReached(**vars(gain), time=clock.now()))
        return False
    spread = f"{gain.mean:.2f} dB ({gain.low:.2f} to {gain.high:.2f})"
    message = f"{gain.n_views} of {gain.planned} views; the others would add {spread}"
    sink(StateEntered("gain", message, gain, time=clock.now()))
    return True
