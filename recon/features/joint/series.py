"""Time series: joint fit of volumes at several times of a changing sample, with linear change in between.

A short part of the scan has too few projections for a volume, and one volume from all projections shows a sample that
never existed. So one fit determines the volumes of all times from all projections. Total variation acts on the common
part of the volumes and on their differences.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from recon.base.arrays import F32, F64
from recon.base.decisions import GoesOn
from recon.base.declared_types import check_arguments, check_settings
from recon.base.empirical import ONE_IN
from recon.base.geometry import Geometry
from recon.base.units import warn_of_other_quantity
from recon.base.volume import Grid
from recon.features.joint.energy_fit import EnergyFit, EnergyViews, fitted, trial_rows
from recon.features.joint.learnt_motion import (
    OfMoments,
    learnt_motion,
    unseen_squares,
)
from recon.features.joint.motion import Motion, moved
from recon.features.joint.proportions import SOLUTION_STEPS, TRIAL_STEPS, Countdown, Proportions, smoothness
from recon.features.joint.spectral import weight_of, weights_by_views
from recon.voxels.choice import exceeds_standard_error
from recon.voxels.projector import Projector, projection_lines, volume_lines, volume_slices

MOMENTS = 64  # largest number of moments between two knots; the projections of one moment are treated as simultaneous
_MOTION_MOMENTS = 16  # number of moments into which the scan is divided to estimate the motion, which is smooth in time
_STANDARD_ERRORS = 2.0  # standard errors over eight held-out blocks, see `exceeds_standard_error`; 4 % false alarms
# motion or factors are accepted if they lower the squared residual in held-out projections at least to this share
_LARGEST_SQUARES_RATIO = 0.95
_ROWS = 16  # number of rows in the test of factors
_TRIALS = 24 * 13  # number of iterations that choose the weights on these rows; 24 * 11 for usual data, 24 * 16 at most
_TURN = 4  # time of the steps of a motion, in units of iterations, in addition to the iterations for the motion
# time of the factors in units of iterations: of their tests (in addition to the fit), and of their solution
_FACTORS = 120, 60
SWEEPS = 60
LEAST_VIEWS = 12  # smallest number of projections per volume; some of them are held out
# smallest number of projections that are nearer in time to one volume than to any other (the first and the last volume
# have projections on one side only)
_LEAST_NEAR = 6


@dataclass(frozen=True, eq=False)
class TimedViews:
    """Projections of a changing sample, with their times.

    Attributes:
        projections: line integrals, float32 [view, row, col], finite.
        geometry: geometry of all projections.
        times: float64 [view], time of each exposure, in any unit and from any origin.
        weight: weight of each ray [view, row, col]; None: 1.

    Raises:
        ValueError: there is not one time per projection, a time is not finite, or all times are equal.
    """

    projections: F32
    geometry: Geometry
    times: F64
    weight: F32 | None = None

    def __post_init__(self) -> None:
        check_settings(self)
        n = self.geometry.n_views
        if self.times.shape != (n,) or not np.isfinite(self.times).all() or np.ptp(self.times) == 0:
            raise ValueError(f"times must be {n} finite numbers, one for each projection, and not all equal")

    @property
    def span(self) -> tuple[float, float]:
        """The first and the last time."""
        return float(self.times.min()), float(self.times.max())


@dataclass(frozen=True, eq=False)
class TimedVolumes:
    """A changing volume: it changes linearly between knots in time, and may also move.

    Attributes:
        times: float64 [knot], in the unit of the projections' times, evenly spaced from the first projection to the
            last.
        volumes: float32 [knot, z, y, x], attenuation in 1/mm (1/px if the pitch is 1), 0 or more, before the motion is
            applied (`at` gives the displaced volume).
        grid: grid of each volume.
        residual: norm of the residual of the projections, divided by the norm of the projections.
        motion: displacement field of the sample in time; a voxel of the displaced volume gets the value at the position
            of the voxel plus the displacement; None: nothing moves.
        unseen_residuals: residuals of coarse volumes in held-out projections, without motion and with motion; None if
            held-out projections did not decide about motion.
        smooth: smoothness of the factors (module `proportions`), if each volume is the mean volume multiplied by smooth
            factors; None if each volume is fitted separately.
    """

    times: F64
    volumes: F32
    grid: Grid
    residual: float
    motion: Motion | None = None
    unseen_residuals: tuple[float, float] | None = None
    smooth: float | None = None

    def at(self, time: float) -> F32:
        """The volume [z, y, x] at a time. Before the first knot and after the last knot, the volume does not change."""
        at_rest = np.tensordot(hats(time, self.times)[0].astype(np.float32), self.volumes, 1)
        if self.motion is None:
            return at_rest
        past = np.clip((time - self.times[0]) / np.ptp(self.times), 0, 1)
        motion_now = self.motion.on(self.motion.shape, np.array([past]))
        return volume_slices(moved(volume_lines(at_rest), motion_now.at(0)))


def hats(times: ArrayLike, knots: F64) -> F64:
    """Weights [time, knot] for linear interpolation between evenly spaced knots. Beyond the first and the last knot,
    the weights are constant."""
    knot_position = np.interp(np.atleast_1d(times), knots, np.arange(knots.size))
    return np.maximum(0, 1 - np.abs(knot_position[:, None] - np.arange(knots.size)))


def fit_series(
    views: TimedViews,
    knots: int,
    *,
    motion: bool | None = None,
    tv_weight: float | None = None,
    sweeps: int = SWEEPS,
    seed: int = 0,
    go_on: Callable[[int, float], bool] = lambda sweep, residual: True,
    stop: Callable[[], bool] = lambda: False,
) -> TimedVolumes:
    """Volumes x_k at evenly spaced times: a least-squares fit to all projections, regularised by total variation:

        min ½ Σ_v |A_v W(t_v) Σ_k h_k(t_v) x_k - p_v|² + Σ_j μ_j TV(z_j),    x_k >= 0.

    The functions h_k are hat functions, so the volume is linear in time between knots. The operator W displaces the
    volume, smoothly in space and time, and is the identity in the middle of the scan (module `motion`). Mathematically,
    `fit_series` solves the problem of `fit_materials`: knots replace the materials, and hat functions replace the cross
    sections. The z_j are the orthonormal components of all volumes x_k; the first component is the common part of all
    volumes. If nothing moves, `fit_series` also tries another model: each volume is the mean volume, multiplied in each
    voxel by a factor that varies smoothly in space. `fit_series` returns the volumes of this model if they predict
    held-out projections better than separate volumes do. Smooth factors suit a sample of particles in which each
    particle takes up or loses material at its own time. Steps, memory, `go_on` and `stop` of `fit_series` are as in
    `fit_materials`. Up to four tests come before the fit: they choose the weights, decide whether the sample moves,
    estimate the motion, and choose the smoothness of the factors. During each test, and while the factors are fitted,
    the first argument of `go_on` counts the remaining steps down to 0. If `go_on` stops the fit of the factors
    early, the result is the separate volumes, without factors.

    Use `motion=True` for a sample that settles. If only the densities of the sample change, `motion=True` finds motion
    that does not exist. For a sample that does not change, `tv_weight` has the same effect as the same weight for a
    single volume from all projections.

    Args:
        knots: number of volumes, 2 or more.
        motion: True: also estimate the motion; None: use the motion only if it predicts held-out projections better.
        tv_weight: μ of all components; None: the weight that predicts held-out projections best.

    Raises:
        ValueError: a volume has fewer than twelve projections, or fewer than six projections are nearer in time to this
            volume than to any other.
    """
    check_arguments(fit_series, locals())
    refuse_few(knots, views.geometry.n_views)
    warn_of_other_quantity(views.projections)
    times = np.linspace(*views.span, knots)
    _refuse_gaps(views.times, times)
    energies, past = of_moments(views, times, MOMENTS * (knots - 1))
    grid = Grid.matching(views.geometry)
    if tv_weight is None:
        weights = weights_by_views(energies, grid, seed, go_on, stop, alike=True)
    else:
        weights = np.full(knots, tv_weight / math.sqrt(past.size))
    coarse_views, coarse_past = of_moments(views, times, _MOTION_MOMENTS)
    coarse = OfMoments(coarse_views, coarse_past, weights * math.sqrt(past.size / coarse_past.size))
    learnt, unseen = _motion(coarse, OfMoments(energies, past, weights), motion, go_on, stop)
    smooth = None if learnt is not None else smooth_factors(energies, grid, weights, sweeps, seed, go_on, stop)
    fit = EnergyFit(energies, grid, np.random.default_rng(seed), learnt, stop)
    watched = GoesOn(go_on)
    volumes, residual = fitted(fit, weights, sweeps, watched)
    timed = TimedVolumes(times, volumes, grid, residual, learnt, unseen)
    return timed if smooth is None or not watched.going or stop() else _as_factors(timed, fit, smooth, go_on)


def _refuse_gaps(times: F64, knots: F64) -> None:
    """Raise ValueError if too few projections are near one of the volumes."""
    n_near = (hats(times, knots) > 0.5).sum(0)
    if n_near.min() < _LEAST_NEAR:
        k = int(n_near.argmin())
        raise ValueError(
            f"too few projections near volume {k + 1} of {knots.size} (at time {knots[k]:g}): {n_near[k]} projections "
            f"are closer to this time than {np.diff(knots)[0] / 2:g}, but at least {_LEAST_NEAR} are needed. Ask "
            "for fewer volumes, or reconstruct the projections before and after a gap separately"
        )


def _motion(
    coarse: OfMoments,
    fine: OfMoments,
    wanted: bool | None,
    go_on: Callable[[int, float], bool],
    stop: Callable[[], bool],
) -> tuple[Motion | None, tuple[float, float] | None]:
    """The motion of the sample; and, if held-out projections decided about motion, their residuals without and with
    it."""
    unseen = None
    if wanted is None and (squares := unseen_squares(coarse, fine, go_on, stop)) is not None:
        wanted = _moves(*squares)
        unseen = math.sqrt(squares[0].mean()), math.sqrt(squares[1].mean())
    learnt = learnt_motion(coarse, go_on, stop) if wanted else None
    return learnt and learnt.on(learnt.shape, fine.times), unseen


def _moves(squares_without: F64, squares_with: F64) -> bool:
    """Whether the sample moves, decided with the squared residuals [block] of held-out projections without and with
    motion."""
    return exceeds_standard_error(squares_without - squares_with, _STANDARD_ERRORS) and float(
        squares_with.mean()
    ) < _LARGEST_SQUARES_RATIO * float(squares_without.mean())


def _as_factors(
    timed: TimedVolumes, fit: EnergyFit, smooth: float, go_on: Callable[[int, float], bool]
) -> TimedVolumes:
    """The volumes, replaced by their mean times smooth factors. If the steps are stopped, the volumes stay
    unchanged."""
    stop, problem = fit.stop, _of_factors(fit.views, timed.volumes, timed.grid, fit.stop)
    steps = Countdown(lambda remaining: go_on(-remaining, timed.residual), SOLUTION_STEPS)
    factors = problem.solved(smooth, problem.ones(), steps)
    if not steps.going or stop():
        return timed
    fit.stop = lambda: False
    changed = np.stack([volume_slices(problem.matter * np.maximum(factor, 0)) for factor in factors])
    return replace(timed, volumes=changed, residual=fit.residual_of(changed), smooth=smooth)


def _of_factors(views: EnergyViews, volumes: F32, grid: Grid, stop: Callable[[], bool]) -> Proportions:
    """The problem of finding the factors of the mean volume. Rays that are strongly attenuated by the mean volume have
    less weight."""
    projector, density = Projector(views.geometry, grid), volume_lines(volumes.mean(0))
    weight = weight_of(np.exp(-projector.forward_lines(density)))
    if views.weight is not None:
        weight *= projection_lines(views.weight) > 0
    data = projection_lines(views.projections)
    return Proportions(projector, views.energy, views.cross_sections, density, data, weight, stop)


def smooth_factors(
    views: EnergyViews,
    grid: Grid,
    weights: F64,
    sweeps: int,
    seed: int,
    go_on: Callable[[int, float], bool],
    stop: Callable[[], bool],
) -> float | None:
    """The best smoothness of the factors; None if separate volumes predict held-out projections equally well.

    The search uses some rows, and fits to seven of eight projections.
    """
    rows, grid = trial_rows(views, grid, _ROWS)
    held_out = views.parted(ONE_IN) == ONE_IN // 2
    fit = EnergyFit(views.select(np.flatnonzero(~held_out), rows), grid, np.random.default_rng(seed), stop=stop)
    watched = GoesOn(lambda sweep, residual: go_on(sweep - sweeps - TRIAL_STEPS, residual))
    separate_volumes, residual = fitted(fit, weights, sweeps, watched)
    if not watched.going or stop():
        return None
    problem = _of_factors(views.select(np.arange(held_out.size), rows), separate_volumes, grid, stop)
    to_fit, judge = problem.select(np.flatnonzero(~held_out)), problem.select(np.flatnonzero(held_out))
    steps = Countdown(lambda remaining: go_on(-remaining, residual), TRIAL_STEPS)
    smooth, judged_squares = smoothness(to_fit, judge, to_fit.ones(), steps)
    steps.end()
    if not steps.going or stop():
        return None
    squares_of_separate = (
        replace(judge, matter=np.ones_like(judge.matter))
        .left(np.stack([volume_lines(image) for image in separate_volumes]))
        .sum()
    )
    return smooth if judged_squares < _LARGEST_SQUARES_RATIO * squares_of_separate else None


def refuse_few(knots: int, n: int) -> None:
    """Raise ValueError if `n` projections are too few for `knots` volumes."""
    if not 2 <= knots <= n // LEAST_VIEWS:
        raise ValueError(
            f"cannot make {knots} volumes from {n} projections: ask for at least 2 volumes, with at least "
            f"{LEAST_VIEWS} projections for each"
        )


def of_moments(views: TimedViews, times: F64, most_moments: int) -> tuple[EnergyViews, F64]:
    """The projections, divided into at most `most_moments` moments of equal size, and the times of these moments within
    the scan, 0 to 1."""
    n = views.geometry.n_views
    moments = min(most_moments, n)
    moment = np.empty(n, np.intp)
    moment[np.argsort(views.times, kind="stable")] = np.arange(n) * moments // n
    middles = np.bincount(moment, views.times) / np.bincount(moment)
    shares = np.zeros((moments, times.size))
    np.add.at(shares, moment, hats(views.times, times))
    shares /= np.bincount(moment)[:, None]
    past = (middles - times[0]) / np.ptp(times)
    return EnergyViews(views.projections, views.geometry, moment, shares, views.weight), past
