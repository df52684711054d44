"""finish: the volume of a fit, refined on voxels by ordered-subset FISTA with total variation.

Gaussians describe smooth matter in few parameters, and leave sharp edges, cracks and pores to the last: where a fit
ends, they are in its residual. On voxels a few sweeps over the views bring them back.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from recon.base.arrays import F32
from recon.base.decisions import Decisions
from recon.base.masks import masked
from recon.base.method import Progress, ReconProblem, RunControl
from recon.base.noise import noise_level, ring_offsets
from recon.base.volume import Volume
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import goes_on_beyond, leaves_the_field
from recon.splatting.settings import FitSettings
from recon.splatting.splat import project
from recon.voxels.held_out_weight import (
    Preferred,
    bregman_weight,
    choose_weight,
    preferred_residual,
    preferred_sweeps,
    preferred_weight,
    residuals_of_rounds,
)
from recon.voxels.iterative import UNITS, solve
from recon.voxels.noise_balance import EXPLAINED, NoiseBalance
from recon.voxels.ordered_fista import Subsets, bregman, ordered_fista
from recon.voxels.projector import Projector
from recon.voxels.sweeps import whitened
from recon.voxels.voxel_problem import VoxelProblem

SWEEPS = 8  # Sweeps over the views, at least, where no number is given

SUBSETS, TV_STEPS = 9, 3

_DIFFERENT = 0.6  # of the noise
_ALIKE = 1.1  # residuals: a thorax of 75 cone views is left with 1.31 and 1.32 of the noise, and differs by 2.2 dB
# Residual of a cone's fit over the noise, where the sweeps leave less than the fit. On a thorax it is 1.53 to 1.74:
# 16 sweeps with a lighter weight gain 0.5 to 1.4 dB there. On a teapot (1.29) they lose 2.5. On a shell the sweeps
# leave 1.4 to 2.9 times as much as the fit: 16 gain 0.7 or lose 2.1 dB.
_UNFINISHED, _LIGHTER = 1.45, 0.8
_SECOND_SHARE = 0.5  # of the weight that views held out prefer, in the second attempt (docs/notes/exploration.md)
_CLEARLY = 0.9  # a parallel beam: residuals .94 to .98 of the first's lose 3 dB (spheres), .5 less than 0.1 dB (slabs)
# Residual of views held out after 50 steps, over that of total variation from FBP. It is 0.99 to 1.00 after 24 sweeps
# where 100 steps lose nothing, 0.65 to 0.97 where they do. After 8 sweeps of the former it is at most 1.15.
_AS_WELL = 0.98, 1.2
_NEAR_BEST = 0.99  # fewest sweeps whose residual times it is the least or less: 16 for 24 gain 0.18 dB, or lose 0.08
_WILD, _FEW = 0.5, 0.01  # of the largest line integral; of the rays: more disagree only where the fit has failed


class _Watch:
    """Tells of sweeps, and asks whether to stop; `ended`: the last answer was yes."""

    def __init__(self, control: RunControl, n_views: int) -> None:
        self._control, self._n_views = control, n_views
        self._begin, self._trials, self.ended = control.now(), 0, False

    def asked(self) -> bool:
        self.ended = self._control.should_stop is not None and self._control.should_stop()
        return self.ended

    def trial(self) -> bool:
        if self._control.stop_trials is not None and self._control.stop_trials():
            return True
        self._trials += 1
        return self.sweep(self._trials, 0, "sweeps of trials")

    def sweep(self, number: int, of: int, unit: str = "sweeps on voxels") -> bool:
        if self._control.on_progress is not None:
            nan, seconds = math.nan, self._control.now() - self._begin
            self._control.on_progress(Progress(number, of, seconds, nan, nan, 0, self._n_views, unit=unit))
        return self.asked()


class FinishTrial(NamedTuple):
    """What a trial of the finish, early in a fit, tells.

    Attributes:
        sweeps: of a finish that makes up for further steps of the fit; 0: these gain more.
        weight: of total variation that views held out prefer, in the units of the data.
        residual: of these views after total variation with this weight, from FBP, in the unit of the data.
    """

    sweeps: int
    weight: float
    residual: float

    @classmethod
    def of(cls, values: Iterable[float]) -> FinishTrial:
        """From its three numbers, as a decision or a checkpoint keeps them."""
        sweeps, weight, residual = values
        return cls(int(sweeps), float(weight), float(residual))


@dataclass
class _TryFinish:
    """The trial as an iterative method of `recon.voxels.iterative.solve`; the volume stays as it is."""

    iterations: int = 1
    found: FinishTrial | None = None

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        preferred = preferred_weight(problem, NoiseBalance.of(problem, x, True).first)
        if preferred is not None:
            low, high = (share * preferred.residual for share in _AS_WELL)
            left = residuals_of_rounds(problem, x, preferred.weight, SWEEPS, (low, high))
            as_well = bool(left) and low <= left[-1] <= high
            rounds = 1 + next(n for n, one in enumerate(left) if one * _NEAR_BEST <= min(left)) if as_well else 0
            self.found = FinishTrial(rounds * SWEEPS, *_converted(preferred, problem, 1))
        return x


@dataclass
class _FromModel:
    """The refinement as an iterative method of `recon.voxels.iterative.solve`. With `by_content` it makes as many more
    sweeps as views held out prefer; it makes no more where `watch` ends the trials.

    Attributes:
        given: weight of total variation, in the units of the data; None: it is chosen.
    """

    iterations: int
    by_content: bool
    watch: _Watch
    unmodelled: float | None = None
    trial: FinishTrial | None = None
    given: float | None = None

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        known, tried = None, 0
        if self.trial is not None:
            known = _converted(Preferred(self.trial.weight, self.trial.residual), problem, -1)
            tried = self.trial.sweeps
        given = None if self.given is None else math.ldexp(self.given, -_power(problem))
        weight = choose_weight(problem, x, modelled=True, unmodelled=self.unmodelled, known=known, given=given)
        if self.by_content and self.unmodelled is None and not (self.watch.ended or isinstance(weight, NoiseBalance)):
            mu, residual = weight, preferred_residual(problem.decide)
            self.iterations = problem.decide("sweeps", lambda: tried or preferred_sweeps(problem, x, mu, SWEEPS))
            once = self.iterations > SWEEPS or self.watch.ended
            heavy = None if once else problem.decide("heavy", lambda: bregman_weight(problem, mu, residual))
            if heavy is not None:
                self.iterations = 2 * SWEEPS
                return bregman(problem, x, heavy, Subsets.of(problem, SUBSETS), sweeps=SWEEPS, tv_steps=TV_STEPS)
        if self.watch.ended:
            self.iterations = 0
            return x
        subsets = Subsets.of(problem, SUBSETS)
        return ordered_fista(problem, x, weight, subsets, sweeps=self.iterations, tv_steps=TV_STEPS)


def try_finish(
    volume: Volume, gaussians: Gaussians, problem: ReconProblem, settings: FitSettings, control: RunControl
) -> FinishTrial | None:
    """Whether further steps of a fit gain anything; arguments as of `finish`. None: no views can be held out.

    Sixteen rows are refined by the sweeps of a finish. They may predict views held out no better than total variation
    does from FBP, although the fit knows these views. Then the finish makes up for what more steps would gain, by 8, 16
    or 24 sweeps: the fewest that leave at most one per cent more than the best.
    """
    prepared = _prepared(gaussians, problem, settings)
    if prepared is None:
        return None
    data, known, _ = prepared
    method, watch = _TryFinish(), _Watch(control, problem.geometry.n_views)
    start = Volume(np.maximum(volume.data, 0), volume.grid)
    projector = Projector(problem.geometry, volume.grid)
    solve(method, projector, data, weight=known, start=start, on_trial=watch.trial, decide=Decisions(problem.seed))
    return None if watch.ended else method.found


class Finished(NamedTuple):
    """The refined volume, and the sweeps that it took; 0: it is the fit's."""

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
    trial: FinishTrial | None = None,
) -> Finished:
    """The volume after `sweeps` over all views, starting from the volume of a fit.

    The sweeps see the measured views, not what the fit leaves of them. That is better by 0.5 to 2 dB wherever voxels
    can explain the views. They cannot where pixels are coarse, the noise is low or matter lies outside the box. There
    measured views would bend the volume (-6 dB on a teapot of 10⁵ photons, -12 dB on a region of interest). So two
    things are looked at. The projection of the voxels at the start may differ from that of the Gaussians by more than
    0.6 of the noise. The sweeps may leave more than the fit, or 1.05 times the noise. Where both hold, the sweeps are
    tried anew on p - G + A x. Here p are the measured views, G those of the Gaussians, A x the projection of the voxels
    at the start. What voxels cannot explain then counts as noise. The second volume is taken if it leaves a tenth less
    of its views. Of a cone, and of matter beyond the field, it may leave a tenth more. Where views held out preferred a
    weight, the second attempt takes half of it, and need only leave no more.

    Where the rays of a cone cross matter above or below the field, only p - G + A x is tried. Measured views would put
    that matter into the end slices: -22 dB there, -7 dB in the middle of a thorax.

    Single pixels that stand out in all views alike become rings. They are brought back to their neighbours first, see
    `ring_offsets`. The weight of total variation follows the noise, see `NoiseBalance`, or is the one that views held
    out prefer, see `preferred_weight`. Measured on 26 small scans, with the former: 0.5 to 7 dB above the fit in 25 of
    them. In one, of 500 photons a pixel, 0.9 dB below it. It is level on a measured walnut (docs/notes/exploration.md).
    Memory: 8 volumes and 5 times the projections.

    Args:
        volume: voxels of the Gaussians, 1/mm.
        gaussians: result of a fit to the views.
        problem: the views that were fitted, and the weights of their rays.
        sweeps: 1 or more; None: 8, or as views held out prefer, see `preferred_sweeps` and `bregman_weight`. Of a cone
            whose fit leaves more than 1.45 times the noise, and more than the sweeps do, 16.
        settings: of the fit; None: the defaults.
        control: is told of each sweep, also of those of trials, and asked after it whether to stop. A stop between the
            two attempts keeps the first if it explains the views better than the fit, and the fit otherwise. Only views
            of a parallel beam, which see all matter, can tell that. Of such views it keeps the first during the second,
            too.

        nonnegative: voxels below zero are clipped.
        trial: what `try_finish` found during the fit; its weight is not sought again.

    Raises:
        ValueError: for shapes that disagree, or no sweeps.
    """
    fit, control = settings or FitSettings(), control or RunControl()
    decide = control.decide or Decisions(problem.seed)
    projector = Projector(problem.geometry, volume.grid)
    prepared = _prepared(gaussians, problem, fit)
    if prepared is None:
        return Finished(volume, 0)
    data, known, model = prepared
    start = Volume(np.maximum(volume.data, 0), volume.grid)

    watch = _Watch(control, problem.geometry.n_views)

    def refined(
        views: F32, unmodelled: float | None = None, first: int = SWEEPS, given: float | None = None
    ) -> Finished:
        method = _FromModel(first if sweeps is None else sweeps, sweeps is None, watch, unmodelled, trial, given)
        refined = solve(
            method,
            projector,
            views,
            weight=known,
            start=start,
            nonnegative=nonnegative,
            on_iteration=lambda sweep, _: watch.sweep(sweep, method.iterations),
            on_trial=watch.trial,
            decide=decide,
        )
        return Finished(refined, method.iterations)

    fitted = _deviation(data - model, known)
    model -= projector.forward(start.data)
    if decide("above", lambda: goes_on_beyond(data, problem.geometry)):
        return refined(data - model, 0.0)
    noise, unlike = noise_level(whitened(data, known)), _deviation(model, known)
    found = refined(data)
    if found.sweeps == 0:
        return Finished(volume, 0)
    if decide("alike", lambda: unlike <= _DIFFERENT * noise):
        return found
    left = _deviation(data - projector.forward(found.volume.data), known)
    if decide("explained", lambda: left <= min(fitted, EXPLAINED * noise)):
        return found
    beyond = leaves_the_field(data, problem.geometry)
    bent = beyond or problem.geometry.is_cone  # however well voxels explain the views
    if watch.asked():
        return Finished(volume, 0) if bent or left > fitted else found
    # Matter beyond the field is smooth in the views, and explained by the Gaussians; an error of voxels is at edges.
    smooth = noise == 0 or beyond
    data -= model
    unfinished = bent and not smooth and decide("unfinished", lambda: fitted > max(_UNFINISHED * noise, left))
    known_before = 0.0 if smooth else unlike / noise * (_LIGHTER if unfinished else 1)
    weight = None if bent else _preferred_in_data(decide, known is not None)
    second_weight = None if weight is None else _SECOND_SHARE * weight
    other = refined(data, known_before, 2 * SWEEPS if unfinished else SWEEPS, second_weight)
    if watch.asked() and not bent:  # cut short
        return found
    after = _deviation(data - projector.forward(other.volume.data), known)
    most = _ALIKE if bent else _CLEARLY if second_weight is None else 1.0
    return other if decide("other", lambda: after <= most * left) else found


