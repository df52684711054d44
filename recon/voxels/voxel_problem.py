"""VoxelProblem: the data of an iterative method on voxels, and functions that several methods share."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, some_values
from recon.base.decisions import Decisions, GoesOn, Prior
from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.method import ReconProblem
from recon.base.reach import Reach
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.kernels.cpu.tv import Weights
from recon.kernels.cpu.vectors import replace_by_residual
from recon.voxels.devices import CPU, LineProjector, VoxelDevice, projector_on, voxel_device
from recon.voxels.direct import direct, has_direct_method
from recon.voxels.fbp import Filter, fbp_memory
from recon.voxels.projector import Projector, projection_images, volume_lines
from recon.voxels.resolution import ViewResolution

# Rays shorter than this share of the longest ray, and voxels with a column sum below this share of the largest, are
# left out, because their corrections would be divided by almost zero.
_LEAST_SUM = 1e-3

_KEPT_VIEWS = 9  # number of projections of a sweep whose residual is kept


def interleaved(projector: Projector, subsets: int) -> list[NDArray[np.intp]]:
    """Indices of the projections of each subset.

    Neighbours in angle are in different subsets, so that each covers all directions.
    """
    order = np.argsort(np.mod(projector.geometry.angles, projector.geometry.period), kind="stable")
    count = min(subsets, order.size)
    return [order[start::count] for start in range(count)]


class Sweeps:
    """Makes sweeps: passes over all projections, subset by subset. Memory: two volumes, and twice the projections.

    Attributes:
        pace: typical step of a sweep along the gradient of the weighted ½||A x - p||².
        residual: p - A x of some projections of the last sweep [view, col, row], times the root of their weight (NaN:
            0).
    """

    def __init__(
        self, projector: Projector, data: F32, weight: F32 | None, subsets: Sequence[NDArray[np.intp]]
    ) -> None:
        """Prepare sweeps over `data` [view, col, row] with `weight` for each ray (None: 1), in `subsets`."""
        (nz, ny, nx), device = projector.grid.shape, voxel_device(projector.device)
        self._device, self._parts, scales = device, list[tuple[LineProjector[Any], Any, Any, Any]](), 0.0
        self._step = device.zeros((ny, nx, nz))  # first the largest column sums, then their inverse
        self._gradient = device.zeros((ny, nx, nz))
        for views in subsets:
            part = projector.subset(views) if len(subsets) > 1 else projector
            measured = device.array(data[views] if len(subsets) > 1 else data)
            rays = None if weight is None else device.array(weight[views] if len(subsets) > 1 else weight)
            self._gradient[...] = 1
            # the plain projector has no negative entries, so these are sums of absolute values
            plain = projector_on(device, part.plain)
            scale = _inverse(plain.forward_lines(self._gradient))
            plain.adjoint_lines(
                device.array(np.ones(scale.shape, np.float32)) if rays is None else rays, self._gradient
            )
            device.maximum(self._step, self._gradient, out=self._step)
            if rays is not None:
                scale *= rays
            scales += float(device.numpy(scale).sum(dtype=np.float64))
            self._parts.append((projector_on(device, part), measured, rays, scale))
        self._step = _inverse(self._step)
        weights = data.size if weight is None else float(weight.sum(dtype=np.float64))
        steps = device.numpy(self._step)
        self.pace = float(steps[steps > 0].mean(dtype=np.float64)) * scales / weights if scales > 0 else 0.0

    def run(self, x: F32, relaxation: float, nonnegative: bool, rng: np.random.Generator | None) -> float:
        """One sweep over x [y, x, z], in place, with the subsets in random order (`rng` None: in the given order).

        Returns:
            Σ weight (A x - p)², each ray before its own correction.
        """
        order = np.arange(len(self._parts)) if rng is None else rng.permutation(len(self._parts))
        total, residuals, device = 0.0, [], self._device
        volume = device.array(x)
        for index in order:
            part, data, weight, scale = self._parts[index]
            residual = part.forward_lines(volume)  # first the model; the data are subtracted next
            sampled = sampled_views(len(self._parts), len(data))
            weights_of_rays = None if weight is None else device.numpy(weight[sampled])
            residuals.append(whitened(device.numpy(data[sampled] - residual[sampled]), weights_of_rays))
            total += device.replace_by_residual(data, residual, weight, scale)
            part.adjoint_lines(residual, self._gradient)
            device.add_product(volume, relaxation, self._step, self._gradient, nonnegative)
        self.residual = np.concatenate(residuals)
        if volume is not x:
            x[...] = device.numpy(volume)
        return total


def sampled_views(subsets: int, n_views: int) -> slice:
    """The projections of a subset of `n_views` whose residual is kept, so that a sweep over `subsets` keeps about 9."""
    return slice(None, None, max(1, subsets * n_views // _KEPT_VIEWS))


def whitened(residual: F32, weight: F32 | None) -> F32:
    """The residual times the root of each ray's weight; NaN if the weight is 0."""
    if weight is None:
        return residual
    return np.where(weight > 0, residual * np.sqrt(weight), np.float32(np.nan)).astype(np.float32, copy=False)


