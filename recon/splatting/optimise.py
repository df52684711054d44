"""The steps of a fit, as functions on an explicit state: init and step. They print nothing, read no clock, and a fit
can stop after any step."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.base.registry import loaded
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.kernels.cpu.engine import Active
from recon.kernels.fused_step import FusedStep, StepInputs, StepModel, StepPlan
from recon.splatting.backend import Backend, Cpu, Pass
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import morton_order
from recon.splatting.problem import FitProblem, make_problem
from recon.splatting.settings import NAMES, DensityPolicy, FitSettings, control, tv_size, tv_weight
from recon.splatting.splat import voxel_means

NORMALISE = 100  # number of steps between two normalisations of the quaternions


@dataclass(eq=False)
class FitState:
    """Everything that a step reads and changes. The state and the settings together are a complete checkpoint (see
    `checkpoint`).

    `step` updates the arrays in place, because for 50k Gaussians a copy takes as long as the kernels. The arrays are on
    the device of the backend. `mean` is a running mean of the parameters or None, see `anytime`. If `fused` makes the
    steps, the arrays may lack the latest steps until `settle` is called.
    """

    parameters: dict[str, Any]
    first: dict[str, Any]
    second: dict[str, Any]
    statistic: Any
    unit: float
    rng: np.random.Generator
    limit: int
    kernel: Kernel = Kernel.GAUSSIAN
    step: int = 0
    drawn: list[int] = field(default_factory=list)
    views_shown: int = 0
    loss: Any = float("nan")
    residual: Any = float("nan")
    mean: dict[str, Any] | None = None
    fused: FusedStep | None = None

    @property
    def n(self) -> int:
        return int(self.parameters["raw"].shape[0])


def problem_of(
    views: Views, grid: Grid, unit: float, settings: FitSettings, backend: Backend[Any] | None = None
) -> FitProblem:
    """The problem of a fit with these settings; see `make_problem`. If `backend` is None, the fit runs on the CPU."""
    return make_problem(views, grid, unit, backend or Cpu(), loss=settings.loss, ssim_weight=settings.ssim_weight)


def init(
    gaussians: Gaussians, seed: int | np.random.Generator, growth: float = 1.0, backend: Backend[Any] | None = None
) -> FitState:
    """A new state. The Gaussians are copied as float32, in an order that keeps neighbours together in memory.

    Raises:
        ValueError: there are no Gaussians, or parameters are not finite.
    """
    if gaussians.n == 0:
        raise ValueError("a fit needs at least one Gaussian to start from")
    arrays = gaussians.arrays()
    named = zip(NAMES, ("means", "log_scales", "quaternions", "raw_densities"), strict=True)
    parameters = {name: np.array(arrays[source], np.float32) for name, source in named}
    for name, values in parameters.items():
        if not np.isfinite(values).all():
            raise ValueError(f"{name} of the Gaussians: {int((~np.isfinite(values)).sum())} values are not finite")
    order = _order(parameters)
    device = backend or Cpu()
    return FitState(
        {k: device.array(v[order]) for k, v in parameters.items()},
        {k: device.array(np.zeros_like(v)) for k, v in parameters.items()},
        {k: device.array(np.zeros_like(v)) for k, v in parameters.items()},
        device.array(np.zeros(gaussians.n, np.float32)),
        gaussians.density_unit,
        np.random.default_rng(seed),
        limit=max(gaussians.n, round(gaussians.n * growth)),
        kernel=gaussians.kernel,
    )


def step(
    state: FitState, problem: FitProblem, settings: FitSettings, fraction: float, view: int | None = None
) -> FitState:
    """Make one Adam step on one projection (or a few), and density control when it is due. The function changes `state`
    and returns it.

    Args:
        fraction: position in the schedule, 0 to 1. The learning rates depend on it, and whether density control is
            active.
        view: the first projection to use; the others are drawn without replacement. None: all are drawn without
            replacement.
    """
    views = [
        _draw(state, problem.geometry.n_views) if view is None or k else view for k in range(settings.views_per_step)
    ]
    weight = tv_weight(settings, problem, state.limit)
    box = _RandomBox.of(state, problem.grid, tv_size(settings, problem.grid)) if weight > 0 else None
    state.step += 1
    update = _Update.of(state, problem, settings, fraction)
    fused = _fused(state, problem, settings, update, box)
    if fused is None:
        _by_operations(state, problem, settings, views, box, weight, update)
    else:
        images, maps, weights = (
            [arrays[k] for k in views] for arrays in (problem.images, problem.target_maps, problem.weights)
        )
        corner, of_variation = (0.0, 0.0, 0.0) if box is None else box.first(problem.grid), weight * problem.half_field
        fused.run(
            StepInputs(problem.geometry, views, images, maps, weights, corner, of_variation, update.rates, state.step)
        )
        state.loss, state.residual = fused.loss, fused.residual
    state.views_shown += len(views)
    if state.step % NORMALISE == 0:
        # A gradient is orthogonal to its quaternion, so every step makes the quaternion longer and the next rotation
        # smaller. Without normalisation, quaternions are twice as long after 30 000 steps.
        settle(state)
        quaternions = (arrays["quaternions"] for arrays in (state.parameters, state.first, state.second))
        problem.backend.unit_quaternions(*quaternions)
    policy = settings.policy
    if policy is not None and state.step % policy.every == 0 and policy.start <= fraction < policy.stop:
        _grow(state, problem, policy)
    return state


class _RandomBox(NamedTuple):
    """The box of voxels for the total variation of a step: its first voxel (z, y, x), and the number of voxels along
    each axis.

    It is not a `Grid`, because the checks of a `Grid` take as long as the step takes on a GPU.
    """

    corner: tuple[int, ...]
    shape: tuple[int, int, int]

    @classmethod
    def of(cls, state: FitState, grid: Grid, side: int) -> _RandomBox:
        z, y, x = (min(side, n) for n in grid.shape)
        corner = tuple(int(state.rng.integers(0, n - s + 1)) for n, s in zip(grid.shape, (z, y, x), strict=True))
        return cls(corner, (z, y, x))

    def first(self, grid: Grid) -> tuple[float, float, float]:
        """The centre (z, y, x) of the first voxel in mm."""
        z, y, x = (f + c * edge for f, c, edge in zip(grid.first, self.corner, grid.spacing, strict=True))
        return z, y, x

    def grid(self, grid: Grid) -> Grid:
        return grid.part(*(slice(c, c + n) for c, n in zip(self.corner, self.shape, strict=True)))


@dataclass(frozen=True)
class _Update:
    """Rates and bounds of the four parameters in one step."""

    rates: tuple[float, ...]
    bounds: tuple[tuple[float, float] | None, ...]

    @classmethod
    def of(cls, state: FitState, problem: FitProblem, settings: FitSettings, fraction: float) -> _Update:
        shrink = settings.pace * settings.decay**fraction
        rates = tuple(
            rate * shrink * (problem.half_field if name == "means" else 1.0)
            for name, rate in zip(NAMES, settings.rates, strict=True)
        )
        smallest = settings.smallest * problem.geometry.sample_pitch
        widths = (float(np.log(smallest)), float(np.log(problem.half_field)))
        return cls(rates, (None, widths, None, None))


def _fused(
    state: FitState, problem: FitProblem, settings: FitSettings, update: _Update, box: _RandomBox | None
) -> FusedStep | None:
    """The fused step of this state on the device. The same fused step is used again as long as its plan is the same."""
    shape, fused_before = None if box is None else box.shape, state.fused
    key = (
        problem.loss, problem.grid, settings.truncation, settings.rays, settings.views_per_step,
        settings.tv_moves, update.bounds, shape, any(weights is not None for weights in problem.weights),
    )  # fmt: skip
    raw = state.parameters[NAMES[-1]]
    if fused_before is not None and fused_before.plan.key == key and fused_before.model.parameters[-1] is raw:
        return fused_before
    settle(state)
    truncation = settings.truncation
    small_grid = None if box is None else replace(box.grid(problem.grid), centre=(0.0, 0.0, 0.0))
    plan = StepPlan(
        key, problem.geometry, state.kernel, settings.rays, 1 / problem.half_field, truncation.faint, truncation.sigmas,
        settings.views_per_step, problem.loss, key[-1], small_grid, truncation.faint / problem.half_field,
        settings.tv_moves, update.bounds,
    )  # fmt: skip
    parameters, first, second = (
        tuple(arrays[name] for name in NAMES) for arrays in (state.parameters, state.first, state.second)
    )
    model = StepModel(parameters, first, second, state.statistic, state.loss, state.residual)
    state.fused = problem.backend.fused_step(model, plan, fused_before)
    return state.fused


def settle(state: FitState) -> None:
    """Wait until the arrays of a state include all of its steps. Call it before reading them."""
    if state.fused is not None:
        state.fused.settle()


def _by_operations(
    state: FitState, problem: FitProblem, settings: FitSettings, views: Sequence[int], box: _RandomBox | None,
    weight: float,
    update: _Update,
) -> None:  # fmt: skip
    """One step, operation by operation."""
    p, geometry, backend, truncation = state.parameters, problem.geometry, problem.backend, settings.truncation
    run = backend.begin(p["means"], p["log_scales"], p["quaternions"], p["raw"], 1 / problem.half_field, state.kernel)
    loss: Any = 0.0
    share = len(views)
    for view in views:
        target, weights = problem.images[view], problem.weights[view]
        rendered = run.view(geometry, view, truncation.faint, truncation.sigmas, settings.rays)
        value, slope = problem.loss(rendered.image, target, problem.target_maps[view], weights)
        state.residual = _running(state.residual, backend.misfit(rendered.image, target, weights))
        if share > 1:
            slope /= share
        centres = rendered.backward(slope)
        backend.add_lengths(centres, share * geometry.detector_shape[1] / 2, state.statistic)
        loss = loss + value / share  # type: ignore[operator]
    if box is not None:
        loss = loss + _smooth(problem, settings, weight, run, box.grid(problem.grid))
    state.loss = _running(state.loss, loss)
    parameters, first, second = (
        [arrays[name] for name in NAMES] for arrays in (state.parameters, state.first, state.second)
    )
    backend.adam(parameters, run.gradients(), first, second, update.rates, state.step, update.bounds)


def misfit_of(state: FitState, problem: FitProblem, settings: FitSettings) -> float:
    """||rendered - measured|| / ||measured||: root mean square over all projections of a problem."""
    rendered = renders(state, problem, settings, range(problem.geometry.n_views))
    squares = [
        float(problem.backend.misfit(image, problem.images[view], problem.weights[view])) ** 2
        for view, image in enumerate(rendered)
    ]
    return float(np.mean(squares)) ** 0.5


def renders(state: FitState, problem: FitProblem, settings: FitSettings, views: Iterable[int]) -> Iterator[Any]:
    """The projections [row, col] of the model, in units of the problem's images, on its device."""
    settle(state)
    p, truncation = state.parameters, settings.truncation
    run = problem.backend.begin(
        p["means"], p["log_scales"], p["quaternions"], p["raw"], 1 / problem.half_field, state.kernel
    )
    for view in views:
        yield run.view(problem.geometry, view, truncation.faint, truncation.sigmas, settings.rays).image


