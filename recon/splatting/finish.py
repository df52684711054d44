"""Finish: the volume of a fit, refined on voxels with the prior that views held out prefer.

Gaussians describe smooth matter in few parameters, and leave sharp edges, cracks and pores to the last: where a fit
ends, they are in its residual. On voxels a few sweeps over the views bring them back.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from recon.base.arrays import F32
from recon.base.decisions import Decisions, GoesOn
from recon.base.empirical import FEW_WILD, WILD_RAY
from recon.base.geometry import Geometry
from recon.base.method import ReconProblem, RunControl
from recon.base.stripes import ring_offsets
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.splatting.gaussians import Gaussians
from recon.splatting.settings import FitSettings
from recon.splatting.splat import project, voxel_means
from recon.voxels.iterative import TrialWatch, Watch, solve_views
from recon.voxels.methods import PnpDct
from recon.voxels.ordered_fista import MANY_SUBSETS, Subsets, ordered_fista, pull_methods, subsets_of
from recon.voxels.priors import NoiseBalance, pnp_dct
from recon.voxels.projector import Projector
from recon.voxels.trial import TV_STEPS, Trial, TrialSettings, choose_patches, choose_weight
from recon.voxels.voxel_problem import VoxelProblem

FINISH_SWEEPS = 8
"""Of total variation after a fit. Without a finish: -1.7 dB on a teapot (docs/published.md)."""

PULLED_SWEEPS = 16
"""Of a pull to few materials after these."""

_REACH = 1.5  # standard deviations of a Gaussian's longest axis


def beyond_voxels(gaussians: Gaussians, views: Geometry, grid: Grid, settings: FitSettings) -> F32 | None:
    """[view, row, col] the part of the views explained by Gaussians, but not by voxels of their volume; None: nothing.

    That is matter beyond the box: what Gaussians that reach there add to the views, but not to the voxels.
    Measured views alone would bend the volume, by -12 dB on a region of interest and -22 dB in the end slices of a
    thorax that goes on above the field.
    """
    import torch

    half = np.multiply(grid.shape, grid.spacing)[::-1] / 2
    reach = _REACH * gaussians.scales.max(dim=1, keepdim=True).values
    outside = (gaussians.means - torch.tensor(grid.centre[::-1])).abs() + reach > torch.from_numpy(half)
    gaussians = gaussians.select(outside.any(dim=1))
    if not gaussians.n:
        return None
    inside = voxel_means(gaussians, grid, views, truncation=settings.truncation).numpy()
    model = project(gaussians, views, truncation=settings.truncation, model=settings.rays).numpy()
    return model - Projector(views, grid).forward(np.maximum(inside, 0))


def level_of(beyond: F32) -> F32:
    """The mean of `beyond_voxels` in each view, [view, 1, 1], which is all that counts for a fit when it is judged.

    Gaussians far outside explain an air that is not at zero, where voxels cannot: a walnut in a cone whose air is 2 %
    of the largest line integral off loses 5.7 dB without that. What else they explain there is in no volume.
    """
    return beyond.mean(axis=(1, 2), keepdims=True)


def refine(problem: VoxelProblem, x: F32, weight: NoiseBalance | float, strength: float, sweeps: int) -> F32:
    """Sweeps of total variation from x [y, x, z], and steps with sparse patches where these have a strength."""
    count = subsets_of(problem.projector.geometry, MANY_SUBSETS, to_the_end=False)
    first, parts = GoesOn(problem.go_on), Subsets.of(problem, count, to_the_end=False)
    x = ordered_fista(replace(problem, go_on=first), x, weight, parts, sweeps=sweeps, tv_steps=TV_STEPS)
    if not (first.going and strength):
        return x
    further = replace(problem, go_on=lambda step, residual: problem.go_on(sweeps + step, residual))
    return pnp_dct(further, x, strength, steps=PnpDct.iterations)


@dataclass
class _Finish:
    """The refinement as an iterative method of `recon.voxels.iterative.solve`.

    Attributes:
        patches: these may follow.
        planned: sweeps, and steps with patches where these follow.
    """

    iterations: int
    patches: bool
    planned: int = 0

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        trial = cache(partial(Trial.of, problem, TrialSettings(early=True)))
        weight, strength = choose_weight(problem, x, self.iterations, trial), 0.0
        for method in pull_methods(iterations=PULLED_SWEEPS) if self.patches else ():
            if materials := method.materials(problem, weight, trial):
                self.planned, first = self.iterations + method.iterations, GoesOn(problem.go_on)
                x = refine(replace(problem, go_on=first), x, weight, strength, self.iterations)
                if not first.going:
                    return x
                return method.pulled(problem, x, weight, materials, self.iterations, to_the_end=False)
        if self.patches:
            patches = choose_patches(problem, weight, trial, PnpDct.iterations)
            strength = patches.strength if patches.better else 0.0
        self.planned = self.iterations + (PnpDct.iterations if strength else 0)
        return refine(problem, x, weight, strength, self.iterations)


class Finished(NamedTuple):
    """The refined volume, and the sweeps of total variation used for it; 0: it is the fit's."""

    volume: Volume
    sweeps: int