def _inverse(sums: Any) -> Any:
    """1 / sums, or 0 if a sum is too small. The array is overwritten; it may be on any device."""
    least = max(_LEAST_SUM * float(sums.max()), float(np.finfo(np.float32).tiny))
    sums[sums <= least] = math.inf
    return 1 / sums


class Units(NamedTuple):
    """Units that are powers of two near the lengths, line integrals and weights of the data.

    The conversion is exact.
    """

    length: int = 0
    integral: int = 0
    weight: int = 0

    @classmethod
    def of(cls, projector: Projector, data: F32, rays: F32 | None) -> Units:
        largest = max(float(data.max()), -float(data.min()))
        weight = 1.0 if rays is None else float(rays.max())
        return cls(*(math.frexp(size)[1] for size in (projector.grid.voxel_size, largest, weight)))

    @property
    def density(self) -> int:
        return self.integral - self.length

    def projector(self, projector: Projector, sign: int = -1) -> Projector:
        """The projector in these units; with sign 1, converted back to the units of the scan."""
        box, power = projector.grid, sign * self.length
        edge, slices = (math.ldexp(n, power) for n in (box.voxel_size, box.spacing[0]))
        z, y, x = (math.ldexp(n, power) for n in box.centre)
        grid = Grid(box.shape, edge, (z, y, x), slices)
        return replace(projector, geometry=projector.geometry.scaled(math.ldexp(1.0, power)), grid=grid)

    def prior(self, prior: Prior, weighed: bool, sign: int = -1) -> Prior:
        """The prior in these units, for rays with (`weighed`) or without weights.

        With sign 1, the prior is converted back to the units of the scan.
        """
        weight = math.ldexp(prior.weight, sign * (self.length + self.integral + weighed * self.weight))
        materials = prior.materials and prior.materials.scaled(sign * self.density)
        return prior._replace(
            weight=weight, strength=math.ldexp(prior.strength, sign * self.density), materials=materials
        )


_NO_UNITS = Units()


def times_power(array: F32, power: int) -> F32:
    """array *= 2^power, in steps within float32's range."""
    while power:
        step = min(max(power, -100), 100)
        array *= np.float32(2.0**step)
        power -= step
    return array


NORM = "norm"  # name of the decision about the largest eigenvalue, which does not depend on the data
POWER_ROUNDS = 6  # number of rounds of the power iteration


