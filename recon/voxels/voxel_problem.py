"""VoxelProblem: the data of an iterative method on voxels, and parts that several methods share."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.volume import Grid
from recon.kernels.cpu.vectors import extrapolate, replace_by_residual, turn_of_steps
from recon.voxels.direct import direct, has_direct_method
from recon.voxels.fbp import Filter, fbp_memory
from recon.voxels.projector import Projector, projection_images, volume_lines
from recon.voxels.resolution import ViewResolution
from recon.voxels.sweeps import Sweeps

POWER_ROUNDS, POWER_ROWS = 6, 16  # of power iteration, and what it sees where rows are alike


@dataclass(frozen=True, eq=False)
class VoxelProblem:
    """The data of an iterative method, as lines along z; `recon.voxels.iterative.solve` makes it.

    Attributes:
        data: [view, col, row], finite.
        weight: of each ray, [view, col, row], or None.
        nonnegative: voxels below zero are clipped.
        rng: for the order of views and subsets.
        go_on: called with (iteration, relative residual) after each iteration; False ends the method.
        decide: keeps decisions that follow from sums over the whole volume or all rays.
        trial_goes_on: called after each sweep of a trial on some rows; False ends this trial and the next ones.
        measured: the views as measured, where `data` are smoothed since voxels are too coarse for them; else None.
    """

    projector: Projector
    data: F32
    weight: F32 | None
    nonnegative: bool
    rng: np.random.Generator
    go_on: Callable[[int, float], bool]
    decide: Decisions = field(default_factory=Decisions)
    trial_goes_on: Callable[[], bool] = lambda: True
    measured: F32 | None = None
    _norms: list[tuple[Projector, F32 | None, float]] = field(default_factory=list, repr=False)  # of copies, too

    @property
    def norm(self) -> float:
        """`largest_eigenvalue` of AᵀWA, computed once for all copies of the problem with this projector and weight."""
        for projector, weight, norm in self._norms:
            if projector is self.projector and weight is self.weight:
                return norm
        self._norms.append((self.projector, self.weight, largest_eigenvalue(self.projector, self.weight)))
        return self._norms[-1][-1]

    @property
    def views(self) -> F32:
        """The views [view, col, row] as measured."""
        return self.data if self.measured is None else self.measured

    @property
    def scale(self) -> float:
        """||p||, rays weighed."""
        return math.sqrt(replace_by_residual(self.data, np.zeros_like(self.data), self.weight))

    def of_views(self, views: NDArray[np.intp]) -> VoxelProblem:
        """Data and weights of some views; the projector stays that of all views."""
        weight = None if self.weight is None else self.weight[views]
        measured = None if self.measured is None else self.measured[views]
        return replace(self, data=self.data[views], weight=weight, measured=measured)

    def filtered(self, filter: Filter) -> F32 | None:
        """FBP or FDK [y, x, z] of the views with some weight, rays of weight 0 filled in; None: neither takes them."""
        images, geometry = projection_images(self.views), self.projector.geometry
        if self.weight is not None:
            seen = np.flatnonzero(self.weight.any(axis=(1, 2)))
            geometry = geometry.select(seen)
            images = masked(images[seen], projection_images(self.weight[seen]))[0]
        if not has_direct_method(geometry):
            return None
        return volume_lines(direct(images, geometry, self.projector.grid, filter))

    def sweeps(self, subsets: Sequence[NDArray[np.intp]]) -> Sweeps:
        return Sweeps(self.projector, self.data, self.weight, subsets)

    def single_views(self) -> Sweeps:
        """Sweeps with one view a step."""
        return self.sweeps([np.array([view]) for view in range(self.projector.geometry.n_views)])


def density_unit(x: F32) -> float:
    """A typical high density: the 99.5th percentile of the positive values, from some 10⁵ of them; 0 for none."""
    sample = x.reshape(-1)[:: max(1, x.size // 100_003)]
    positive = sample[sample > 0]
    return float(np.percentile(positive, 99.5)) if positive.size else 0.0


class Momentum:
    """Nesterov's extrapolation between the steps of a descent; it starts anew when it points uphill.

    O'Donoghue & Candès 2015, Found. Comput. Math. 15, 715, eq. 13. Memory: two volumes.
    """

    def __init__(self, start: F32, decide: Decisions) -> None:
        self._decide = decide
        self._last, self._from, self._t = start.copy(), start.copy(), 1.0

    def __call__(self, x: F32) -> None:
        """Move x from the end of a step to the start of the next step, in place."""
        if self._decide("restart", lambda: turn_of_steps(self._last, self._from, x) > 0):
            self._t = 1.0
        after = (1 + math.sqrt(1 + 4 * self._t**2)) / 2
        extrapolate(x, (self._t - 1) / after, self._last, self._from)
        self._t = after


def largest_eigenvalue(projector: Projector, weight: F32 | None) -> float:
    """An upper bound of the largest eigenvalue of Aᵀ W A, within a few per cent, by power iteration.

    For a matrix of non-negative entries and a positive x the largest (B x)_i / x_i bounds it from above (Collatz 1942).
    So the step 1 / bound is safe after any number of rounds. The Rayleigh quotient would err to the other side. A
    matched projector has negative entries: the bound is that of the plain one, times `Projector.gain`.
    Where each row sees one slice, and all rows are alike, it is computed on sixteen rows.
    """
    geometry, slices = projector.geometry, projector.grid.shape[0]
    alike = weight is None and slices_are_rows(projector) and not (geometry.skew or geometry.width)
    if alike and slices > POWER_ROWS:
        some, grid = geometry.rows(0, POWER_ROWS), projector.grid
        centre = (Grid.matching(some).centre[0], *grid.centre[1:])
        box = replace(grid, shape=(POWER_ROWS, *grid.shape[1:]), centre=centre)
        projector = Projector(some, box, projector.matched)
    gain, projector = projector.gain(weight), projector.plain
    nz, ny, nx = projector.grid.shape
    x = np.ones((ny, nx, nz), np.float32)
    bound = math.inf
    for _ in range(POWER_ROUNDS):
        image = projector.forward_lines(x)
        if weight is not None:
            image *= weight
        product = projector.adjoint_lines(image)
        ratio = np.divide(product, x, out=np.zeros_like(x), where=x > 0)
        bound = min(bound, float(ratio.max()))
        if bound == 0:
            return math.inf  # no ray meets the box
        x = product / product.max()
    return gain * bound


def slices_are_rows(projector: Projector) -> bool:
    """Each slice of the grid is what one row of the views sees."""
    geometry, grid = projector.geometry, projector.grid
    rows = Grid.matching(geometry)
    same = (grid.shape[0], grid.spacing[0], grid.centre[0]) == (rows.shape[0], rows.spacing[0], rows.centre[0])
    return same and geometry.rows_show_slices


def iterative_memory(
    geometry: Geometry, grid: Grid, volumes: float, rays: float, weights: float, *, filtered: bool = False
) -> int:
    """Bytes of so many volumes, copies of the projections, and copies of their weights.

    Args:
        filtered: the method makes a filtered back-projection, too.
    """
    n_rays = geometry.n_views * math.prod(geometry.detector_shape)
    wide = max(geometry.detector_shape[1], grid.shape[2])
    volumes += geometry.width.arc > 0  # of the moments of an exposure
    rays += bool(geometry.width) + bool(ViewResolution.of(geometry, grid).smoothed.any())
    beside = fbp_memory(geometry.n_views, wide) if filtered else 0
    return round(4 * (volumes * math.prod(grid.shape) + (rays + weights) * n_rays)) + beside
