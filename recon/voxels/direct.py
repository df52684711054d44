"""Fbp: the direct method, FBP for a parallel beam and FDK for a cone."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Self, get_args

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.method import MethodResult, Progress, ReconProblem, RunControl, Traits
from recon.base.volume import Grid, Volume
from recon.voxels.fbp import Filter, fbp, fbp_memory
from recon.voxels.fdk import fdk
from recon.voxels.posed_direct import posed_direct
from recon.voxels.view_weights import missing_arc


@dataclass(frozen=True)
class Fbp:
    """Filtered back-projection (FDK for a cone).

    Attributes:
        filter: the smooth one, "hann", is best for few or noisy views.
    """

    name: ClassVar[str] = "fbp"
    label: ClassVar[str] = "FBP"
    traits: ClassVar[Traits] = Traits(direct=True, error_bars=(1.0, 0.7))

    filter: Filter = "hann"

    def __post_init__(self) -> None:
        if self.filter not in get_args(Filter):
            raise ValueError(f"filter must be one of {', '.join(get_args(Filter))}, got {self.filter!r}")

    def run(self, problem: ReconProblem, control: RunControl) -> MethodResult:
        filled = masked(problem.projections, problem.use.weights)[0]
        begin, views = control.now(), problem.geometry.n_views

        def progress(done: int, slices: int) -> None:
            if control.on_progress is not None:
                nan = math.nan
                control.on_progress(Progress(done, slices, control.now() - begin, nan, nan, 0, views, unit="slices"))

        data = direct(filled, problem.geometry, problem.grid, self.filter, progress)
        return MethodResult(Volume(data, problem.grid), {"filter": self.filter})

    def toy(self) -> Self:
        return self

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        views, (rows, cols) = geometry.n_views, geometry.detector_shape
        beside = fbp_memory(views, max(cols, grid.shape[2]))
        return 4 * (math.prod(grid.shape) + 2 * weighted * views * rows * cols) + beside


def direct(
    projections: F32,
    geometry: Geometry,
    grid: Grid,
    filter: Filter = "ram-lak",
    on_block: Callable[[int, int], None] = lambda done, of: None,
    out: F32 | None = None,
) -> F32:
    """FBP of a parallel beam, FDK of a cone [z, y, x], both along the rays of rolled and tilted views; see `fbp`, `fdk`
    and `posed_direct`. Only `fbp` takes `out`."""
    if not geometry.is_straight:
        return posed_direct(projections, geometry, grid, filter, on_block)
    if geometry.is_cone:
        return fdk(projections, geometry, grid, filter, on_block)
    return fbp(projections, geometry, grid, filter, on_block, out)


def has_direct_method(geometry: Geometry) -> bool:
    """Whether FBP or FDK takes these views: a cone needs a full circle, or a short scan (`missing_arc`)."""
    return not geometry.is_cone or missing_arc(geometry) == 0