@dataclass(frozen=True, eq=False)
class VoxelProblem:
    """The data of an iterative method, as lines along z; `recon.voxels.iterative.solve` makes it.

    Attributes:
        data: [view, col, row], finite.
        weight: weight of each ray, [view, col, row], or None.
        nonnegative: True: voxels below zero are clipped.
        rng: random generator for the order of projections and subsets.
        go_on: called with (iteration, relative residual) after each iteration; False ends the method. `go_on.trials`
            likewise ends test reconstructions on some rows.
        decide: stores decisions that follow from sums over the whole volume or all rays.
        measured: the measured projections if `data` were smoothed because the voxels are coarse; otherwise None.
        with_all_columns: if the problem has only some columns, a function that makes the problem with all columns,
            which determines the length of the steps.
        units: units of all lengths, line integrals and weights.
        reach: how far the sample goes beyond the field of view, in the units of the scan; None: not measured.
    """

    projector: Projector
    data: F32
    weight: F32 | None
    nonnegative: bool
    rng: np.random.Generator
    go_on: GoesOn
    decide: Decisions = field(default_factory=Decisions)
    measured: F32 | None = None
    with_all_columns: Callable[[], VoxelProblem] | None = None
    units: Units = _NO_UNITS
    reach: Reach | None = None
    # shared by copies of the problem
    _norms: list[tuple[Projector, F32 | None, float]] = field(default_factory=list, repr=False)

    @property
    def norm(self) -> float:
        """The `largest_eigenvalue` of AᵀWA with all columns. It is computed once for all copies with this projector and
        weight.
        """
        for projector, weight, norm in self._norms:
            if projector is self.projector and weight is self.weight:
                return norm
        whole = self.with_all_columns
        norm = whole().norm if whole else largest_eigenvalue(self.projector, self.weight)
        self._norms.append((self.projector, self.weight, norm))
        return self._norms[-1][-1]

    def part(
        self, geometry: Geometry, grid: Grid, views: NDArray[np.intp] | slice, cols: slice, rows: slice
    ) -> VoxelProblem:
        """The problem of some projections, columns and rows, which have this geometry, on this grid."""

        def cut(rays: F32) -> F32:
            return np.ascontiguousarray(rays[views][:, cols, rows])

        return replace(
            self,
            projector=replace(self.projector, geometry=geometry, grid=grid),
            data=cut(self.data),
            measured=None if self.measured is None else cut(self.measured),
            weight=None if self.weight is None else cut(self.weight),
            _norms=[],
        )

    @property
    def prior(self) -> Prior | None:
        """The prior that was chosen before; None: the method decides."""
        return None if self.decide.prior is None else self.units.prior(self.decide.prior, self.weight is not None)

    @property
    def of_scan(self) -> ReconProblem:
        """The same projections in the units of the scan, as methods get them."""
        projector, rays = self.units.projector(self.projector, 1), self.weight
        data = times_power(projection_images(self.views).copy(), self.units.integral)
        weights = None if rays is None else times_power(projection_images(rays).copy(), self.units.weight)
        views = Views(data, projector.geometry, weights, reach=self.reach)
        return ReconProblem(views, projector.grid, device=projector.device)

    @property
    def wide(self) -> bool:
        """True if the sample is known to be wider than the field of view."""
        return self.reach is not None and self.reach.sample is not None

    @property
    def views(self) -> F32:
        """The measured projections [view, col, row]."""
        return self.data if self.measured is None else self.measured

    @property
    def scale(self) -> float:
        """The weighted norm ||p||."""
        return math.sqrt(replace_by_residual(self.data, np.zeros_like(self.data), self.weight))

    def filtered(self, filter: Filter) -> F32 | None:
        """FBP or FDK [y, x, z] of the projections, with rays of weight 0 filled; None if neither can be used."""
        images, geometry = projection_images(self.views), self.projector.geometry
        if self.weight is not None:
            measured_views = np.flatnonzero(self.weight.any(axis=(1, 2)))
            geometry = geometry.select(measured_views)
            images = masked(images[measured_views], projection_images(self.weight[measured_views]))[0]
        if not has_direct_method(geometry):
            return None
        return volume_lines(direct(images, geometry, self.projector.grid, filter, device=self.projector.device))

    def first_sweep(self, x: F32, rng: np.random.Generator | None) -> None:
        """Run a sweep of OS-SIRT on x [y, x, z], which is zero, in place, because it is a better start for iterations.

        Args:
            rng: random generator for the order of subsets; None: their given order.
        """
        self.sweeps(interleaved(self.projector, 9)).run(x, 1.0, self.nonnegative, rng)

    def sweeps(self, subsets: Sequence[NDArray[np.intp]]) -> Sweeps:
        return Sweeps(self.projector, self.data, self.weight, subsets)

    def single_views(self) -> Sweeps:
        """Sweeps with one projection per step."""
        return self.sweeps([np.array([view]) for view in range(self.projector.geometry.n_views)])


