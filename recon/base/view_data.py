"""Views: projections (line integrals) with their geometry and ray weights, and how to select parts of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, Mask, bin_views
from recon.base.empirical import ONE_IN
from recon.base.geometry import Geometry


@dataclass(frozen=True, eq=False)
class Views:
    """Projections (line integrals) with their geometry and ray weights.

    Attributes:
        data: float32 [view, row, col]; values that are not finite are allowed.
        geometry: geometry of these projections.
        weights: weight of each ray [view, row, col], 0 or more; None: 1 everywhere.
    """

    data: F32
    geometry: Geometry
    weights: F32 | None = None

    def select(self, chosen: NDArray[np.integer]) -> Views:
        """Only the chosen projections, in this order."""
        weights = None if self.weights is None else self.weights[chosen]
        return Views(self.data[chosen], self.geometry.select(chosen), weights)

    def rows(self, rows: slice) -> Views:
        """Only these detector rows of all projections, see `Geometry.rows`."""
        weights = None if self.weights is None else np.ascontiguousarray(self.weights[:, rows])
        data = np.ascontiguousarray(self.data[:, rows])
        return Views(data, self.geometry.rows(rows.start, rows.stop), weights)

    def masked(self) -> Views:
        """The projections with all values finite; values that were not finite get weight 0, see `masks.masked`.

        Raises:
            ValueError: as `masked`.
        """
        from recon.base.masks import masked  # imported here, because help loads this module and must not load scipy

        data, weights = masked(self.data, self.weights)
        return self if data is self.data and weights is self.weights else replace(self, data=data, weights=weights)

    def weighed(self, factor: F32 | Mask) -> Views:
        """The projections with their weights multiplied by a factor that broadcasts to [view, row, col]."""
        ones = np.broadcast_to(np.float32(1), self.data.shape) if self.weights is None else self.weights
        return replace(self, weights=np.multiply(ones, factor, dtype=np.float32))

    def binned(self, factor: int, geometry: Geometry | None = None) -> Views:
        """The projections binned by factor x factor pixels: weighted means, with the mean weights.

        Args:
            geometry: geometry of the binned pixels; None: `Geometry.binned`.
        """
        if factor == 1:
            return self
        views = geometry or self.geometry.binned(factor)
        if self.weights is None:
            return Views(bin_views(self.data, factor), views)
        sums, known = bin_views(self.weights * self.data, factor), bin_views(self.weights, factor)
        return Views(np.divide(sums, known, out=np.zeros_like(sums), where=known > 0), views, known)

    def split(self, one_in: int = ONE_IN) -> tuple[Views, Views]:
        """The projections to reconstruct from, and the held-out ones: one in `one_in`, see `split_views`."""
        seen, unseen = split_views(self.geometry, one_in)
        return self.select(seen), self.select(unseen)


def split_views(
    geometry: Geometry, one_in: int = ONE_IN, period: float | None = None
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Numbers of the projections to reconstruct from, and of the held-out ones: one in `one_in`, evenly spread in
    angle.

    Args:
        period: angle in radians after which projections repeat; None: the period of the geometry, which depends on the
            position of the axis.
    """
    order = np.argsort(np.mod(geometry.angles, period or geometry.period), kind="stable")
    unseen = np.sort(order[one_in // 2 :: one_in])
    return np.setdiff1d(np.arange(geometry.n_views), unseen), unseen
