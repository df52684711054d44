"""A reconstruction method."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.method import ReconProblem, Reconstruction, RunControl
from recon.base.method_kinds import Direct
from recon.base.volume import Grid, Volume
from recon.voxels.direct import direct


@dataclass(frozen=True)
class Mean(Direct):
    """The mean of filtered back-projections by two filters."""

    name: ClassVar[str] = "mean"
    label: ClassVar[str] = "Mean of two"
    share: float = 0.5

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        views = masked(problem.projections, problem.use.weights)[0]
        sharp, smooth = (direct(views, problem.geometry, problem.grid, name) for name in ("ram-lak", "hann"))
        data = (self.share * sharp + (1 - self.share) * smooth).astype(np.float32)
        return Reconstruction(Volume(data, problem.grid), {"share": self.share})

    def toy(self) -> Self:
        return self

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        return 16 * int(np.prod(grid.shape)) + 8 * geometry.n_views * int(np.prod(geometry.detector_shape))
