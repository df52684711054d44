"""Enough views: predicts, while a scan is followed, the gain by further views, and whether the goal is met."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from beamline.projections.selection import Selection, cone_of, geometry_of
from beamline.storage.readers.base import ScanSource
from drivers.base.frame import FrameKind
from recon.base.geometry import Geometry
from recon.base.views import parse_views
from recon.voxels.enough_views import Gain, Goal, predicted_gains, well_spread

GROWTH = 1.25  # growth of the views between predictions
_FIRST, _SAMPLES = 24, 2  # views of the first look; predictions a look


class NotPlannedError(Exception):
    """The further views are unknown; the message says why."""


def planned_views(
    source: ScanSource, selection: Selection, axis_col: float | None, taken: Sequence[NDArray[np.int64]]
) -> Geometry:
    """Geometry of the views so far and of the further views in the plan.

    Args:
        taken: frames of the views so far, in batches.

    Raises:
        NotPlannedError: the beam is a cone, or the file says no plan.
    """
    if cone_of(source, selection) is not None:
        raise NotPlannedError("its beam is a cone")
    if source.part_starts.size > 1:
        raise NotPlannedError("it goes on with a run that ended early, so that views come out of their order")
    angles = source.plan.get("angles_deg")
    if angles is None or axis_col is None:
        raise NotPlannedError("its file does not say which views are planned")
    places = parse_views(selection.views, np.zeros(len(angles)))
    last = max(int(ids[-1]) for ids in taken)
    n_taken = int(np.isin(source.image_key[: last + 1], (FrameKind.PROJECTION, FrameKind.INVALID)).sum())
    to_come = np.radians(np.asarray(angles, np.float64)[places[places >= n_taken]])
    so_far = [source.angles[ids] for ids in taken]
    return geometry_of(source, selection, axis_col, np.concatenate([*so_far, to_come]))


class EnoughViews:
    """Looks at the views each time they have grown by a quarter.

    A prediction scatters by about half a decibel, so each one uses the samples of two. The earlier samples are larger,
    which errs on the side of more views.
    """

    def __init__(self, goal: Goal, seed: int) -> None:
        self._goal = goal
        self._rng = np.random.default_rng(seed)
        self._samples: list[float] = []
        self.next_look = _FIRST

    def look(self, data: NDArray[np.float32], planned: Geometry) -> Gain | None:
        """The gain by the further views; None if it is not (yet) known.

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
        """Whether the views so far are enough."""
        return self._goal.met(gain)
