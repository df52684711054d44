"""Projections: line integrals, with a record of what the correction changed, and a function that joins batches of
them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import I64, Mask
from recon.base.masks import areas
from recon.prep.unmeasured import NO_RUNS


@dataclass(frozen=True, eq=False)
class Projections:
    """Line integrals, with a record of what the correction changed.

    Attributes:
        data: float32 [view, row, col], dimensionless, finite.
        view_ids: int64 [view].
        floored: fraction of the values of live pixels that were raised to the lowest allowed transmission.
        air: float32 [view], mean transmission of the air columns in each projection, by which the projection was
            divided; 1 if there are no air columns.
        masked: bool [row, col], dead and hot pixels, filled from their neighbours in every projection.
        air_columns: (left, right) number of columns in which `air` was measured; (0, 0) if `air` was not measured.
        replaced: fraction of all values of live pixels that were zingers or not finite, and were filled from their
            neighbours.
        weights: float32 [view, row, col], inverse variances of the line integrals, from the expected photons; 0 for
            masked pixels; None if photons were not counted.
        unmeasured: int64 [run, 4], runs of pixels without data in one projection, which were filled from their
            neighbours: projection, row, first column, and column after the last column of the run.
        spots_left: number of pixels in zingers that were too large to be filled, in these projections and all earlier
            ones.
    """

    data: NDArray[np.float32]
    view_ids: NDArray[np.int64]
    floored: float
    air: NDArray[np.float32]
    masked: Mask
    air_columns: tuple[int, int] = (0, 0)
    replaced: float = 0.0
    weights: NDArray[np.float32] | None = None
    unmeasured: I64 = field(default_factory=NO_RUNS.copy)
    spots_left: int = 0

    @property
    def lit(self) -> Mask | None:
        """bool [view, row, col], True for pixels with data; None if all pixels have data. Masked pixels count as pixels
        without data only in areas of 3 x 3 pixels or more.
        """
        lit = np.repeat(~areas(self.masked)[None], len(self.data), axis=0)
        index_of = {int(view): number for number, view in enumerate(self.view_ids)}
        for view, row, first, end in self.unmeasured[np.isin(self.unmeasured[:, 0], self.view_ids)].tolist():
            lit[index_of[view], row, first:end] = False
        return None if lit.all() else lit

    @property
    def measured(self) -> NDArray[np.float32]:
        """The line integrals, with NaN for pixels without data."""
        return self.data if (lit := self.lit) is None else np.where(lit, self.data, np.float32(np.nan))


def merge_and_empty(parts: list[Projections], data: NDArray[np.float32] | None = None) -> Projections:
    """Join batches of projections. The function empties the list of batches as it goes, so that only few projections
    are in memory twice.

    The air columns, the mask and `spots_left` are those of the last batch.

    Args:
        data: the line integrals of all batches, if they are already in one array. The line integrals in the batches are
            then ignored.
    """
    n = np.array([part.view_ids.size for part in parts], np.float64)
    shares, last = n / max(n.sum(), 1), parts[-1]
    ids, air, runs = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("view_ids", "air", "unmeasured")
    )
    floored, replaced = (float(shares @ [getattr(part, name) for part in parts]) for name in ("floored", "replaced"))
    weights_of_parts = [part.weights for part in parts if part.weights is not None]
    weights = np.concatenate(weights_of_parts) if weights_of_parts else None
    if data is None:
        data, start = np.empty((len(ids), *last.data.shape[1:]), np.float32), 0
        while parts:
            part = parts.pop(0).data
            data[start : start + len(part)] = part
            start += len(part)
    return Projections(data, ids, floored, air, last.masked, last.air_columns, replaced, weights, runs, last.spots_left)