def gaussians_of(state: FitState, backend: Backend[Any] | None = None) -> Gaussians:
    """A copy of the model."""
    settle(state)
    torch, device = loaded("torch"), backend or Cpu()
    means, log_scales, quaternions, raw = (torch.from_numpy(device.numpy(state.parameters[name])) for name in NAMES)
    return Gaussians(means, log_scales, quaternions, raw, state.unit, state.kernel)


def volume_of(state: FitState, grid: Grid, views: Geometry, settings: FitSettings) -> Volume:
    """The `voxel_means` of a model that was fitted to these projections, 1/mm."""
    return Volume(voxel_means(gaussians_of(state), grid, views, truncation=settings.truncation).numpy(), grid)


def _order(parameters: dict[str, F32]) -> NDArray[np.int64]:
    """An order of the Gaussians in which neighbours in space are next to each other."""
    return morton_order(parameters["means"], 4 * float(np.exp(np.median(parameters["log_scales"]))))


def _draw(state: FitState, n_views: int) -> int:
    if not state.drawn:
        state.drawn = state.rng.permutation(n_views).tolist()
    return state.drawn.pop()


def _running(mean: Any, value: Any) -> Any:
    # The first value is the mean. Only a Python float can be the NaN for "no value yet", so a GPU need not be waited
    # for.
    return value if isinstance(mean, float) and np.isnan(mean) else 0.95 * mean + 0.05 * value


