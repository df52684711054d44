"""The fit over an explicit state: init, step; it prints nothing, reads no clock, can stop after any step."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.base.volume import Grid, Volume
from recon.kernels.cpu.engine import Active
from recon.splatting.backend import Backend, Cpu, Pass
from recon.splatting.density_control import DensityPolicy, control
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import morton_order
from recon.splatting.problem import FitProblem, make_problem
from recon.splatting.settings import NAMES, FitSettings, tv_size, tv_weight
from recon.splatting.splat import voxelize

NORMALISE = 100  # steps between two normalisations of the quaternions


@dataclass(eq=False)
class FitState:
    """All that a step reads and changes; with the settings it is a complete checkpoint (see `checkpoint`).

    `step` updates the arrays in place: at 50k Gaussians copying them costs as much as the kernels. They live on the
    backend's device. `mean` is a running mean of the parameters, or None, see `anytime`.
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
    seen: int = 0
    loss: Any = float("nan")
    residual: Any = float("nan")
    mean: dict[str, Any] | None = None

    @property
    def n(self) -> int:
        return int(self.parameters["raw"].shape[0])


def problem_of(
    projections: F32,
    geometry: Geometry,
    grid: Grid,
    unit: float,
    settings: FitSettings,
    backend: Backend[Any] | None = None,
    weights: F32 | None = None,
) -> FitProblem:
    """The problem for these settings; see `make_problem`. None computes on the CPU."""
    return make_problem(
        projections, geometry, grid, unit, backend or Cpu(),
        weights=weights, loss=settings.loss, ssim_weight=settings.ssim_weight,
    )  # fmt: skip


def init(
    gaussians: Gaussians, seed: int | np.random.Generator, growth: float = 1.0, backend: Backend[Any] | None = None
) -> FitState:
    """A fresh state; the Gaussians are copied as float32, in an order that keeps neighbours together in memory.

    Raises:
        ValueError: for no Gaussians, or parameters that are not finite.
    """
    if gaussians.n == 0:
        raise ValueError("there are no Gaussians to start a fit from")
    arrays = gaussians.arrays()
    named = zip(NAMES, ("means", "log_scales", "quaternions", "raw_densities"), strict=True)
    parameters = {name: np.array(arrays[source], np.float32) for name, source in named}
    for name, values in parameters.items():
        if not np.isfinite(values).all():
            raise ValueError(f"{name} of the Gaussians hold {int((~np.isfinite(values)).sum())} values not finite")
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
    """One Adam step on one view (or a few); density control when it is due. Changes and returns `state`.

    Args:
        fraction: how far the schedule has come, 0..1; sets the learning rates and the window of density control.
        view: the first view to take; None draws it, as the others, without replacement.
    """
    p, geometry, backend, cut = state.parameters, problem.geometry, problem.backend, settings.truncation
    run = backend.begin(p["means"], p["log_scales"], p["quaternions"], p["raw"], 1 / problem.half_field, state.kernel)
    loss: Any = 0.0
    share = settings.views_per_step
    for k in range(share):
        chosen = _draw(state, geometry.n_views) if view is None or k else view
        target, weights = problem.images[chosen], problem.weights[chosen]
        seen = run.view(geometry, chosen, cut.faint, cut.sigmas, settings.rays)
        value, slope = problem.loss(seen.image, target, problem.target_maps[chosen], weights)
        state.residual = _running(state.residual, backend.misfit(seen.image, target, weights))
        if share > 1:
            slope /= share
        centres = seen.backward(slope)
        backend.add_lengths(centres, share * geometry.detector_shape[1] / 2, state.statistic)
        state.seen += 1
        loss = loss + value / share  # type: ignore[operator]
    weight = tv_weight(settings, problem, state.limit)
    if weight > 0:
        loss = loss + _smooth(state, problem, settings, weight, run)
    state.loss = _running(state.loss, loss)

    state.step += 1
    _update(state, run.gradients(), problem, settings, fraction)
    if state.step % NORMALISE == 0:
        _normalise_quaternions(state, backend)
    policy = settings.policy
    if policy is not None and state.step % policy.every == 0 and policy.start <= fraction < policy.stop:
        _grow(state, problem, policy)
    return state


def misfit_of(state: FitState, problem: FitProblem, settings: FitSettings) -> float:
    """||rendered - measured|| / ||measured|| over all views of a problem, root mean square of the views' own."""
    rendered = renders(state, problem, settings, range(problem.geometry.n_views))
    squares = [
        float(problem.backend.misfit(image, problem.images[view], problem.weights[view])) ** 2
        for view, image in enumerate(rendered)
    ]
    return float(np.mean(squares)) ** 0.5


def renders(state: FitState, problem: FitProblem, settings: FitSettings, views: Iterable[int]) -> Iterator[Any]:
    """The model's render of these views [row, col], in units of the problem's images, on its device."""
    p, cut = state.parameters, settings.truncation
    run = problem.backend.begin(
        p["means"], p["log_scales"], p["quaternions"], p["raw"], 1 / problem.half_field, state.kernel
    )
    for view in views:
        yield run.view(problem.geometry, view, cut.faint, cut.sigmas, settings.rays).image


