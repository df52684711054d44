"""AxisSearch: finds the rotation axis of a growing scan from its views so far."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.sinks import Warnings
from beamline.projections.axis import locate_axis, stated_axis
from beamline.projections.correction import ScanCorrection
from beamline.projections.selection import Selection, cone_of
from beamline.storage.readers.base import ScanSource
from recon.prep.align import AxisEstimate

_FIRST_VIEWS = 12  # fewer views do not determine an axis


class AxisSearch:
    """Looks for the axis each time the views have grown by half, and once more when all are there.

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
        self._next = _FIRST_VIEWS

    def look(self, correction: ScanCorrection, views: NDArray[np.int64], ended: bool) -> None:
        """Look for the axis in these views (frames of the file), if it is time. While views come, only a clear optimum
        counts.

        Raises:
            DataError: the scan has ended, and no axis is found.
        """
        if cone_of(self._source, self._selection) is not None:
            self.col, self.settled = stated_axis(self._source), True
            return
        if views.size < self._next and not ended:
            return
        self._next, self.settled = views.size + views.size // 2, ended
        last_chance = ended and self.col is None
        try:
            told = self._warn if last_chance else _quiet
            axis_col, estimate = locate_axis(self._source, correction, views, told, all_there=last_chance)
        except DataError:
            if last_chance:
                raise
            return  # the views do not cover enough angles yet
        if estimate.confident or last_chance:
            self.col, self.estimate = axis_col, estimate


def _quiet(text: str) -> None:
    """Hides warnings on an axis that will be searched again."""
