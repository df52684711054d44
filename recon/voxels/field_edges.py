"""Field edges: whether a sample goes on beyond the edges of the field, which every reader of the views asks here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from recon.base.arrays import F32, F64, I64
from recon.base.empirical import EMPTY
from recon.base.geometry import Geometry
from recon.base.views import spread
from recon.voxels.view_weights import covers_the_circle

LEAST = 0.1
"""Line integral at an edge above which matter is there: more than phase fringes, scatter and a drift of air leave."""

_VIEWS, _ROWS, _PARTS = 32, 128, 4  # looked at, about; parts of the views
_FEWEST = 2  # of the views looked at, in which matter goes out of the field
_FULL = 0.5  # share of the fullest row's mass that a row needs


@dataclass(frozen=True)
class FieldEdges:
    """The edges of parallel views or of a cone.

    Attributes:
        levels: line integral at each edge ("left", "right") that should show air, the least of the quarters of a scan.
        mean: of the views.
        of_views: line integral at these edges [view] of the `views` that were looked at.
    """

    levels: Mapping[str, float]
    mean: float
    of_views: Mapping[str, F64] = field(default_factory=dict)
    views: I64 = field(default_factory=lambda: np.zeros(0, np.int64))

    @classmethod
    def of(cls, data: F32, geometry: Geometry) -> FieldEdges:
        """By up to 32 views, in the rows that hold matter.

        Medians over views and rows: corners at some angles do not count. The least of the quarters: a beam drifts away
        from its flats, a sample is there from the first to the last view. A full turn about an axis off the middle is
        cut near the axis on purpose; the other half turn sees what is there.

        Args:
            data: line integrals [view, row, col]; values that are not finite do not count.
        """
        n, cols = len(data), data.shape[2]
        width = max(2, cols // 50)
        if n == 0 or cols < 2 * width:
            return cls({}, 0.0)
        views = spread(np.arange(n), _VIEWS)
        some = data[np.ix_(views, np.arange(0, data.shape[1], max(1, data.shape[1] // _ROWS)))]
        some = np.where(np.isfinite(some), some, np.nan)
        mass = np.maximum(np.nan_to_num(some).mean(axis=(0, 2)), 0)
        some = some[:, mass >= _FULL * mass.max()]
        edges = {"left": some[..., :width], "right": some[..., -width:]}
        if geometry.is_off_middle and covers_the_circle(geometry.angles):
            far = "right" if geometry.axis_col < (cols - 1) / 2 else "left"
            edges = {far: edges[far]}
        levels = {
            side: min(_median(part) for part in np.array_split(values, min(_PARTS, len(values))))
            for side, values in edges.items()
        }
        of_views = {side: np.array([_median(view) for view in values]) for side, values in edges.items()}
        return cls(levels, float(np.median(np.nan_to_num(some).mean(axis=(1, 2)))), of_views, views)

    def beyond(self, least: float = LEAST) -> dict[str, float]:
        """The edges beyond which the sample goes on, with their line integrals; empty where it is in the field.

        Args:
            least: line integral that a beam which changes may leave; 0 of views whose air is at zero.
        """
        return {side: level for side, level in self.levels.items() if level > max(least, EMPTY * self.mean)}

    def passing(self) -> dict[str, tuple[int, int]]:
        """The edges at which matter goes out of the field in a part of the scan, with the first and last such view.

        Empty where a view has matter at both edges: it is wider than the field, or the beam has changed.
        """
        least = max(LEAST, EMPTY * self.mean)
        at = {side: levels > least for side, levels in self.of_views.items()}
        count = sum(flags.astype(int) for flags in at.values())
        if self.beyond() or not at or np.max(count) > 1 or not _FEWEST <= np.sum(count) < self.views.size:
            return {}
        return {
            side: (int(self.views[flags][0]), int(self.views[flags][-1])) for side, flags in at.items() if flags.any()
        }


def _median(values: F32) -> float:
    """Of the rays that were measured; 0 where none was."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else 0.0


def wider_than_field(projections: F32, geometry: Geometry) -> bool:
    """Whether the sample is wider than the field, for views [view, row, col] whose air is at zero."""
    return bool(FieldEdges.of(projections, geometry).beyond(0.0))