def gaussians_of(state: FitState, backend: Backend[Any] | None = None) -> Gaussians:
    """A copy of the model."""
    import torch

    device = backend or Cpu()
    means, log_scales, quaternions, raw = (
        torch.from_numpy(device.numpy(state.parameters[name])) for name in NAMES
    )  # fmt: skip
    return Gaussians(means, log_scales, quaternions, raw, state.unit, state.kernel)


def volume_of(state: FitState, grid: Grid, settings: FitSettings, backend: Backend[Any] | None = None) -> Volume:
    """The model on a grid, 1/mm."""
    gaussians = gaussians_of(state, backend)
    return Volume(voxelize(gaussians, grid, truncation=settings.truncation).numpy(), grid)


def _order(parameters: dict[str, F32]) -> NDArray[np.int64]:
    """An order of the Gaussians in which neighbours in space follow each other."""
    return morton_order(parameters["means"], 4 * float(np.exp(np.median(parameters["log_scales"]))))


def _draw(state: FitState, n_views: int) -> int:
    if not state.drawn:
        state.drawn = state.rng.permutation(n_views).tolist()
    return state.drawn.pop()


def _running(mean: Any, value: Any) -> Any:
    # The first value is the mean; only a float can be the NaN of no value yet, so that a GPU need not be waited for.
    return value if isinstance(mean, float) and np.isnan(mean) else 0.95 * mean + 0.05 * value


def _smooth(state: FitState, problem: FitProblem, settings: FitSettings, weight: float, run: Pass[Any]) -> Any:
    """Total variation on a random box of voxels, in normalised density."""
    grid = problem.grid
    side = tv_size(settings, grid)
    size = tuple(min(side, n) for n in grid.shape)
    corner = [int(state.rng.integers(0, n - s + 1)) for n, s in zip(grid.shape, size, strict=True)]
    box = grid.part(*(slice(c, c + s) for c, s in zip(corner, size, strict=True)))
    cut = settings.truncation
    found = run.box(box, cut.faint / problem.half_field, cut.sigmas)
    half = np.float32(problem.half_field)
    loss, slope = problem.backend.total_variation(found.density * half, weight)
    found.backward(slope * half, means_too=settings.tv_moves)
    return loss


def _update(
    state: FitState, gradients: tuple[Any, ...], problem: FitProblem, settings: FitSettings, fraction: float
) -> None:
    shrink = settings.pace * settings.decay**fraction
    rates = [
        rate * shrink * (problem.half_field if name == "means" else 1.0)
        for name, rate in zip(NAMES, settings.rates, strict=True)
    ]
    parameters, first, second = (
        [arrays[name] for name in NAMES] for arrays in (state.parameters, state.first, state.second)
    )
    smallest = settings.smallest * problem.geometry.sample_pitch
    widths = (float(np.log(smallest)), float(np.log(problem.half_field)))
    problem.backend.adam(parameters, gradients, first, second, rates, state.step, (None, widths, None, None))


def _normalise_quaternions(state: FitState, backend: Backend[Any]) -> None:
    """Quaternions of length 1 that turn as before, with Adam's moments in their measure.

    A gradient is orthogonal to its quaternion, so that every step makes the quaternion longer and the next turn
    smaller. Without this it is twice as long after 30 000 steps. Quaternions without a direction stay as they are.
    """
    values = backend.numpy(state.parameters["quaternions"]).astype(np.float64)
    length = np.linalg.norm(values, axis=1, keepdims=True)
    length[length < 1e-12] = 1
    state.parameters["quaternions"] = backend.array((values / length).astype(np.float32))
    for moments, power in ((state.first, 1), (state.second, 2)):
        scaled = backend.numpy(moments["quaternions"]) * length**power
        moments["quaternions"] = backend.array(scaled.astype(np.float32))


def _grow(state: FitState, problem: FitProblem, policy: DensityPolicy) -> None:
    backend = problem.backend
    p = {name: backend.numpy(state.parameters[name]) for name in NAMES}
    active = Active.of(p["means"], p["log_scales"], p["quaternions"], p["raw"], 1.0)
    statistic = backend.numpy(state.statistic) / np.float32(max(1, state.seen))
    change = control(
        (p["means"], p["log_scales"], active.rotations, p["raw"]), statistic, policy,
        2 * problem.half_field, state.limit, problem.grid.edges, state.rng,
    )  # fmt: skip
    origin = np.concatenate((change.keep, change.parents))
    fresh = change.keep.size
    if origin.size == 0:
        return  # all Gaussians are faint, as in empty views: later views may need them
    grown = {
        "means": change.means,
        "log_scales": change.log_scales,
        "quaternions": p["quaternions"][origin],
        "raw": change.raw,
    }
    order = _order(grown)
    if state.mean is not None:
        for name, new in grown.items():
            mean = backend.numpy(state.mean[name])[origin]
            changed = new != p[name][origin]  # parents of splits and clones; their other halves are new, too
            changed[fresh:] = True
            state.mean[name] = backend.array(np.where(changed, new, mean)[order])
    state.parameters = {name: backend.array(values[order]) for name, values in grown.items()}
    for moments in (state.first, state.second):
        for name in NAMES:
            values = backend.numpy(moments[name])[origin]
            values[fresh:] = 0  # copies start without momentum
            moments[name] = backend.array(values[order])
    state.statistic = backend.array(np.zeros(state.n, np.float32))
    state.seen = 0
