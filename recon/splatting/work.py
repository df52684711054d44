"""The work of a fit of Gaussians, as `recon.base.work` counts it."""

from __future__ import annotations

import math

from recon.assess.plans import Speeds
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.base.work import CLOCK, Costs, Rates, Work
from recon.splatting.finish import FINISH_SWEEPS, FIRST_SHARE, SUBSETS, TV_STEPS
from recon.splatting.fit_method import FitMethod
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import SCALED_BY, count_for, joined_for, start_method
from recon.splatting.settings import FitSettings, growth
from recon.voxels.direct import direct_work
from recon.voxels.held_out import LEAST_VIEWS
from recon.voxels.methods import FistaTv, PnpDct
from recon.voxels.priors import TRIAL_STEPS, subsets_of
from recon.voxels.work import fista_sweeps, patch_choice, patch_steps, power_rounds, trial_part, weight_choice

_RENDER = 1 / 3  # of a view's share in a step, which renders it, and goes back for the gradient


def covered(voxels: float, gaussians: float) -> float:
    """In proportion to the pixels that Gaussians cover in a view, whose widths are their distances."""
    return float(voxels ** (2 / 3) * gaussians ** (1 / 3))


def fit_costs(method: FitMethod, geometry: Geometry, grid: Grid) -> Costs:
    """The work of `train.run_fit`."""
    if method.planned_steps is None:
        return Costs({method.name: Work.of(CLOCK, method.seconds or 0.0)})
    weight, patches = weight_choice(geometry, grid), patch_choice(geometry, grid)
    fit = _fit(method, geometry, grid, method.planned_steps)
    if not method.by_content or geometry.n_views < LEAST_VIEWS:
        if method.finish_sweeps == 0:
            return Costs({method.name: fit})
        choice = weight + patches if method.finish is None else weight
        return Costs({method.name: fit + _finish(method, geometry, grid)}, choice)
    short = _fit(method, geometry, grid, method.least_steps or 0)
    volumes = {method.name: fit + _finish(method, geometry, grid)}
    for other in (FistaTv(), PnpDct()):
        volumes[other.name] = short + other.costs(geometry, grid).volumes[other.name]
    trial = Work()
    if (part := trial_part(geometry, grid)) is not None:
        share = part[0].detector_shape[0] / geometry.detector_shape[0]
        own = method.for_trial(share, FIRST_SHARE)
        refined = fista_sweeps(*part, FINISH_SWEEPS, SUBSETS, TV_STEPS) + patch_steps(*part, TRIAL_STEPS)
        trial = _fit(own, *part, own.planned_steps or 0) + refined + _rendered(own, *part)
    return Costs(volumes, weight + patches + trial)


def _fit(method: FitMethod, geometry: Geometry, grid: Grid, steps: int) -> Work:
    """From the first volume to that of the Gaussians."""
    cone = geometry.is_cone
    field = Grid.for_fit(geometry, grid)
    voxels, usual = math.prod(field.shape), count_for(field, cone)
    given = method.gaussians.n if isinstance(method.gaussians, Gaussians) else method.gaussians
    count = given or usual
    joined = method.fit.joined_pixels or joined_for(field, cone, max(count, usual), geometry.detector_shape)
    first = start_method(geometry, method.start)
    start = direct_work(geometry, field) if first is None else first.costs(geometry, field).volumes[first.name]
    rays = geometry.n_views * math.prod(geometry.detector_shape) / joined**2
    start = start * (1 / joined**3) + Work.of("draw", count, voxels / joined**3)
    start += Work.of("views", geometry.n_views, rays)
    views = steps * method.fit.views_per_step + _RENDER * SCALED_BY
    grown = count * (1 + growth(method.fit)) / 2
    fill = Work.of("fill", grown, math.prod(grid.shape))
    return start + views * _view(method, geometry, voxels / joined**3, grown) + fill


def _view(method: FitMethod, geometry: Geometry, voxels: float, gaussians: float) -> Work:
    """A view of a step of a fit."""
    reach = method.fit.kernel.reach(method.fit.truncation.sigmas) / FitSettings().kernel.radius
    return Work.of(f"view, {'cone' if geometry.is_cone else 'parallel'}", 1, covered(voxels, gaussians) * reach**2)


def _rendered(method: FitMethod, geometry: Geometry, grid: Grid) -> Work:
    """All views of the Gaussians, and once more of what no voxels explain."""
    field = Grid.for_fit(geometry, grid)
    count = method.gaussians if isinstance(method.gaussians, int) else count_for(field, geometry.is_cone)
    return 2 * _RENDER * geometry.n_views * _view(method, geometry, math.prod(field.shape), count)


def _finish(method: FitMethod, geometry: Geometry, grid: Grid) -> Work:
    """The refinement on voxels, with steps of sparse patches where these may follow."""
    refined = power_rounds(geometry, grid, subsets_of(geometry, SUBSETS)) + _rendered(method, geometry, grid)
    refined += fista_sweeps(geometry, grid, method.finish_sweeps, SUBSETS, TV_STEPS)
    if method.finish is not None:
        return refined
    return refined + patch_steps(geometry, grid, PnpDct().iterations)


def speeds_of(geometry: Geometry, grid: Grid, rates: Rates) -> Speeds:
    """Seconds of each part of a reconstruction on this machine; `recon.assess.plans` chooses by them."""
    field = Grid.for_fit(geometry, grid)
    voxels, count = math.prod(field.shape), count_for(field, geometry.is_cone)
    view = Work.of(f"view, {'cone' if geometry.is_cone else 'parallel'}", 1, covered(voxels, count))
    first = start_method(geometry, "fbp")
    volume = direct_work(geometry, field) if first is None else first.costs(geometry, field).volumes[first.name]
    start = Work.of("draw", count, voxels) + _RENDER * SCALED_BY * view
    try:
        sweep = fista_sweeps(geometry, grid, 1, SUBSETS, TV_STEPS).seconds(rates)
        trials = weight_choice(geometry, grid).seconds(rates) if geometry.n_views >= LEAST_VIEWS else 0.0
    except ValueError:  # voxels do not take these views
        sweep, trials = math.inf, 0.0
    step, fill = FitSettings().views_per_step * view, Work.of("fill", count, math.prod(grid.shape))
    return Speeds(
        volume.seconds(rates), start.seconds(rates), step.seconds(rates), fill.seconds(rates), sweep, trials
    )  # fmt: skip
