"""Followed views: which frames of a growing file are views, how far the fit has taken them, and their geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beamline.projections.corrections.flags import Flags, usable_views
from beamline.projections.selection import Selection, geometry_of
from beamline.projections.step import StepDone
from beamline.projections.usable_views import UsableViews
from beamline.projections.view_geometry import with_rays
from beamline.storage.readers.base import ScanSource
from drivers.base.frame import FrameKind
from recon.base.geometry import Geometry
from recon.base.views import parse_views
from recon.prep.correct import Projections


@dataclass(frozen=True, eq=False)
class Cursor:
    """How far the fit has come in the file.

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
        """The file has frames that were not taken yet."""
        return self.taken < self.frames

    @property
    def n_corrected(self) -> int:
        """Views in `batches`."""
        return sum(batch.view_ids.size for batch in self.batches)

    @property
    def view_ids(self) -> NDArray[np.int64]:
        """Frames of the file of the views in `batches`."""
        return np.concatenate([batch.view_ids for batch in self.batches])


@dataclass(frozen=True, eq=False)
class FollowedViews:
    """The views of a scan file that still grows, as the selection takes them."""

    source: ScanSource
    selection: Selection

    def usable(self) -> UsableViews:
        """Those that are in the file and may be used."""
        return usable_views(self.source, self.selection.step(Flags).used)

    def chosen(self, frames: NDArray[np.int64]) -> NDArray[np.int64]:
        """The frames of the selection among these, by their place among all views taken, which later ones keep."""
        taken = np.flatnonzero(np.isin(self.source.image_key, (FrameKind.PROJECTION, FrameKind.INVALID)))
        chosen = parse_views(self.selection.views, np.zeros(taken.size))
        return frames[np.isin(frames, taken[chosen])]

    def template(self, axis_col: float) -> Geometry:
        """The geometry of one view at 0 rad, with the axis in this column of the full detector."""
        return geometry_of(self.source, self.selection, axis_col, np.zeros(1))

    def geometry(self, axis_col: float, view_ids: NDArray[np.int64]) -> tuple[Geometry, dict[str, StepDone]]:
        """The geometry of views with the motion of the stage in their exposures, and what its steps did, by name."""
        geometry = geometry_of(self.source, self.selection, axis_col, self.source.angles[view_ids])
        return with_rays(self.source, self.selection, geometry)

    def angles(self, axis_col: float, view_ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """[view] radians for the fit: in the middle of the exposure, of the middle row. The fit knows no motion."""
        geometry, _ = self.geometry(axis_col, view_ids)
        return np.asarray(geometry.angles + geometry.skew * (geometry.detector_shape[0] - 1) / 2)