def _smooth(problem: FitProblem, settings: FitSettings, weight: float, run: Pass[Any], box: Grid) -> Any:
    """Total variation of the normalised density on a box of voxels."""
    truncation = settings.truncation
    filled = run.box(box, truncation.faint / problem.half_field, truncation.sigmas)
    half_field = np.float32(problem.half_field)
    loss, slope = problem.backend.total_variation(filled.density * half_field, weight)
    filled.backward(slope * half_field, means_too=settings.tv_moves)
    return loss


def _grow(state: FitState, problem: FitProblem, policy: DensityPolicy) -> None:
    settle(state)
    backend = problem.backend
    p = {name: backend.numpy(state.parameters[name]) for name in NAMES}
    active = Active.of(p["means"], p["log_scales"], p["quaternions"], p["raw"], 1.0)
    statistic = backend.numpy(state.statistic) / np.float32(max(1, state.views_shown))
    change = control(
        (p["means"], p["log_scales"], active.rotations, p["raw"]), statistic, policy,
        2 * problem.half_field, state.limit, problem.grid.edges, state.rng,
    )  # fmt: skip
    origin = np.concatenate((change.keep, change.parents))
    first_new = change.keep.size
    if origin.size == 0:
        return  # all Gaussians are faint, for example in empty projections; later projections may need them
    parts = change.means, change.log_scales, p["quaternions"][origin], change.raw
    grown = dict(zip(NAMES, parts, strict=True))
    order = _order(grown)
    if state.mean is not None:
        for name, new in grown.items():
            mean = backend.numpy(state.mean[name])[origin]
            changed = new != p[name][origin]  # parents of splits and clones; the second halves are new, too
            changed[first_new:] = True
            state.mean[name] = backend.array(np.where(changed, new, mean)[order])
    state.parameters = {name: backend.array(values[order]) for name, values in grown.items()}
    origin[first_new:] = -1  # the new Gaussians start without momentum
    for moments in (state.first, state.second):
        for name in NAMES:
            moments[name] = backend.taken(moments[name], origin[order])
    state.statistic = backend.array(np.zeros(state.n, np.float32))
    state.views_shown = 0