def _prepared(gaussians: Gaussians, problem: ReconProblem, fit: FitSettings) -> tuple[F32, F32 | None, F32] | None:
    """Views without outliers and rings, their weights, and the views of the model; None: one of them is empty."""
    data, known = masked(problem.projections, problem.use.weights)
    model = project(gaussians, problem.geometry, truncation=fit.truncation, model=fit.rays).numpy()
    if not (data.any() and model.any()):
        return None
    data, known = _without_outliers(data, known, model)
    return data - ring_offsets(data - model, problem.geometry.axis_col), known, model


def _power(problem: VoxelProblem) -> int:
    """n, where a weight of total variation in the units of the data is 2**n times that in those of the problem."""
    return _power_of(problem.decide, problem.weight is not None)


def _converted(found: Preferred, problem: VoxelProblem, sign: int) -> Preferred:
    """From the units of the problem to those of the data (1), or back (-1)."""
    integral = problem.decide.made[UNITS][-1][1]
    return Preferred(math.ldexp(found.weight, sign * _power(problem)), math.ldexp(found.residual, sign * integral))


def _power_of(decide: Decisions, weighted: bool) -> int:
    length, integral, rays = decide.made[UNITS][-1]
    return int(length + integral + (rays if weighted else 0))


def _preferred_in_data(decide: Decisions, weighted: bool) -> float | None:
    """The weight that `choose_weight` took last, in the units of the data; None: it is one by the noise."""
    first, *noise = decide.made["weight"][-1]
    return None if noise else math.ldexp(first, _power_of(decide, weighted))


def _deviation(left: F32, weights: F32 | None) -> float:
    """Root mean square of a residual, rays weighed."""
    return math.sqrt(float(np.nanmean(np.square(whitened(left, weights)), dtype=np.float64)))


def _without_outliers(data: F32, weights: F32 | None, model: F32) -> tuple[F32, F32 | None]:
    """Data and weights, with weight zero for single rays that differ from the model by as much as its matter.

    The fit, which counts absolute differences, is not led astray by them; squares would be.
    """
    wild = np.abs(data - model) > _WILD * float(model.max())
    if not 0 < np.count_nonzero(wild) < _FEW * wild.size:
        return data, weights
    kept = np.where(wild, np.float32(0), np.float32(1) if weights is None else weights)
    return masked(data, kept)
