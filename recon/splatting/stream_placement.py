"""The projections of a fit during a scan, and the placing of Gaussians with them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.splatting import optimise as fit
from recon.splatting.anytime import averaged, is_held_out
from recon.splatting.initialise import default_count, first_volume, place, sample_gaussians, scale_to_data
from recon.splatting.problem import FitProblem
from recon.splatting.settings import FitSettings
from recon.voxels.beyond_field import whole_reach

# largest number of voxels, so that a placement takes about a second; new projections wait meanwhile
_PLACED_FROM = 2**22


@dataclass(frozen=True)
class StreamPlan:
    """The plan of a fit during a scan. It never changes.

    Attributes:
        settings: settings of the fitting steps.
        grid: grid of the snapshots.
        count: number of Gaussians at the first placement; None: derived from the detector (see `default_count`).
        first_views, first_span: the fit starts when this number of projections has arrived and they span this angle in
            radians (modulo π).
    """

    settings: FitSettings
    grid: Grid
    count: int | None
    first_views: int
    first_span: float

    def __post_init__(self) -> None:
        if self.count is not None and self.count < 1:
            raise ValueError(f"a fit needs at least one Gaussian, got {self.count}")
        if (self.settings.joined_pixels or 1) > 1:
            raise ValueError(
                f"joined_pixels={self.settings.joined_pixels} works only in a fit of a finished scan. For a fit "
                "during a scan, leave joined_pixels out and bin the scan"
            )


@dataclass(frozen=True, eq=False)
class Arrivals:
    """The projections of a fit during a scan, in the order of their arrival, without their pixels.

    Attributes:
        template: geometry of each of them, at the angle 0.
        angles: [view] radians.
        held_out: [view] True for a projection that no step uses until the final fit. The value stays the same if
            earlier projections are dropped.
        n_ever: number of projections that ever arrived, including those that were dropped.
    """

    template: Geometry
    angles: F64 = field(default_factory=lambda: np.empty(0))
    held_out: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, bool))
    n_ever: int = 0

    @property
    def n(self) -> int:
        return self.angles.size

    @property
    def geometry(self) -> Geometry:
        return self.template.at(self.angles)

    def followed_by(self, angles: F64) -> Arrivals:
        """These projections and new ones at `angles`."""
        held_out = [is_held_out(self.n_ever + k) for k in range(angles.size)]
        return replace(
            self,
            angles=np.append(self.angles, angles),
            held_out=np.append(self.held_out, np.array(held_out, bool)),
            n_ever=self.n_ever + angles.size,
        )

    def only(self, which: NDArray[np.intp]) -> Arrivals:
        """The projections with these numbers, in this order."""
        return replace(self, angles=self.angles[which], held_out=self.held_out[which])

    def about(self, axis_col: float) -> Arrivals:
        """The same projections with the rotation axis at another column."""
        return replace(self, template=replace(self.template, axis_col=axis_col))


class Placement(NamedTuple):
    """Gaussians that were placed, and the line integrals of the projections in the form that the fitting steps use."""

    problem: FitProblem
    state: fit.FitState


def place_gaussians(
    views: Arrivals,
    images: Sequence[F32],
    plan: StreamPlan,
    rng: np.random.Generator,
    *,
    all_views: bool,
    known: Placement | None = None,
) -> Placement:
    """Place Gaussians with an FBP of the projections; or, if `known` Gaussians are given, with their volume plus an FBP
    of their residual.

    Held-out projections are not used, unless `all_views` is True.

    Raises:
        ValueError: the projections show no material.
    """
    all_of = Views(np.stack(images), views.geometry).masked()
    learnt = [view for view in range(views.n) if all_views or not views.held_out[view]]
    reach = whole_reach(all_of)
    wider, used = reach.sample, replace(all_of, reach=reach).select(np.array(learnt))
    geometry, data = used.geometry, used.data
    box = plan.grid if wider is None else plan.grid.reaching(wider.radius, views.template)
    fitted = Grid.for_fit(views.template, box, wider=wider is not None)
    coarser = 2 ** max(0, math.ceil(math.log2(math.prod(fitted.shape) / _PLACED_FROM) / 3))
    shape = (fitted.shape[0], *(math.ceil(n / coarser) for n in fitted.shape[1:]))
    coarse_grid = replace(fitted, shape=shape, voxel_size=coarser * fitted.voxel_size)
    coarse_grid = Grid.for_fit(views.template, coarse_grid, wider=wider is not None)
    count = plan.count or default_count(views.template, fitted.voxel_size)
    kernel = plan.settings.kernel
    if known is None or geometry.is_cone:  # the first volume of a cone does not depend linearly on the data
        volume = first_volume(data, geometry, coarse_grid)
        gaussians = place(volume, used, count, rng, kernel=kernel)
    else:
        model, problem = averaged(known.state), known.problem
        rendered: F32 = np.stack(list(fit.renders(model, problem, plan.settings, learnt)))
        residual = first_volume(data - rendered * problem.scale, geometry, coarse_grid)
        volume = Volume(
            fit.volume_of(model, coarse_grid, views.template, plan.settings).data + residual.data, coarse_grid
        )
        radius = geometry.reach if wider is None else math.inf
        gaussians = sample_gaussians(volume, count, rng, field_radius=radius, kernel=kernel)
        gaussians = scale_to_data(gaussians, data, geometry)
    problem = fit.problem_of(all_of, fitted, gaussians.density_unit, plan.settings)
    return Placement(problem, fit.init(gaussians, rng))
