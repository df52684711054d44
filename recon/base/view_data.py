"""Views: projections (line integrals) with their geometry and ray weights, and how to select parts of them."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, I64, Mask, bin_views
from recon.base.empirical import ONE_IN
from recon.base.geometry import Geometry
from recon.base.reach import Reach


@dataclass(frozen=True, eq=False)
class RayWeights:
    """Weights of rays [view, row, col] as a product; only the requested part is computed.

    Attributes:
        factors: at least one array, float32 [view, row, col] after numpy.broadcast_to.
    """

    factors: tuple[F32, ...]

    def __getitem__(self, part: Any) -> F32:
        return functools.reduce(np.multiply, (factor[part] for factor in self.factors))

    def part(self, part: Any) -> RayWeights:
        """The weights of a part of the rays, which are not computed."""
        return RayWeights(tuple(factor[part] for factor in self.factors))


@dataclass(frozen=True, eq=False)
class Views:
    """Projections (line integrals) with their geometry and ray weights.

    Attributes:
        data: float32 [view, row, col]; values that are not finite are allowed.
        geometry: geometry of these projections.
        weights: weight of each ray [view, row, col], 0 or more, an array or `RayWeights`; None: 1 everywhere.
        ids: [view] number of each projection in the file that it comes from; None: not known.
        used: [view] False for projections that are held out to judge a volume; None: all are used.
        reach: how far the sample goes beyond the field of view of the scan; None: not measured.
    """

    data: F32
    geometry: Geometry
    weights: Any = None
    ids: I64 | None = None
    used: Mask | None = None
    reach: Reach | None = None

    def select(self, chosen: NDArray[np.integer]) -> Views:
        """Only the chosen projections, in this order, with their weights computed."""
        return self._cut(chosen, None if self.weights is None else self.weights[chosen])

    def _cut(self, part: Any, weights: Any) -> Views:
        ids, used = (None if values is None else values[part] for values in (self.ids, self.used))
        return replace(
            self, data=self.data[part], geometry=self.geometry.select(part), weights=weights, ids=ids, used=used
        )

    @property
    def held_out(self) -> I64:
        """Numbers of the projections that are held out, ascending."""
        return np.flatnonzero(np.zeros(len(self.data), bool) if self.used is None else ~self.used)

    @property
    def seen(self) -> Views:
        """The projections that are not held out. Nothing is copied if they come first."""
        return self._those(self.used)

    @property
    def unseen(self) -> Views | None:
        """The projections that are held out; None: all are used."""
        return None if self.used is None or self.used.all() else self._those(~self.used)

    def using(self, numbers: NDArray[np.integer]) -> Views:
        """Only the projections used with these numbers, counted among those used, and in this order; those that are
        held out stay."""
        used = np.arange(len(self.data)) if self.used is None else np.flatnonzero(self.used)
        return self.select(np.concatenate((used[numbers], self.held_out)))

    def holding_out(self, held: NDArray[np.integer]) -> Views:
        """The same projections with those of these numbers held out and last; all of them were used before."""
        used = np.setdiff1d(np.arange(len(self.data)), held)
        return replace(self.select(np.concatenate((used, held))), used=np.arange(len(self.data)) < used.size)

    def _those(self, wanted: Mask | None) -> Views:
        if wanted is None or wanted.all():
            return replace(self, used=None)
        numbers = np.flatnonzero(wanted)
        first, end = int(numbers[0]), int(numbers[-1]) + 1
        part: Any = slice(first, end) if end - first == numbers.size else numbers
        lazy = isinstance(self.weights, RayWeights)
        weights = None if self.weights is None else self.weights.part(part) if lazy else self.weights[part]
        return replace(self._cut(part, weights), used=None)

    def rows(self, rows: slice) -> Views:
        """Only these detector rows of all projections, see `Geometry.rows`."""
        weights = None if self.weights is None else np.ascontiguousarray(self.weights[:, rows])
        data = np.ascontiguousarray(self.data[:, rows])
        return replace(self, data=data, geometry=self.geometry.rows(rows.start, rows.stop), weights=weights)

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
            return replace(self, data=bin_views(self.data, factor), geometry=views)
        sums, known = bin_views(self.weights * self.data, factor), bin_views(self.weights, factor)
        means = np.divide(sums, known, out=np.zeros_like(sums), where=known > 0)
        return replace(self, data=means, geometry=views, weights=known)

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
