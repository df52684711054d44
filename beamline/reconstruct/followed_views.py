"""Followed views: the projections of a growing file, their geometry, and the search for the rotation axis in them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.sinks import Warnings
from beamline.projections.axis import locate_axis, stated_axis
from beamline.projections.correction import ScanCorrectionPlan
from beamline.projections.corrections.width import Width
from beamline.projections.preparation import Preparation
from beamline.projections.selection import SelectedScan
from beamline.projections.step import StepDone
from beamline.projections.usable_views import UsableViews, usable_views
from beamline.storage.readers.base import ScanSource
from drivers.base.frame import FrameKind
from recon.base.geometry import Geometry
from recon.base.views import parse_views
from recon.prep.align import AxisEstimate


@dataclass(frozen=True, eq=False)
class FollowedViews:
    """The selected projections of a scan file that is still growing.

    Attributes:
        scan: the scan as it was when the live fit began; `renewed` has the frames recorded since then.
    """

    scan: SelectedScan

    @property
    def source(self) -> ScanSource:
        """The source that reads the frames."""
        return self.scan.source

    @property
    def n(self) -> int:
        """Number of projections in the file, including flagged ones."""
        return self.source.table.views.size

    def usable(self) -> UsableViews:
        """The projections in the file that may be used."""
        return usable_views(self.scan.renewed().evidence, self.scan.selection.step(Preparation).uses_flags)

    def chosen(self, frames: NDArray[np.int64]) -> NDArray[np.int64]:
        """The frames among `frames` that the selection uses. The selection counts projections from the start of the
        scan, so it selects the same ones when later projections arrive.
        """
        taken = self.source.table.of_kind(FrameKind.PROJECTION, FrameKind.INVALID)
        chosen = parse_views(self.scan.selection.views, np.zeros(taken.size))
        return frames[np.isin(frames, taken[chosen])]

    def geometry(self, axis_col: float, view_ids: NDArray[np.int64]) -> tuple[Geometry, StepDone]:
        """The geometry of these projections with the width of their rays, and what the step for the width did."""
        geometry = self.scan.selection.geometry(axis_col, self.source.table.angles[view_ids])
        return self.scan.selection.step(Width).rays(self.scan, geometry)

    def angles(self, axis_col: float, view_ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """Angles for the fit [view] in radians, at mid-exposure and for the middle row. The fit ignores motion."""
        geometry, _ = self.geometry(axis_col, view_ids)
        return np.asarray(geometry.angles + geometry.skew * (geometry.detector_shape[0] - 1) / 2)


_FIRST_VIEWS = 12  # fewer projections do not determine an axis
_UNKNOWN = (
    "If you know the rotation axis, use --axis COLUMN, or optics.axis_col in the configuration of later scans. The "
    "projections do not show the axis yet, because the sample is wider than the field of view; after 180° the axis "
    "can be found. Until then the slices use the middle of the detector as axis, and no volume is computed."
)


@dataclass(frozen=True)
class AxisSearch:
    """The search for the rotation axis. It is repeated each time the number of projections has grown by half, at 90°,
    at 180°, and at the end.

    Attributes:
        estimate: how the axis was found; None: the axis was not found, or the user or the file stated it.
        settled: the search is over.
        next_views: number of projections with which the next search is due.
        turned: angle in radians that the projections covered at the last search.
        told: True if it was already reported that the axis is unknown.
    """

    estimate: AxisEstimate | None = None
    settled: bool = False
    next_views: int = _FIRST_VIEWS
    turned: float = 0.0
    told: bool = False

    def look(
        self,
        followed: FollowedViews,
        plan: ScanCorrectionPlan,
        views: NDArray[np.int64],
        known: float | None,
        ended: bool,
        warn: Warnings,
    ) -> tuple[AxisSearch, float | None]:
        """Search the axis in these projections if a search is due. While the scan runs, only a clear optimum is
        accepted.

        Args:
            views: rows of the file.
            known: the axis found before; None: no axis was found before.
            ended: True if the scan has ended.

        Returns:
            The search after this call, and the axis in pixels of the file (None as long as it is unknown).

        Raises:
            DataError: the scan has ended, and no axis is found.
        """
        if followed.scan.selection.cone is not None:
            return replace(self, settled=True), stated_axis(followed.source)
        turned = float(np.ptp(followed.source.table.angles[views])) * (1 + 1.5 / views.size)
        passed = any(self.turned < turn <= turned for turn in (np.pi / 2, np.pi)) and views.size > _FIRST_VIEWS
        search = replace(self, turned=turned)
        if views.size < self.next_views and not passed and not ended:
            return search, known
        search = replace(search, next_views=views.size + views.size // 2, settled=ended)
        last_chance = ended and known is None
        try:
            located = locate_axis(plan, views, warn, complete=ended)
        except DataError:  # the projections do not cover enough angles yet
            if last_chance:
                raise
        else:
            if last_chance and located.warning:  # until then, the axis will be searched again
                warn(located.warning)
            if located.estimate.confident or last_chance:
                search, known = replace(search, estimate=located.estimate), located.col
                warn.withdraw(_UNKNOWN)
        if known is None and np.pi / 2 <= turned < np.pi and not self.told:
            search = replace(search, told=True)
            warn(_UNKNOWN)
        return search, known