def density_unit(x: F32) -> float:
    """A typical high density: the 99.5th percentile of about 10⁵ of the positive values; 0 if there are none."""
    sample = some_values(x, 100_003)
    positive = sample[sample > 0]
    return float(np.percentile(positive, 99.5)) if positive.size else 0.0


class Momentum:
    """Nesterov's extrapolation between the steps of a descent; it restarts when it points uphill.

    O'Donoghue & Candès 2015, Found. Comput. Math. 15, 715, eq. 13. Memory: two volumes. Arrays are those of a device.

    Args:
        largest_momentum: largest share of the last step that is added.
    """

    def __init__(
        self, start: Any, decide: Decisions, device: VoxelDevice[Any] = CPU, largest_momentum: float = 1.0
    ) -> None:
        self._decide, self._device, self._most = decide, device, largest_momentum
        self._last, self._from, self._t = device.copy(start), device.copy(start), 1.0

    def __call__(self, x: Any) -> None:
        """Move x from the end of a step to the start of the next step, in place."""
        if self._decide("restart", lambda: self._device.turn_of_steps(self._last, self._from, x) > 0):
            self._t = 1.0
        next_t = (1 + math.sqrt(1 + 4 * self._t**2)) / 2
        self._device.extrapolate(x, min((self._t - 1) / next_t, self._most), self._last, self._from)
        self._t = next_t


def largest_eigenvalue(projector: Projector, weight: F32 | None) -> float:
    """An upper bound of the largest eigenvalue of Aᵀ W A, within a few per cent, by power iteration.

    For a matrix B with non-negative entries and a positive x, the largest (B x)_i / x_i is an upper bound (Collatz
    1942). So the step 1 / bound is safe after any number of rounds. The Rayleigh quotient would be too low. A matched
    projector has negative entries. Its bound is that of the plain projector, times `Projector.gain`.

    If each row sees one slice and all rows are alike, the bound is computed on one row, in a half to a fifth of the
    time.
    """
    projector = one_of_like_rows(projector, weight)
    gain, projector, device = projector.gain(weight), projector.plain, voxel_device(projector.device)
    lines, (nz, ny, nx) = projector_on(device, projector), projector.grid.shape
    rays = None if weight is None else device.array(weight)
    x = np.ones((ny, nx, nz), np.float32)
    bound = math.inf
    for _ in range(POWER_ROUNDS):
        image = lines.forward_lines(device.array(x))
        if rays is not None:
            image *= rays
        product = device.numpy(lines.adjoint_lines(image))
        ratio = np.divide(product, x, out=np.zeros_like(x), where=x > 0)
        bound = min(bound, float(ratio.max()))
        if bound == 0:
            return math.inf  # no ray crosses the box
        x = product / product.max()
    return gain * bound


def one_of_like_rows(projector: Projector, weight: F32 | None) -> Projector:
    """The projector of one row if rays have no `weight` and all rows are alike; otherwise the projector itself."""
    geometry, slices = projector.geometry, projector.grid.shape[0]
    alike = weight is None and slices_are_rows(projector) and not (geometry.skew or geometry.width)
    if not (alike and slices > 1):
        return projector
    one_row, grid = geometry.rows(0, 1), projector.grid
    centre = (Grid.matching(one_row).centre[0], *grid.centre[1:])
    return replace(projector, geometry=one_row, grid=replace(grid, shape=(1, *grid.shape[1:]), centre=centre))


