"""Views: line integrals with their geometry and the weights of their rays, and parts of them."""

from __future__ import annotations

from dataclasses import dataclass

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.masks import RayWeights


@dataclass(frozen=True, eq=False)
class Views:
    """Line integrals with their geometry and the weights of their rays.

    Attributes:
        data: float32 [view, row, col]; values that are not finite are allowed.
        geometry: of these views.
        weights: of each ray [view, row, col], 0 or more; those of weight 0 were not measured. None: one for all.
    """

    data: F32
    geometry: Geometry
    weights: F32 | RayWeights | None = None

    def rows(self, rows: slice) -> Views:
        """These detector rows of all views, see `Geometry.rows`."""
        weights = None if self.weights is None else self.weights[:, rows]
        return Views(self.data[:, rows], self.geometry.rows(rows.start, rows.stop), weights)
