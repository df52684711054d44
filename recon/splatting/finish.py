"""finish: the volume of a fit, refined on voxels with the prior that views held out prefer.

Gaussians describe smooth matter in few parameters, and leave sharp edges, cracks and pores to the last: where a fit
ends, they are in its residual. On voxels a few sweeps over the views bring them back. Where voxels alone predict views
held out as well, their own volume is taken, and the fit is short.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from recon.base.arrays import F32, F64
from recon.base.decisions import Decisions, GoesOn
from recon.base.empirical import DEFAULT_STEPS, FEW_WILD, WILD_RAY
from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.method import DataUse, ReconProblem, Reconstruction, RunControl, sweeps_of_trials
from recon.base.noise import ring_offsets
from recon.base.volume import Grid, Volume
from recon.splatting.gaussians import Gaussians
from recon.splatting.settings import FitSettings
from recon.splatting.splat import project, voxel_means
from recon.voxels.held_out import LEAST_GAIN, MOST_TRIALS, HeldOutTrial, cheapest_not_led, choose_weight, leads
from recon.voxels.iterative import Watch, prior_decisions, solve
from recon.voxels.methods import PnpDct, choose_patches, residuals_of_patches
from recon.voxels.priors import NoiseBalance, Subsets, ordered_fista, pnp_dct
from recon.voxels.projector import Projector, projection_images, projection_lines, volume_lines
from recon.voxels.voxel_problem import VoxelProblem

FINISH_SWEEPS = 8
"""Of total variation after a fit. Without a finish: -1.7 dB on a teapot (docs/published.md)."""

FAR_BEHIND = 0.25
"""Of a trial fit's residual: total variation that leaves so much less ends the trial at the first look. Without: half
as much time again. Of 17 scans two fits win, whose residuals are 1.17 and 1.22 times those of total variation there;
ten others have 1.45 times and more, and end."""

FIRST_SHARE = 0.25
"""Of the steps of a trial fit, after which it is looked at first. Without: 0.9 CPU s more, of 3."""

SUBSETS, TV_STEPS = 9, 3
_REACH = 1.5  # standard deviations of a Gaussian's longest axis


class _Watch:
    """Reports sweeps, and asks whether to stop.

    Attributes:
        ended: the last answer was yes.
        made: sweeps and steps on voxels so far, without those of trials.
    """

    def __init__(self, control: RunControl, n_views: int, fits: bool = False) -> None:
        usual, refined = PnpDct().trial_sweeps, FINISH_SWEEPS + PnpDct.iterations
        first, whole = (round(share * DEFAULT_STEPS) + refined if fits else 0 for share in (FIRST_SHARE, 1.0))
        self._planned = usual + first, round(MOST_TRIALS * usual) + first + whole
        self._control, self._n_views = control, n_views
        self._begin, self._trials, self.made, self.ended = control.now(), 0, 0, False

    def asked(self) -> bool:
        self.ended = self._control.stop()
        return self.ended

    def trial(self) -> bool:
        if self._control.stop_trials is not None and self._control.stop_trials():
            return True
        self._trials += 1
        return self.sweep(self._trials, *sweeps_of_trials(self._trials, *self._planned))

    def refined(self, number: int, of: int) -> bool:
        self.made = number
        return self.sweep(number, of, "sweeps on voxels")

    def sweep(self, number: int, of: int, unit: str) -> bool:
        self._control.tell_part(number, of, self._begin, self._n_views, unit)
        return self.asked()


Fit = Callable[[ReconProblem, RunControl, float], Reconstruction]
"""A fit without a finish, with this share of its steps; its result holds Gaussians."""


@dataclass(eq=False)
class Candidates:
    """Residuals [view] of held-out views for each candidate; None: not tried.

    Attributes:
        direct, smooth, patches, fit: FBP, total variation, sparse patches, and a fit that these refine.
        prior: decisions on the prior of the winner.
        full_trial_seconds: of a trial with all steps of the fit, where it ended after a quarter; 0: it needed no more.
    """

    direct: F64 | None = None
    smooth: F64 | None = None
    patches: F64 | None = None
    fit: F64 | None = None
    prior: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    full_trial_seconds: float = 0.0

    @property
    def by_voxels(self) -> F64 | None:
        """The smaller residual of the two priors."""
        tried = [each for each in (self.smooth, self.patches) if each is not None]
        return min(tried, key=lambda each: float(each.mean()), default=None)


@dataclass
class _Planning:
    """The trials as an iterative method of `recon.voxels.iterative.solve`; the volume stays as it is.

    Attributes:
        wide: as of `ReconProblem`.
        least_gain: as of `cheapest_not_led`.
        apart: the fit takes matter beyond the box off the views.
    """

    fit: Fit
    control: RunControl
    settings: FitSettings
    wide: bool
    least_gain: float
    iterations: int = 1
    tried: Candidates = field(default_factory=Candidates)
    apart: bool = False

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        judge = HeldOutTrial.of(problem)
        if judge is None:
            return x
        weight = choose_weight(problem, x, FINISH_SWEEPS, lambda: judge)
        if isinstance(weight, NoiseBalance):
            return x
        patches, tried = choose_patches(problem, weight, lambda: judge, PnpDct.iterations), self.tried
        tried.direct = judge.residuals(judge.start) if judge.direct and not judge.ended else None
        tried.smooth = judge.of_weight(weight)
        if patches.better:
            tried.patches = residuals_of_patches(judge, judge.start, PnpDct.iterations, patches.strength)
        if (voxels := tried.by_voxels) is None:  # the trials were ended
            return x
        strength = patches.strength if patches.better else 0.0
        begin = self.control.now()
        tried.fit = self.of_fit(judge, weight, strength, FIRST_SHARE)
        if tried.fit is None or leads(tried.fit, voxels, self.least_gain):
            return x
        if self.least_gain > 0 and leads(tried.smooth, tried.fit, FAR_BEHIND):
            tried.full_trial_seconds = (self.control.now() - begin) / FIRST_SHARE
        else:
            tried.fit = self.of_fit(judge, weight, strength, 1.0)
        return x

    def of_fit(self, trial: HeldOutTrial, weight: float, strength: float, share: float) -> F64 | None:
        """Residuals [view held out] of a fit of the trial's views, refined with the prior; None: it refuses them.

        Total variation refines it. Only where that leaves less than total variation alone do patches follow, which cost
        four times as much: else they would not lead patches either.
        """
        part, whole = trial.problem, trial.all_columns.seen()
        seen, cols = whole.projector, trial.all_columns.cols
        weights = None if whole.weight is None else projection_images(whole.weight)
        data, use = projection_images(whole.views), DataUse(weights)
        views = ReconProblem(data, seen.geometry, seen.grid, use, 0, seen.device, self.wide)
        control = RunControl(lambda: not part.go_on(0, 0.0), now=self.control.now)
        try:
            fitted = self.fit(views, control, share)
        except ValueError:  # no matter in these rows
            return None
        beyond, other = (
            None if views is None else np.ascontiguousarray(projection_lines(views)[:, cols])
            for views in (
                beyond_voxels(fitted.gaussians, geometry, fitted.volume.grid, self.settings)
                for geometry in (seen.geometry, trial.all_columns.unseen)
            )
        )
        start = volume_lines(np.maximum(_middle_of(fitted.volume.data, part.projector.grid.shape), 0))

        def by(strength: float) -> F64:
            refined = trial.volume_by(
                lambda some, x: refine(_without(some, beyond), x, weight, strength, FINISH_SWEEPS), start
            )
            return trial.residuals(refined, None if other is None else level_of(other))

        residuals = by(0.0)
        if strength and residuals.mean() < trial.of_weight(weight).mean():
            residuals = by(strength)
        taken = 0.0 if other is None else math.sqrt(np.mean(np.square(other, dtype=np.float64)))
        self.apart = taken > residuals.mean()
        return None if trial.ended else residuals


def _middle_of(volume: F32, shape: tuple[int, int, int]) -> F32:
    """The middle of a volume [z, y, x], as large as `shape`."""
    y, x = ((many - few) // 2 for many, few in zip(volume.shape[1:], shape[1:], strict=True))
    return volume[:, y : y + shape[1], x : x + shape[2]]


def _without(problem: VoxelProblem, beyond: F32 | None) -> VoxelProblem:
    return problem if beyond is None else replace(problem, data=problem.data - beyond)


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
    first, parts = GoesOn(problem.go_on), Subsets.of(problem, SUBSETS)
    x = ordered_fista(replace(problem, go_on=first), x, weight, parts, sweeps=sweeps, tv_steps=TV_STEPS)
    if not (first.going and strength):
        return x
    further = replace(problem, go_on=lambda step, residual: problem.go_on(sweeps + step, residual))
    return pnp_dct(further, x, strength, steps=PnpDct.iterations)


def judged(
    problem: ReconProblem, settings: FitSettings, control: RunControl, fit: Fit, least_gain: float = LEAST_GAIN
) -> Candidates:
    """Residuals of held-out views with total variation, sparse patches and a fit, and the decisions on their prior.

    The trials see sixteen rows. Each candidate predicts views by its voxels, a fit also by the level of what it has
    beyond these. A fit of all views would know the views held out, so this one is of its own. It ends after a quarter
    of its steps where it then leads voxels, or is far behind them.

    Args:
        fit: makes the fit of a trial.
        least_gain: as of `cheapest_not_led`; 0: a fit that voxels lead takes all of its steps, too.

    No prior is named where nothing can be held out, or `control` ends the trials, nor for a fit that takes
    matter beyond the box off the views: from all of them a region of interest gets one that costs 1.3 dB.
    """
    data, weights = masked(problem.projections, problem.use.weights)
    if not data.any():
        return Candidates()
    watch, decide = _Watch(control, problem.geometry.n_views, fits=True), Decisions(problem.seed)
    method = _Planning(fit, control, settings, problem.wide, least_gain)
    projector = Projector(problem.geometry, problem.grid, device=problem.device)
    solve(method, projector, data, weight=weights, watch=Watch(on_trial=watch.trial), decide=decide)
    tried = method.tried
    if watch.ended or tried.smooth is None:
        return Candidates()
    fits = cheapest_not_led((tried.smooth, tried.patches, tried.fit), least_gain) == 2
    return replace(tried, prior={} if fits and method.apart else prior_decisions(decide.made))


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
        trial = cache(partial(HeldOutTrial.of, problem))
        weight, strength = choose_weight(problem, x, self.iterations, trial), 0.0
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
        sweeps: of total variation, 1 or more; None: 8, and steps with sparse patches where these predict
            views held out better.
        settings: of the fit; None: the defaults.
        control: gets each sweep, also those of trials, and is asked after it whether to stop. Its decisions may
            hold the prior, see `judged`.
        nonnegative: voxels below zero are clipped.

    Raises:
        ValueError: for shapes that disagree, or no sweeps.
    """
    fit, control = settings or FitSettings(), control or RunControl()
    prepared = _prepared(gaussians, problem, fit)
    if prepared is None:
        return Finished(volume, 0)
    data, weights = prepared
    start = Volume(np.maximum(volume.data, 0), volume.grid)
    projector = Projector(problem.geometry, volume.grid, device=problem.device)
    decide = control.decide or Decisions(problem.seed)
    beyond = beyond_voxels(gaussians, problem.geometry, volume.grid, fit)
    if beyond is not None:
        data -= beyond
    watch, count = _Watch(control, problem.geometry.n_views), sweeps or FINISH_SWEEPS
    method = _Finish(count, sweeps is None)
    refined = solve(
        method, projector, data, weight=weights, start=start, nonnegative=nonnegative,
        watch=Watch(lambda sweep, _: watch.refined(sweep, method.planned), watch.trial), decide=decide,
    )  # fmt: skip
    return Finished(refined, min(count, watch.made))


def _prepared(gaussians: Gaussians, problem: ReconProblem, fit: FitSettings) -> tuple[F32, F32 | None] | None:
    """Views without outliers and rings, and their weights; None: these or those of the model are empty."""
    data, weights = masked(problem.projections, problem.use.weights)
    model = project(gaussians, problem.geometry, truncation=fit.truncation, model=fit.rays).numpy()
    if not (data.any() and model.any()):
        return None
    data, weights = _without_outliers(data, weights, model)
    return data - ring_offsets(data - model, problem.geometry), weights


def _without_outliers(data: F32, weights: F32 | None, model: F32) -> tuple[F32, F32 | None]:
    """Data and weights, with weight zero for single rays that differ from the model by as much as its matter.

    The fit, which counts absolute differences, is not led astray by them; squares would be.
    """
    wild = np.abs(data - model) > WILD_RAY * float(model.max())
    if not 0 < np.count_nonzero(wild) < FEW_WILD * wild.size:
        return data, weights
    kept = np.where(wild, np.float32(0), np.float32(1) if weights is None else weights)
    return masked(data, kept)