def finish(
    volume: Volume,
    gaussians: Gaussians,
    problem: ReconProblem,
    sweeps: int | None = None,
    settings: FitSettings | None = None,
    control: RunControl | None = None,
    nonnegative: bool = True,
) -> Finished:
    """The volume after `sweeps` over all views, starting from the volume of a fit.

    The sweeps see the measured views, not what the fit leaves of them, which is better by 0.5 to 2 dB. Matter beyond
    the box is taken off them before, see `beyond_voxels`.

    Single pixels that stand out in all views alike become rings. They are brought back to their neighbours first, see
    `ring_offsets`. Memory: 8 volumes and 5 times the projections.

    Args:
        volume: voxels of the Gaussians, 1/mm.
        gaussians: result of a fit to the views.
        problem: the views that were fitted, and the weights of their rays.
        sweeps: of total variation, 1 or more; None: 8, and a pull to few materials or steps with sparse patches where
            these predict views held out better.
        settings: of the fit; None: the defaults.
        control: gets each sweep, also those of trials, and is asked after it whether to stop. Its decisions may
            hold the prior.
        nonnegative: voxels below zero are clipped.

    Raises:
        ValueError: for shapes that disagree, or no sweeps.
    """
    fit, control = settings or FitSettings(), control or RunControl()
    prepared = _prepared(gaussians, problem, fit)
    if prepared is None:
        return Finished(volume, 0)
    start = Volume(np.maximum(volume.data, 0), volume.grid)
    projector = Projector(problem.geometry, volume.grid, device=problem.device)
    decide = control.decide or Decisions(problem.seed)
    beyond = beyond_voxels(gaussians, problem.geometry, volume.grid, fit)
    if beyond is not None:
        prepared = replace(prepared, data=prepared.data - beyond)
    n_views, count, made, begin = problem.geometry.n_views, sweeps or FINISH_SWEEPS, 0, control.now()
    method = _Finish(count, sweeps is None)

    def on_sweep(number: int, residual: float) -> bool:
        nonlocal made
        made = number
        control.report_progress(number, method.planned, begin, n_views, "sweeps on voxels")
        return control.stop()

    refined = solve_views(
        method, projector, prepared, start=start, nonnegative=nonnegative,
        watch=Watch(on_sweep, TrialWatch(control, n_views, PnpDct().trial_sweeps)), decide=decide,
        wide=problem.wide,
    )  # fmt: skip
    return Finished(refined, min(count, made))


def _prepared(gaussians: Gaussians, problem: ReconProblem, fit: FitSettings) -> Views | None:
    """Views without outliers and rings; None: these or those of the model are empty."""
    views = problem.views.masked()
    model = project(gaussians, views.geometry, truncation=fit.truncation, model=fit.rays).numpy()
    if not (views.data.any() and model.any()):
        return None
    views = _without_outliers(views, model)
    return replace(views, data=views.data - ring_offsets(views.data - model, views.geometry))


def _without_outliers(views: Views, model: F32) -> Views:
    """The views, with weight zero for single rays that differ from the model by as much as its matter.

    The fit, which counts absolute differences, is not led astray by them; squares would be.
    """
    wild = np.abs(views.data - model) > WILD_RAY * float(model.max())
    if not 0 < np.count_nonzero(wild) < FEW_WILD * wild.size:
        return views
    return views.weighed(~wild).masked()
