"""Views: line integrals with their geometry and the weights of their rays, and parts of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, Mask, bin_views
from recon.base.empirical import ONE_IN
from recon.base.geometry import Geometry


@dataclass(frozen=True, eq=False)
class Views:
    """Line integrals with their geometry and the weights of their rays.

    Attributes:
        data: float32 [view, row, col]; values that are not finite are allowed.
        geometry: of these views.
        weights: of each ray [view, row, col], 0 or more; None: one for all.
    """

    data: F32
    geometry: Geometry
    weights: F32 | None = None

    def select(self, chosen: NDArray[np.integer]) -> Views:
        """These views alone, in this order."""
        weights = None if self.weights is None else self.weights[chosen]
        return Views(self.data[chosen], self.geometry.select(chosen), weights)

    def rows(self, rows: slice) -> Views:
        """These detector rows of all views, see `Geometry.rows`."""
        weights = None if self.weights is None else np.ascontiguousarray(self.weights[:, rows])
        data = np.ascontiguousarray(self.data[:, rows])
        return Views(data, self.geometry.rows(rows.start, rows.stop), weights)

    def masked(self) -> Views:
        """All values finite, those that were not without weight, see `masks.masked`.

        Raises:
            ValueError: as `masked`.
        """
        from recon.base.masks import masked  # here: help loads this module, and no scipy

        data, weights = masked(self.data, self.weights)
        return self if data is self.data and weights is self.weights else replace(self, data=data, weights=weights)

    def weighed(self, factor: F32 | Mask) -> Views:
        """The views with the weights of rays times a factor, of a shape that goes with [view, row, col]."""
        ones = np.broadcast_to(np.float32(1), self.data.shape) if self.weights is None else self.weights
        return replace(self, weights=np.multiply(ones, factor, dtype=np.float32))

    def binned(self, factor: int, geometry: Geometry | None = None) -> Views:
        """Views with factor x factor pixels joined: their weighted means, with their mean weight.

        Args:
            geometry: of the joined pixels; None: `Geometry.binned`.
        """
        if factor == 1:
            return self
        views = geometry or self.geometry.binned(factor)
        if self.weights is None:
            return Views(bin_views(self.data, factor), views)
        sums, known = bin_views(self.weights * self.data, factor), bin_views(self.weights, factor)
        return Views(np.divide(sums, known, out=np.zeros_like(sums), where=known > 0), views, known)

    def split(self, one_in: int = ONE_IN) -> tuple[Views, Views]:
        """The views to reconstruct from, and one in `one_in` held out, see `split_views`."""
        seen, unseen = split_views(self.geometry, one_in)
        return self.select(seen), self.select(unseen)


def split_views(
    geometry: Geometry, one_in: int = ONE_IN, period: float | None = None
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Views to reconstruct from, and one in `one_in` held out, evenly spread in angle.

    Args:
        period: radians after which angles are the same; None: that of the geometry, which depends on the axis.
    """
    order = np.argsort(np.mod(geometry.angles, period or geometry.period), kind="stable")
    unseen = np.sort(order[one_in // 2 :: one_in])
    return np.setdiff1d(np.arange(geometry.n_views), unseen), unseen
