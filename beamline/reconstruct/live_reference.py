"""Live pictures of a scan with a reference: FBP of the projections so far, and the moved reference plus FBP of the
residual.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np

from beamline.core.errors import DataError
from beamline.core.sinks import Warnings
from beamline.projections.correction import apply, survey
from beamline.reconstruct.followed_views import AxisSearch, FollowedViews
from beamline.reconstruct.snapshots import FEWEST, LiveSlices, Snapshots
from beamline.report.live_picture import PictureRow, reference_row
from drivers.base.clock import Clock
from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.method import Method, Preview
from recon.base.view_data import Views
from recon.base.views import spread

# largest number of columns and of rows of the picture; its rows are as wide as the binned columns
_SIDE, _ROWS = 256, 8
_MOST_VIEWS = 180  # largest number of projections that are corrected for a picture


class ReferencePictures:
    """Draws pictures of a running scan whose method needs all projections, and so waits for the end of the scan.

    Args:
        snapshots: the file of the picture.
    """

    def __init__(
        self, views: FollowedViews, method: Method, snapshots: Snapshots, clock: Clock, warn: Warnings
    ) -> None:
        self._views, self._warn = views, warn
        self._slices = LiveSlices(views, snapshots, clock, row_of(method.preview, snapshots.unit))
        self._search, stated = AxisSearch(), views.scan.selection.axis_col
        self._axis = views.source.axis_col if stated is None else stated

    def draw(self, pause: float | None) -> None:
        """Draw the projections so far, if there are new ones, and `pause` s and the time that the last drawing took
        have passed. None: the scan has ended, so draw now.
        """
        views = self._views.chosen(self._views.usable().frames)
        if views.size < FEWEST or not self._slices.due(views, pause):
            return
        with suppress(DataError):  # for example, flats are not taken yet; the scan and the reconstruction continue
            plan = survey(self._views.scan.renewed())
            if self._axis is None or self._search.estimate is not None:
                self._search, self._axis = self._search.look(
                    self._views, plan, views, self._axis, pause is None, self._warn
                )
            lines = apply(plan, spread(views, _MOST_VIEWS))
            self._slices.draw([lines], self._axis, pause, views.size)


def row_of(
    preview: Callable[[Views], Preview | None], unit: str
) -> Callable[[Sequence[F32], Geometry], PictureRow | None]:
    """A function that makes one row of a picture: the preview of projections. It returns None if there is no
    preview.
    """

    def row(views: Sequence[F32], geometry: Geometry) -> PictureRow | None:
        shown = preview(middle_of(views, geometry))
        return None if shown is None else reference_row(shown, len(views), unit)

    return row


def middle_of(views: Sequence[F32], geometry: Geometry) -> Views:
    """The middle rows of projections, binned to at most 256 columns."""
    rows, cols = geometry.detector_shape
    factor = min(math.ceil(cols / _SIDE), rows)
    n_rows = min(rows, _ROWS * factor)
    first = (rows - n_rows) // 2
    part = geometry.rows(first, first + n_rows).binned(factor)
    n, m = part.detector_shape
    data = np.stack([np.asarray(view[first : first + n * factor, : m * factor], np.float32) for view in views])
    return Views(data.reshape(len(data), n, factor, m, factor).mean((2, 4)), part)
