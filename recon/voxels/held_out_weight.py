"""The weight of total variation, and the sweeps with it, that views held out prefer."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64, median_deviation
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.noise_balance import NoiseBalance
from recon.voxels.ordered_fista import Subsets, bregman, ordered_fista
from recon.voxels.projector import Projector
from recon.voxels.sweeps import whitened
from recon.voxels.voxel_problem import VoxelProblem, slices_are_rows

PREFERRED = "preferred"
"""Name of the decision on the weight that views held out prefer."""

ONE_IN = 8  # views held out
LEAST_VIEWS = 2 * ONE_IN

_ROWS = 16  # of the slab that trials see
_SWEEPS, _SUBSETS, _TV_STEPS = 16, 9, 3  # of a trial: after 8 the best weight is twice as heavy as after 20
_AT_ONCE = 8  # sweeps of a round, or of a run of two
_OCTAVES = 5  # from the first weight, at most: OS-SIRT-TV makes a checkerboard at 128 times
_LEVEL = 1.001  # residuals of weights an octave apart: a measured walnut of 25 views has 1.0002 over six octaves
_ROUNDS = 3  # of sweeps, at most
_BREGMAN_TRIALS = 3
CHOICE_SWEEPS = 4 * _SWEEPS
"""Sweeps of trials for a weight, as a rule."""
MOST_SWEEPS = _ROUNDS * _AT_ONCE
"""Sweeps of a finish, where views held out prefer them."""
_CONE_OCTAVES = 10
_COARSE, _FEWEST_ROWS = 1.2, 4 * _ROWS  # voxels in pixels, from which on it pays; of fewer rows trials cost too much
_AS_WELL = 1.03  # of the least residual: heavier weights, and less noise, at no loss (docs/choosing.md)
_MATTER, _ENOUGH = 0.1, 0.5  # shares: of the largest line integrals, and of the matter in the fullest rows
_NEARER = 0.99  # of the residual before: what further sweeps have to bring
_BY_CHANCE = 1.005  # of a residual: what the vertex of a parabola may lie below its lowest point, and more

# Weights of the two runs of `bregman`, in that of one run. Then by how much the residual of views held out has to fall;
# less is chance (docs/notes/exploration.md).
_HEAVY, _LESS_HEAVY = 3.0, 2.5
_GAIN, _FURTHER_GAIN = 0.003, 0.001


class Preferred(NamedTuple):
    """A weight that views held out prefer, and the least residual of theirs in its search."""

    weight: float
    residual: float


def slab_of(geometry: Geometry, grid: Grid, first: int, stop: int) -> tuple[Geometry, Grid]:
    """Rows first..stop of a parallel beam, and the slices that they see, as wide as `grid`.

    If rows do not show slices, these are all slices that any ray to the rows meets.
    """
    views = geometry.rows(first, stop)
    slab = Grid.matching(views)
    if not geometry.rows_show_slices:
        low, high = views.heights
        slices = math.ceil((high - low + 2 * geometry.lean) / geometry.sample_pitch)
        slab = replace(slab, shape=(slices, *slab.shape[1:]), centre=((low + high) / 2, 0.0, 0.0))
    shape, centre = (slab.shape[0], *grid.shape[1:]), (slab.centre[0], *grid.centre[1:])
    return views, replace(grid, shape=shape, centre=centre, slice_pitch=slab.spacing[0])


def middle_of_cone(geometry: Geometry, grid: Grid, data: F32, height: int) -> tuple[slice, Geometry, Grid] | None:
    """So many rows in the middle of a cone, as a geometry, and the box that holds their rays.

    None: views are displaced along the rows, or these rows show little of the matter in `data` [view, row, col].
    """
    first = round(geometry.axis_row - (height - 1) / 2)
    rows = slice(first, first + height)
    if np.abs(geometry.shifts[:, 1]).max() > 1 or first < 0 or rows.stop > geometry.detector_shape[0]:
        return None
    some = data[:: max(1, len(data) // 8)]
    if np.abs(some[:, rows]).sum() < _ENOUGH * np.abs(some[:, busiest_rows(some, height)]).sum():
        return None
    # At the far side of the field.
    tall = ((height + 1) * geometry.sample_pitch + 2 * geometry.lean) * (1 + geometry.reach / geometry.sod)
    slices = math.ceil(tall / grid.spacing[0])
    box = replace(grid, shape=(slices, *grid.shape[1:]), centre=(0.0, *grid.centre[1:]))
    return rows, geometry.rows(rows.start, rows.stop), box


def split_views(geometry: Geometry, one_in: int = ONE_IN) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Views to reconstruct from, and one of so many to judge by, evenly spread in angle."""
    order = np.argsort(np.mod(geometry.angles, geometry.period), kind="stable")
    unseen = np.sort(order[one_in // 2 :: one_in])
    return np.setdiff1d(np.arange(geometry.n_views), unseen), unseen


def beyond_chance(gains: F64, errors: float) -> bool:
    """The mean of gains [view held out] is more than so many of its standard errors, by their scatter."""
    return float(gains.mean()) > errors * float(gains.std(ddof=1)) / math.sqrt(gains.size)


def busiest_rows(data: F32, height: int) -> slice:
    """The neighbouring rows with most matter of line integrals [view, row, col]."""
    rows = data.shape[1]
    if rows <= height:
        return slice(0, rows)
    some = data[:: max(1, len(data) // 8)]
    matter = np.concatenate(([0.0], np.cumsum(np.abs(some).sum(axis=(0, 2), dtype=np.float64))))
    first = int(np.argmax(matter[height:] - matter[:-height]))
    return slice(first, first + height)


def choice_sweeps(geometry: Geometry) -> float:
    """What `choose_weight` costs, in sweeps over all rows: four trials as a rule; 0 where nothing is held out."""
    return _in_all_rows(CHOICE_SWEEPS, geometry)


def sweeps_choice_cost(geometry: Geometry) -> float:
    """What `preferred_sweeps` and `bregman_weight` cost at most, in sweeps over all rows."""
    return _in_all_rows(MOST_SWEEPS + _BREGMAN_TRIALS * _SWEEPS, geometry)


def _in_all_rows(sweeps: int, geometry: Geometry) -> float:
    share = min(1.0, _ROWS / geometry.detector_shape[0]) * (1 - 1 / ONE_IN)
    return sweeps * share if _can_hold_out(geometry) else 0.0


def _can_hold_out(geometry: Geometry) -> bool:
    return not geometry.is_cone and geometry.n_views >= LEAST_VIEWS


def choose_weight(
    problem: VoxelProblem,
    start: F32,
    *,
    modelled: bool,
    unmodelled: float | None = None,
    of_cones: bool = False,
    known: Preferred | None = None,
    given: float | None = None,
) -> NoiseBalance | float:
    """The weight by the noise, or the one by views held out; arguments as `NoiseBalance.of`.

    `of_cones`: views of a cone are held out, too. `known`: what `preferred_weight` found before. What it finds is a
    decision of its own, PREFERRED, which holds for other methods on the same views; see `preferred_residual`.
    `given`: the weight, where no slab has chosen another.
    """

    @cache
    def balance() -> NoiseBalance:
        return NoiseBalance.of(problem, start, modelled, unmodelled)

    def chosen() -> list[float]:
        if given is not None:
            return [given]
        found = None
        if of_cones and problem.projector.geometry.is_cone:
            found = heaviest_weight(problem, balance().first)
        elif unmodelled is None:
            preferred = problem.decide(PREFERRED, lambda: _as_list(known or preferred_weight(problem, balance().first)))
            found = None if preferred is None else preferred[0]
        return [balance().first, balance().noise] if found is None else [found]

    first, *noise = problem.decide("weight", chosen)
    return NoiseBalance(first, noise[0], unmodelled is not None) if noise else first


def _as_list(preferred: Preferred | None) -> list[float] | None:
    return None if preferred is None else list(preferred)


def preferred_residual(decide: Decisions) -> float | None:
    """Residual of views held out, with the weight that `choose_weight` took last; None: it sought none."""
    preferred = (decide.made.get(PREFERRED) or [None])[-1]
    return None if preferred is None else float(preferred[1])


def preferred_weight(problem: VoxelProblem, first: float) -> Preferred | None:
    """The weight μ of min ½||A x - p||² + μ TV(x), x >= 0, that views held out prefer, from `first` on.

    Volumes of 16 rows are reconstructed from seven of eight views with twice the weight, with the weight, and on to the
    better side: the heavier one where both are level, because too light a weight changes nothing. They end when the
    root mean square of what they leave of the other views rises. The vertex of the parabola through the best and its
    neighbours is taken, within what was tried. A volume that is too smooth misses edges of unseen views. One that
    follows the noise misses them by its noise. μ is that of all views: noise and prior do not depend on their number.
    Trials begin from FBP: a fit knows the views held out, and any weight takes it away from them.

    None where nothing can be held out: a cone, fewer than 16 views, or data without noise; and where
    `problem.trial_goes_on` ends the trials.
    """
    geometry = problem.projector.geometry
    if not (_can_hold_out(geometry) and first > 0 and problem.trial_goes_on()):
        return None
    return least_in_octaves(WeightTrial.of(problem), first)


def least_in_octaves(error: Callable[[float], float], first: float) -> Preferred | None:
    """The weight, or another strength of a prior, of the least error, sought in octaves from `first`; see
    `preferred_weight`. None: an error is infinite, since the trials were ended.
    """
    errors = {octave: error(first * 2.0**octave) for octave in (1, 0)}
    towards, slack = (1, _LEVEL) if errors[1] < _LEVEL * errors[0] else (-1, 1.0)
    at = max(towards, 0)
    while abs(at + towards) <= _OCTAVES:
        errors[at + towards] = error(first * 2.0 ** (at + towards))
        if errors[at + towards] >= slack * errors[at]:
            break
        at += towards
    if math.inf in errors.values():  # the trials were ended
        return None
    best = min(errors, key=lambda octave: errors[octave])
    middle = min(max(best, min(errors) + 1), max(errors) - 1)
    lighter, here, heavier = (errors[middle + octave] for octave in (-1, 0, 1))
    curvature = lighter - 2 * here + heavier
    vertex = middle + (lighter - heavier) / (2 * curvature) if curvature > 0 else best
    vertex = min(max(vertex, best - 1, min(errors)), best + 1, max(errors))
    return Preferred(float(first * 2**vertex), errors[best])


def heaviest_weight(problem: VoxelProblem, first: float) -> float | None:
    """The heaviest weight of a cone, in octaves from `first`, that predicts views held out nearly as well as the best.

    Coarse voxels cannot explain edges of the views. A volume that tries has ripples, which views held out hardly show.
    Their residual is flat over two octaves, and the best volume lies at the heavy end. The residual is the median
    deviation on rays through matter; the root mean square would be that of edges. Volumes are of the middle rows.

    None where `first` is as good as any, and as `preferred_weight`. Also where voxels are as fine as pixels, rows are
    few, or the middle ones show little matter: a fan took nine times as long, and had the same weight.
    """
    geometry = problem.projector.geometry
    pays = is_coarse_cone(problem.projector) and geometry.detector_shape[0] >= _FEWEST_ROWS
    pays = pays and geometry.n_views >= LEAST_VIEWS and first > 0
    trial = WeightTrial.of_cone(problem) if pays and problem.trial_goes_on() else None
    return None if trial is None else heaviest_in_octaves(trial, first)


def is_coarse_cone(projector: Projector) -> bool:
    """Voxels of a cone are so coarse that they cannot explain the edges of its views, see `heaviest_weight`."""
    geometry = projector.geometry
    return geometry.is_cone and projector.grid.voxel_size >= _COARSE * geometry.sample_pitch


def heaviest_in_octaves(error: Callable[[float], float], first: float) -> float | None:
    """The heaviest weight, or other strength of a prior, whose error is nearly the least, in octaves from `first` on.

    None: `first` is, or the trials were ended.
    """
    least, heaviest = math.inf, None
    for octave in range(_CONE_OCTAVES):
        left = error(first * 2.0**octave)
        if math.isinf(left):  # the trials were ended
            return None
        least = min(least, left)
        if left > _AS_WELL * least:
            break
        heaviest = octave
    return first * 2.0**heaviest if heaviest else None


def bregman_weight(problem: VoxelProblem, weight: float, residual: float | None = None) -> float | None:
    """The weight of `bregman` that predicts views held out better than one run of as many sweeps with `weight`; None:
    none does.

    At the same noise two runs show more of a crack than one, most where views are few (docs/notes/exploration.md).
    `residual`: of the search for `weight`; where two runs are clearly above it, one run is not tried again.
    """
    error = WeightTrial.of(problem)
    heavy = error(_HEAVY * weight, twice=True)
    if residual is not None and heavy > _BY_CHANCE * residual:
        return None
    once = error(weight)
    if heavy > once:
        return None
    less_heavy = error(_LESS_HEAVY * weight, twice=True)
    factor, best = (_LESS_HEAVY, less_heavy) if less_heavy < (1 - _FURTHER_GAIN) * heavy else (_HEAVY, heavy)
    return factor * weight if best < (1 - _GAIN) * once else None


def preferred_sweeps(problem: VoxelProblem, start: F32, weight: float, sweeps: int) -> int:
    """Sweeps from `start` [y, x, z] with the weight μ that views held out prefer: `sweeps`, or three times these.

    A fit leaves some scans far from what the views tell (a foam: 20 dB, 24.0 after 8 sweeps, 25.1 after 24). It leaves
    others nearer than total variation alone comes (a teapot: 39.7 and 37.5 dB). Each round of `residuals_of_rounds` has
    to bring the others nearer, and all by one per cent, which parts the two (docs/notes/exploration.md). Where slices
    are not those of rows: `sweeps`.
    """
    errors = residuals_of_rounds(problem, start, weight, sweeps)
    nearer = len(errors) == _ROUNDS and errors[-1] <= min(errors) and errors[-1] < _NEARER * errors[0]
    return _ROUNDS * sweeps if nearer else sweeps


def residuals_of_rounds(
    problem: VoxelProblem, start: F32, weight: float, sweeps: int, within: tuple[float, float] = (0.0, math.inf)
) -> list[float]:
    """What sixteen rows, refined from seven of eight views in three rounds of `sweeps`, leave of the others after each.

    A round that takes them farther away, or leaves a residual that is not `within` these bounds, is the last. Empty
    where slices are not those of rows.
    """
    errors: list[float] = []
    if not slices_are_rows(problem.projector):
        return errors
    trial = WeightTrial.of(problem, start)
    x = trial.start.copy()

    def further(sweep: int, residual: float) -> bool:
        if not trial.problem.go_on(sweep, residual):
            return False
        if sweep % sweeps:
            return True
        errors.append(trial.error(x))
        return within[0] <= errors[-1] <= within[1] and errors[-1] <= min(errors)

    watched = replace(trial.problem, go_on=further)
    ordered_fista(watched, x, weight, trial.subsets, sweeps=_ROUNDS * sweeps, tv_steps=_TV_STEPS)
    return errors


class WeightTrial:
    """Volumes of a slab with several weights, judged by views that the trials have not seen."""

    def __init__(self, problem: VoxelProblem, start: F32, unseen: VoxelProblem) -> None:
        self.problem, self.start, self._unseen = replace(problem, go_on=self._go_on), start, unseen
        self.subsets = Subsets.of(problem, _SUBSETS)
        self._asked, self._ended = problem.go_on, False

    @classmethod
    def of(cls, problem: VoxelProblem, start: F32 | None = None) -> WeightTrial:
        """The trial of the rows with most matter, from those slices of `start` [y, x, z]; None: from FBP."""
        geometry, grid = problem.projector.geometry, problem.projector.grid
        rows = busiest_rows(problem.data.swapaxes(1, 2), _ROWS)
        return cls._of_rows(problem, rows, *slab_of(geometry, grid, rows.start, rows.stop), start)

    @classmethod
    def of_cone(cls, problem: VoxelProblem) -> WeightTrial | None:
        """The trial of the middle rows, from their FDK; None as `middle_of_cone`."""
        geometry, grid = problem.projector.geometry, problem.projector.grid
        found = middle_of_cone(geometry, grid, problem.data.swapaxes(1, 2), _ROWS)
        return None if found is None else cls._of_rows(problem, *found, None)

    @classmethod
    def of_some_rows(cls, problem: VoxelProblem) -> WeightTrial | None:
        """The trial of a parallel beam or of a cone. None: fewer than 16 views, or a cone as `middle_of_cone`."""
        geometry, grid = problem.projector.geometry, problem.projector.grid
        if geometry.n_views < LEAST_VIEWS or not problem.trial_goes_on():
            return None
        if not geometry.is_cone:
            return cls.of(problem)
        rows = geometry.detector_shape[0]
        return cls.of_cone(problem) if rows > _ROWS else cls._of_rows(problem, slice(0, rows), geometry, grid, None)

    @classmethod
    def _of_rows(cls, problem: VoxelProblem, rows: slice, views: Geometry, box: Grid, start: F32 | None) -> WeightTrial:
        def of_views(chosen: NDArray[np.intp]) -> VoxelProblem:
            def cut(rays: F32) -> F32:
                return np.ascontiguousarray(rays[chosen][:, :, rows])

            return replace(
                problem,
                projector=Projector(views.select(chosen), box),
                data=cut(problem.data),
                weight=None if problem.weight is None else cut(problem.weight),
                rng=np.random.default_rng(0),
                go_on=lambda *_: problem.trial_goes_on(),
                decide=Decisions(),
            )

        seen, unseen = split_views(views)
        trial = of_views(seen)
        if start is not None:
            return cls(trial, np.ascontiguousarray(start[:, :, rows]), of_views(unseen))
        first = trial.filtered("hann")
        if first is None:  # no direct method takes these views
            depth, height, width = box.shape
            first = np.zeros((height, width, depth), np.float32)
        return cls(trial, np.maximum(first, 0, out=first), of_views(unseen))

    def _go_on(self, sweep: int, residual: float) -> bool:
        self._ended = self._ended or not self._asked(sweep, residual)
        return not self._ended

    def __call__(self, weight: float, twice: bool = False) -> float:
        """`left_by` the volume with this weight, of one run or two."""
        run, sweeps = (bregman, _AT_ONCE) if twice else (ordered_fista, _SWEEPS)
        return self.left_by(lambda problem, x: run(problem, x, weight, self.subsets, sweeps=sweeps, tv_steps=_TV_STEPS))

    def left_by(self, made: Callable[[VoxelProblem, F32], F32]) -> float:
        """Root mean square of what the volume made from the first one leaves of the views held out.

        Infinite from where the trials are ended on: then nothing is preferred.
        """
        if self._ended:
            return math.inf
        # The same order of subsets for all.
        x = made(replace(self.problem, rng=np.random.default_rng(0)), self.start.copy())
        return math.inf if self._ended else self.error(x)

    def begin_from(self, weight: float) -> None:
        """Volumes begin from total variation with this weight instead."""
        problem = replace(self.problem, rng=np.random.default_rng(0))
        self.start = ordered_fista(problem, self.start, weight, self.subsets, sweeps=_SWEEPS, tv_steps=_TV_STEPS)

    def error(self, x: F32) -> float:
        """Root mean square of what slices [y, x, z] leave of the views held out; infinite where these weigh nothing.

        Of a cone: the median deviation, on rays through matter.
        """
        if self._unseen.weight is not None and not self._unseen.weight.any():
            return math.inf
        left = self._unseen.projector.forward_lines(x)
        left -= self._unseen.data
        if self._unseen.projector.geometry.is_cone:
            matter = self._unseen.data > _MATTER * np.percentile(self._unseen.data, 99)
            return median_deviation(whitened(left, self._unseen.weight)[matter]) or math.inf
        return math.sqrt(float(np.average(np.square(left, dtype=np.float64), weights=self._unseen.weight)))