def slices_are_rows(projector: Projector) -> bool:
    """Whether each slice of the grid is seen by exactly one row of the projections."""
    geometry, grid = projector.geometry, projector.grid
    rows = Grid.matching(geometry)
    same = (grid.shape[0], grid.spacing[0], grid.centre[0]) == (rows.shape[0], rows.spacing[0], rows.centre[0])
    return same and geometry.rows_show_slices


@dataclass(frozen=True)
class Buffers:
    """Arrays of float32 that are in memory at the peak of a run.

    Attributes:
        volumes, rays, weights: number of copies of the volume, of the projections and of their weights.
        filtered: True if a filtered back-projection is also made.
    """

    volumes: float
    rays: float
    weights: float
    filtered: bool = False


def bytes_of(buffers: Buffers, geometry: Geometry, grid: Grid, weighted: bool = True) -> int:
    """Size of these buffers in bytes for some projections and voxels; weights count only if rays are `weighted`."""
    n_rays = geometry.n_views * math.prod(geometry.detector_shape)
    wide = max(geometry.detector_shape[1], grid.shape[2])
    volumes = buffers.volumes + (geometry.width.arc > 0)  # for the angles within one exposure
    rays = buffers.rays + bool(geometry.width) + bool(ViewResolution.of(geometry, grid).smoothed.any())
    rays += buffers.weights * weighted
    fbp_buffers = fbp_memory(geometry.n_views, wide) if buffers.filtered else 0
    return round(4 * (volumes * math.prod(grid.shape) + rays * n_rays)) + fbp_buffers


def difference_weights(grid: Grid) -> tuple[float, float, float]:
    """Weights of the differences along (y, x, z) that make total variation independent of the voxels' shape."""
    return 1.0, 1.0, grid.voxel_size / grid.spacing[0]


# the mirror images of the differences along y and x, without reflections in a point
_BACK = (0, 0), (1, 0), (0, 1), (1, 1)


class TotalVariationProx:
    """argmin_y ½|y - x|² + threshold TV(y), if wanted with y >= 0; isotropic TV, differences of voxels in 1/voxel.

    Each call makes a few steps of the dual problem (Chambolle 2004, J. Math. Imaging Vis. 20, 89; with the bound: Beck
    & Teboulle 2009, IEEE Trans. Image Process. 18, 2419). The dual field is kept from one call to the next. In an outer
    iteration x changes little, so later calls continue the steps. Memory: three volumes.

    The differences are those to the next voxels along the three axes. `turn` switches to the previous voxels along y, x
    or both of them.
    """

    def __init__(
        self, shape: tuple[int, int, int], weights: Weights, nonnegative: bool, steps: int,
        device: VoxelDevice[Any] = CPU,
    ) -> None:  # fmt: skip
        self._weights, self._nonnegative, self._steps, self._turn = weights, nonnegative, steps, 0
        self._device, self._dual, self._scratch = device, device.dual_field(shape), device.dual_scratch(shape)

    def __call__(self, x: Any, threshold: float) -> None:
        """Replace x [y, x, z], an array of the device, by the proximal point.

        `threshold`, 0 or more, is in the unit of x.
        """
        if threshold > 0:
            arguments, back = (threshold, self._weights, self._nonnegative, self._scratch), _BACK[self._turn]
            for _ in range(self._steps):
                self._device.dual_step(x, self._dual, *arguments, back)
            self._device.primal(x, self._dual, *arguments, x)
        elif self._nonnegative:
            x[x < 0] = 0

    def turn(self) -> None:
        """Use the differences of the next of four mirror images from now on, so that no side is preferred.

        The differences in the dual field do not change, only the assignment of three of them to each voxel.
        """
        self._turn = (self._turn + 1) % len(_BACK)
