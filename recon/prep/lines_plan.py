"""LinesPlan: replaces a `CorrectionPlan` if the projections are already line integrals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.base.arrays import Mask
from recon.prep.projections import Projections
from recon.prep.spots import SpotFilter, Transmission
from recon.prep.unmeasured import NO_RUNS, runs_of, unmeasured

_NOISY = 0.01  # if air contains noise, at least this share of the line integrals of a projection is below 0
_DEEPEST = 60.0  # line integral; e^-60 is practically no intensity, and e^60 squared is still a finite number


@dataclass(frozen=True, eq=False)
class LinesPlan:
    """The plan for projections that are already line integrals. It has the same functions as a `CorrectionPlan`.

    Zingers and pixels that are not finite or contain no data are filled. Air columns are not used. Only pixels without
    data in all projections are masked. If air is exactly 0, without noise, zeros at the corners count as measured.

    Attributes:
        spots, foreign: as in `CorrectionPlan`.
        masked: bool [row, col], pixels that have not been finite in any projection so far.
    """

    spots: SpotFilter
    foreign: Mask | None = None
    masked: Mask = field(default_factory=lambda: np.ones((1, 1), np.bool_))
    air_columns: ClassVar[tuple[int, int]] = (0, 0)

    @classmethod
    def of(cls, zinger_threshold: float, foreign: Mask | None = None) -> LinesPlan:
        """The plan before the first projection; the threshold is that of `CorrectionSettings`."""
        root = SpotFilter(zinger_threshold, lambda lines: np.exp(np.clip(lines, -_DEEPEST, _DEEPEST) / -2))
        return cls(root, foreign)

    def transmission(
        self,
        lines: NDArray[np.generic],
        positions: NDArray[np.float64],
        view_ids: NDArray[np.int64],
        progress: Callable[[int], None] = lambda done: None,
    ) -> Transmission:
        """The line integrals. A pixel without data, or with a value that is not finite, gets the value of the nearest
        pixel with data."""
        data = lines.astype(np.float32, copy=False)
        not_finite, runs, repaired = ~np.isfinite(data), [NO_RUNS], np.zeros(len(data), np.int64)
        hidden = np.zeros(data.shape[1:], np.bool_)
        for v, view in enumerate(data):
            values = np.exp(-np.clip(view, -_DEEPEST, _DEEPEST))
            values[(view == 0) & (np.mean(view < 0) > _NOISY)] = 0
            without_data = not_finite[v]
            if (unseen := unmeasured(view, values, hidden, self.foreign)) is not None:
                runs.append(runs_of(unseen, int(view_ids[v])))
                without_data, repaired[v] = without_data | unseen, -np.count_nonzero(without_data & unseen)
            repaired[v] += np.count_nonzero(not_finite[v])
            if without_data.any():
                nearest = ndimage.distance_transform_edt(without_data, return_distances=False, return_indices=True)
                view[...] = view[tuple(nearest)]
        ones = np.ones(len(data), np.float32)
        return Transmission(
            data, view_ids, repaired, ones, None, np.concatenate(runs), not_finite.min(axis=0, initial=True)
        )

    def surveyed(self, views: Transmission) -> LinesPlan:
        """The plan after these projections: a pixel stays masked only if it has no data in these projections either."""
        return self if views.unseen is None else replace(self, masked=self.masked & views.unseen)

    def line_integrals(
        self,
        views: Transmission | None,
        last: bool = True,
        progress: Callable[[int], None] = lambda done: None,
        order: NDArray[np.intp] | None = None,
    ) -> tuple[Projections, LinesPlan]:
        """The same as in `CorrectionPlan`."""
        views, spots = self.spots.feed(views, last, progress, order)
        replaced = float(views.repaired.sum()) / max(views.data.size, 1)
        return Projections(
            views.data, views.view_ids, 0.0, views.air, self.masked, replaced=replaced, unmeasured=views.unmeasured,
            spots_left=spots.n_unfilled,
        ), replace(self, spots=spots)  # fmt: skip
