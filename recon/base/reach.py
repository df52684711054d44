"""Reach: how far a sample goes beyond the field of view, as its projections show it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

import numpy as np

from recon.base.arrays import F64, I64
from recon.base.empirical import EMPTY
from recon.base.geometry import Geometry
from recon.base.volume import Grid

LEAST = 0.1
"""Line integral at an edge above which there is material; phase fringes, scatter and a drift of air are lower."""

_LEAST_CUT_VIEWS = 2  # fewest projections in which material leaves the field of view

SAMPLE = "sample_radius"
"""Name of the decision on the sample radius, and prefix of its settings."""


@dataclass(frozen=True)
class SampleRadius:
    """Distance from the rotation axis to the edge of a sample that is wider than the field of view.

    Attributes:
        radius: mm; the radius that predicts held-out projections best, or the given one. It is half the width of a
            square box. For a round sample it is between the true radius and 0.886 of it (a square of equal area).
        low, high: mm, range of radii that predict held-out projections equally well within chance, plus a step of the
            search.
        density: relative uncertainty of the density in the middle: half of its change from `low` to `high`.
    """

    radius: float
    low: float
    high: float
    density: float

    @property
    def settings(self) -> dict[str, float]:
        """The values in the form of settings of a result."""
        return {SAMPLE if name == "radius" else f"{SAMPLE}_{name}": value for name, value in asdict(self).items()}


@dataclass(frozen=True, eq=False)
class FieldEdges:
    """Line integrals at the left and right edge of the projections, which show whether the sample exceeds the field.

    Attributes:
        levels: line integral at each edge ("left", "right") that should show air: the smallest of the quarters of a
            scan.
        mean: mean of the projections.
        of_views: line integral at these edges [view] in the examined projections.
        views: numbers of the examined projections, counted without laterally offset ones.
        continued: True if a row ends in material at this edge, so that FBP and FDK extrapolate it.
    """

    levels: Mapping[str, float]
    mean: float
    of_views: Mapping[str, F64] = field(default_factory=dict)
    views: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    continued: bool = False

    def beyond(self, least: float = LEAST) -> dict[str, float]:
        """The edges beyond which the sample extends, with their line integrals; empty if it is within the field.

        Args:
            least: line integral that a changing beam may cause; 0: the air of these projections is at zero.
        """
        return {side: level for side, level in self.levels.items() if level > max(least, EMPTY * self.mean)}

    def passing(self) -> dict[str, tuple[int, int]]:
        """The edges at which material leaves the field in a part of the scan, with the first and last such projection.

        Empty if a projection has material at both edges, because then the sample is wider than the field or the beam
        changed.
        """
        least = max(LEAST, EMPTY * self.mean)
        is_beyond = {side: levels > least for side, levels in self.of_views.items()}
        count = sum(flags.astype(int) for flags in is_beyond.values())
        if (
            self.beyond()
            or not is_beyond
            or np.max(count) > 1
            or not _LEAST_CUT_VIEWS <= np.sum(count) < self.views.size
        ):
            return {}
        return {
            side: (int(self.views[flags][0]), int(self.views[flags][-1]))
            for side, flags in is_beyond.items()
            if flags.any()
        }


@dataclass(frozen=True, eq=False)
class Reach:
    """How far a sample reaches; `recon.voxels.beyond_field` measures it.

    Attributes:
        edges: the line integrals at the edges of the field of view.
        tall: True if the sample continues above or below the slices of a cone.
        sample: distance from the axis to the edge of a sample wider than the field; None: it is within the field, or
            its radius was not measured.
        measured: True if the radius was measured or given.
    """

    edges: FieldEdges
    tall: bool = False
    sample: SampleRadius | None = None
    measured: bool = False

    @property
    def beyond(self) -> dict[str, float]:
        """The edges beyond which the sample extends, see `FieldEdges.beyond`."""
        return self.edges.beyond()

    @property
    def is_outside(self) -> bool:
        """True if the sample is known to reach outside the box of the field of view."""
        return self.sample is not None or self.tall

    def box(self, grid: Grid, geometry: Geometry) -> Grid:
        """The box with voxels added until it contains the sample, as far as its reach was measured."""
        box = grid if self.sample is None else grid.reaching(self.sample.radius, geometry)
        return box.as_tall_as_rays(geometry) if self.tall else box

    def is_cut_by(self, grid: Grid, geometry: Geometry) -> bool:
        """True if the box of `grid` cuts more than a voxel off the field of view, or off a sample that is wider."""
        if not self.measured and self.edges.beyond(0.0):
            return True
        whole = self.box(Grid.matching(geometry), geometry)
        (low, high), (first, last) = whole.edges, grid.edges
        spacing = np.array(grid.spacing[::-1])
        return bool((first - low > spacing).any() or (high - last > spacing).any())
