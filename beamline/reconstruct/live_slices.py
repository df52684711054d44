"""LiveSlices: three slices by FBP of the views of a growing scan, drawn from the eighth view on."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.projections.correction import ScanCorrection
from beamline.reconstruct.followed_views import FollowedViews
from beamline.reconstruct.snapshots import Snapshots
from drivers.base.clock import Clock
from recon.base.views import spread
from recon.prep.correct import Projections
from recon.voxels.slices import orthogonal_slices

_FEWEST, _BEFORE_AXIS = 8, 32  # views; of them, those that are corrected before the axis is known
_WHOLE = 1.0  # degrees of the half turn that may be missing


class LiveSlices:
    """Draws the slices when there are new views and enough time has passed; drawing takes at most half of the time."""

    def __init__(self, views: FollowedViews, snapshots: Snapshots, clock: Clock) -> None:
        self._views, self._snapshots, self._clock = views, snapshots, clock
        self._newest, self._next = -1, -math.inf  # the last view drawn; the time from which they are drawn again

    def draw(self, parts: Sequence[Projections], axis_col: float | None, pause: float | None, of: int = 0) -> None:
        """Draw slices of corrected views about the axis (a column of the file; None: the middle of the detector).

        Views of a cone, or that lean or climb, have no slices.

        Args:
            pause: s until they are drawn again, at least; None: they are drawn now.
            of: number of views so far, of which `parts` holds some; 0: all of them.
        """
        n, begin = sum(part.view_ids.size for part in parts), self._clock.now()
        if n < _FEWEST or (pause is not None and begin < self._next) or int(parts[-1].view_ids[-1]) == self._newest:
            return
        ids = np.concatenate([part.view_ids for part in parts])
        col = (self._views.source.shape[1] - 1) / 2 if axis_col is None else axis_col
        geometry, _ = self._views.geometry(col, ids)
        with suppress(ValueError):
            slices = orthogonal_slices([view for part in parts for view in part.data], geometry)
            count = f"{n} of {of}" if of > n else str(n)
            place = "the middle, not known yet" if axis_col is None else f"column {col:.1f}"
            coverage = _coverage(math.degrees(slices.covered), geometry.angles)
            heading = f"FBP of {count} views so far{coverage}, axis at {place}"
            self._snapshots.write_slices(slices, n, heading)
        end = self._clock.now()
        self._newest, self._next = int(ids[-1]), end + max(pause or 0.0, end - begin)

    def draw_about_middle(self, correction: Callable[[], ScanCorrection], pause: float | None) -> None:
        """Draw slices before the axis is known, of some of the views, corrected for this alone."""
        views = self._views.chosen(self._views.usable().frames)
        early = pause is not None and self._clock.now() < self._next
        if views.size < _FEWEST or early or int(views[-1]) == self._newest:
            return
        with suppress(DataError):  # views without light, say: the scan goes on, and so does the fit
            self.draw([correction().at_once(spread(views, _BEFORE_AXIS))], None, pause, views.size)


def _coverage(degrees: float, angles: NDArray[np.float64]) -> str:
    """What a heading says where the views leave a wedge out."""
    if degrees > 180 - max(_WHOLE, 1.5 * degrees / angles.size):
        return ""
    steps = np.diff(angles)
    order = "sequential: " if (steps > 0).all() or (steps < 0).all() else ""
    return f", {order}{degrees:.0f} of 180 degrees so far"
