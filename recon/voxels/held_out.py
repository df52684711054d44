"""Views held out: how strengths, priors and methods are chosen, and the trials that judge them.

One of eight views is held out. Each candidate makes a volume from the others, on some rows, and its residual of each
view held out is measured. Of strengths the one of the least mean residual is taken, of methods the cheapest
that the best does not lead. Two candidates are compared view by view
where a search, or a trial fit, may end before all has been tried: views differ more than candidates do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64
from recon.base.decisions import Decisions
from recon.base.empirical import FEWEST_SUBSETS, ONE_IN
from recon.base.geometry import Geometry
from recon.base.method import DataUse, Method, ReconProblem, RunControl
from recon.base.view_data import split_views as split_views
from recon.base.volume import Grid
from recon.voxels.field_edges import busiest_rows, columns_of_matter, middle_of_cone, slab_of
from recon.voxels.priors import NoiseBalance, Subsets, ordered_fista, subsets_of
from recon.voxels.projector import Projector
from recon.voxels.residuals import unseen_residuals as unseen_residuals
from recon.voxels.voxel_problem import VoxelProblem

TRIAL_SWEEPS = 20
"""Sweeps of total variation in a trial, and by default of `FistaTv`: a trial that gets less far than its volume prefers
a heavier weight, one that gets further a lighter one."""

LEAST_VIEWS = 2 * ONE_IN

LEAST_GAIN = 0.02
"""Share by which a costlier candidate must lower a residual. A fit of a tooth lowers it by 1.3 %, in four times the
time."""

_ERRORS = 1.0  # standard errors of the difference, up to which two candidates predict alike
TRIAL_ROWS = 16
"""Rows of the slab that trials of a prior see."""

_WIDE, _FEWEST_ROWS = 0.9, 4  # share that the field has of a wide box, at most; rows of a trial in one
SUBSETS, TV_STEPS = 9, 3  # of a trial
_OCTAVES = 10  # from the first strength, at most: cones of coarse voxels take 6 to 9, and 40 change nothing
TRIALS = 4
"""Trials of a strength, as a rule: 3 to 6 on five scans, some of fewer columns, see `columns_of_matter`."""
CHOICE_SWEEPS = TRIALS * TRIAL_SWEEPS
"""Sweeps of trials for a weight, as a rule."""
MOST_TRIALS = (2 + _OCTAVES) / TRIALS
"""The most sweeps of trials, over those as a rule."""


def _trial_rows(geometry: Geometry, grid: Grid) -> int:
    """Rows of a trial: fewer in a box that is wider than the field, so that it takes no longer."""
    share = 2 * geometry.reach / (grid.shape[2] * grid.voxel_size)
    return TRIAL_ROWS if share > _WIDE else max(_FEWEST_ROWS, round(TRIAL_ROWS * share))


def beyond_chance(gains: F64, errors: float) -> bool:
    """Whether the mean gain [view held out] exceeds so many of its standard errors."""
    scatter = float(gains.std(ddof=1)) / math.sqrt(gains.size) if gains.size > 1 else 0.0
    return float(gains.mean()) > errors * scatter


def leads(residuals: F64, other: F64, least_gain: float) -> bool:
    """Whether residuals [view held out] are less than another candidate's beyond chance, and by so much of them."""
    by_more = float(residuals.mean()) < (1 - least_gain) * float(other.mean())
    return by_more and beyond_chance(other - residuals, _ERRORS)


def cheapest_not_led(residuals: Sequence[F64 | None], least_gain: float = LEAST_GAIN) -> int | None:
    """Number of the first candidate, and so the cheapest, that the best one does not lead; None: none was tried.

    One with a residual that is not finite was ended, or diverged, and counts as not tried.
    """
    tried = {at: each for at, each in enumerate(residuals) if each is not None and np.isfinite(each).all()}
    if not tried:
        return None
    best = min(tried.values(), key=lambda each: float(each.mean()))
    return next(at for at, each in tried.items() if not leads(best, each, least_gain))


def choice_sweeps(geometry: Geometry) -> float:
    """Cost of `choose_weight` in sweeps over all rows: four trials as a rule; 0 if no view is held out."""
    share = min(1.0, TRIAL_ROWS / geometry.detector_shape[0]) * (1 - 1 / ONE_IN)
    return CHOICE_SWEEPS * share if geometry.n_views >= LEAST_VIEWS else 0.0


def predicted_views(
    method: Method, data: F32, geometry: Geometry, grid: Grid, known: NDArray[Any] | None, one_in: int
) -> tuple[NDArray[np.intp], F32]:
    """Numbers of the held-out views, one in so many by angle, and their images [view, row, col] predicted by the
    others.

    Args:
        method: that makes the volume.
        data: line integrals [view, row, col].
        known: [row, col] or [view, row, col] weights of pixels; None: one for all.
    """
    order = np.argsort(np.mod(geometry.angles, 2 * np.pi), kind="stable")
    unseen = order[1::one_in]
    seen = np.setdiff1d(order, unseen)
    weights = None if known is None else np.broadcast_to(known, data.shape)[seen].astype(np.float32)
    part = ReconProblem(data[seen], geometry.select(seen), grid, DataUse(weights), 0, "cpu")
    volume = method.run(part, RunControl()).volume
    return unseen, Projector(geometry.select(unseen), grid).forward(volume.data)


@dataclass(frozen=True, eq=False)
class BestStrength:
    """The best strength of a prior by held-out views, and the least residual [view] in its search."""

    strength: float
    residuals: F64


def preferred_strength(residuals_of: Callable[[float], F64], first: float) -> BestStrength | None:
    """The strength of a prior whose residual is least, searched in octaves from `first`.

    No strength is simpler or cheaper than another, so that chance is no reason for one. (The strongest within one
    standard error of the least is an octave or two above it: a teapot refined from a fit loses 1.1 dB by one.) The
    search goes to stronger priors as long as they predict no worse beyond chance, else to weaker ones, as long as these
    predict better. The vertex of the parabola through the least and its neighbours is taken (whole octaves lose 0.5 dB
    on fibres with texture).

    Returns:
        None: a residual is infinite, since the trials were ended.
    """
    tried: dict[int, F64] = {}

    def mean(octave: int) -> float:
        if octave not in tried:
            tried[octave] = residuals_of(first * 2.0**octave)
        return float(tried[octave].mean())

    if math.isinf(mean(1)) or math.isinf(mean(0)):
        return None
    up = not beyond_chance(tried[1] - tried[0], _ERRORS)
    at, towards = (1, 1) if up else (0, -1)
    while abs(at + towards) <= _OCTAVES:
        if math.isinf(mean(at + towards)):
            return None
        if beyond_chance(tried[at + towards] - tried[at], _ERRORS if up else 0.0):
            break
        at += towards
    octave = min(tried, key=mean)
    vertex = float(octave)
    if octave - 1 in tried and octave + 1 in tried:
        weaker, stronger = mean(octave - 1) - mean(octave), mean(octave + 1) - mean(octave)
        vertex += (weaker - stronger) / (2 * (weaker + stronger)) if weaker + stronger > 0 else 0.0
    return BestStrength(first * 2.0**vertex, tried[octave])


def choose_weight(
    problem: VoxelProblem, start: F32, sweeps: int, trial: Callable[[], HeldOutTrial | None] | None = None
) -> NoiseBalance | float:
    """The weight μ of min ½||A x - p||² + μ TV(x), x >= 0: by held-out views, if there are any, else by the noise.

    μ over the number of views follows the noise of a volume, which falls with the root of that number. So μ is √(8/7)
    times that of the trial. It is sought from FBP: a fit knows the views held out, and any weight takes it away from
    them.

    Args:
        start, sweeps: as of `NoiseBalance.of`.
        trial: gives that of this problem; None: `HeldOutTrial.of`.
    """

    def chosen() -> list[float]:
        balance = NoiseBalance.of(problem, start, sweeps)
        judge = (trial() if trial else HeldOutTrial.of(problem)) if balance.first > 0 else None
        preferred = None if judge is None else preferred_strength(judge.of_weight, balance.first)
        if judge is None or preferred is None:
            return [balance.first, balance.noise]
        of_all = replace(preferred, strength=preferred.strength * math.sqrt(ONE_IN / (ONE_IN - 1)))
        judge.remember("weight", of_all)
        return [of_all.strength]

    first, *noise = problem.decide("weight", chosen)
    return NoiseBalance(first, noise[0], sweeps) if noise else first


class AllColumns(NamedTuple):
    """The rows of a trial with all columns, including air: a fit of narrower views is poorer.

    Attributes:
        cols: those of the trial.
        seen: makes the problem of the views that are not held out.
        unseen: the geometry of those that are.
    """

    cols: slice
    seen: Callable[[], VoxelProblem]
    unseen: Geometry


class HeldOutTrial:
    """Volumes of a slab from seven of eight views, assessed with the others.

    Attributes:
        problem: of the slab.
        start: [y, x, z], the first volume: FBP, or none where no direct method takes the views.
        unseen: the views held out.
        all_columns: both with all columns.
        direct: the first volume is FBP.
        smooth: the volume of total variation that predicts these best, of those made so far.
    """

    def __init__(
        self, problem: VoxelProblem, start: F32, unseen: VoxelProblem, all_columns: AllColumns, direct: bool,
        subsets: int,
    ) -> None:  # fmt: skip
        self.problem, self.start, self.unseen = replace(problem, go_on=self._go_on), start, unseen
        self.all_columns, self.direct = all_columns, direct
        self._subsets = Subsets.of(problem, subsets, subsets)
        self._ended, self._least = False, math.inf
        self._known: dict[tuple[str, float], F64] = {}
        self.smooth: F32 | None = None

    @classmethod
    def of(cls, problem: VoxelProblem) -> HeldOutTrial | None:
        """The trial of the rows with most matter; for a cone beam of those in the middle.

        Columns of air far beside the sample are left out.

        None: fewer than 16 views, a cone as `middle_of_cone`, views held out that weigh nothing in these rows, or
        `problem.trial_goes_on` ends it.
        """
        geometry, grid = problem.projector.geometry, problem.projector.grid
        if geometry.n_views < LEAST_VIEWS or not problem.trial_goes_on():
            return None
        images = problem.data.swapaxes(1, 2)
        if not geometry.is_cone:
            rows = busiest_rows(images, _trial_rows(geometry, grid))
            views, box = slab_of(geometry, grid, rows.start, rows.stop)
            return cls._of_rows(problem, rows, views, box, columns_of_matter(views, box, images[:, rows]))
        height = _trial_rows(geometry, grid)
        if geometry.detector_shape[0] <= height:
            return cls._of_rows(problem, slice(0, geometry.detector_shape[0]), geometry, grid)
        middle = middle_of_cone(geometry, grid, images, height)
        return None if middle is None else cls._of_rows(problem, *middle)

    @classmethod
    def _of_rows(
        cls, problem: VoxelProblem, rows: slice, views: Geometry, box: Grid,
        matter: tuple[slice, Geometry, Grid] | None = None,
    ) -> HeldOutTrial | None:  # fmt: skip
        def of_views(chosen: NDArray[np.intp], cols: slice, views: Geometry, box: Grid) -> VoxelProblem:
            def cut(rays: F32) -> F32:
                return np.ascontiguousarray(rays[chosen][:, cols, rows])

            return replace(
                problem,
                projector=replace(problem.projector, geometry=views.select(chosen), grid=box),
                data=cut(problem.data),
                measured=None if problem.measured is None else cut(problem.measured),
                weight=None if problem.weight is None else cut(problem.weight),
                rng=np.random.default_rng(0),
                go_on=lambda *_: True,
                decide=Decisions(),
            )

        cols, narrow, narrow_box = matter or (slice(None), views, box)
        seen, unseen = (of_views(some, cols, narrow, narrow_box) for some in split_views(views))
        if unseen.weight is not None and not unseen.weight.any(axis=(1, 2)).any():
            return None
        first = seen.filtered("hann")
        direct = first is not None
        if first is None:  # no direct method takes these views
            depth, height, width = narrow_box.shape
            first = np.zeros((height, width, depth), np.float32)
        others, judges = split_views(views)
        all_columns = AllColumns(cols, partial(of_views, others, slice(None), views, box), views.select(judges))
        part = replace(seen, with_all_columns=all_columns.seen if matter else None)
        return cls(part, np.maximum(first, 0, out=first) if direct else first, unseen, all_columns, direct,
                   subsets_of(problem.projector.geometry, SUBSETS, FEWEST_SUBSETS))  # fmt: skip

    def _go_on(self, sweep: int, residual: float) -> bool:
        self._ended = self._ended or not self.problem.trial_goes_on()
        return not self._ended

    @property
    def ended(self) -> bool:
        """Whether the trials were stopped; no further volume is assessed."""
        return self._ended

    def residuals_of(self, prior: str, strength: float, volume: Callable[[float], F32]) -> F64:
        """Residuals for this prior and strength; each volume is made once."""
        if (prior, strength) not in self._known:
            x = volume(strength)
            residuals = self._known[prior, strength] = self.residuals(x)
            if prior == "weight" and residuals.mean() < self._least:
                self.smooth, self._least = x, float(residuals.mean())
        return self._known[prior, strength]

    def remember(self, prior: str, preferred: BestStrength) -> None:
        """Record the least residual of a search for the strength that it prefers."""
        self._known[prior, preferred.strength] = preferred.residuals

    def of_weight(self, weight: float) -> F64:
        """Residuals for total variation of this weight; `smooth` is the best volume of all weights."""
        return self.residuals_of("weight", weight, self.with_weight)

    def with_weight(self, weight: float) -> F32:
        """The volume of total variation with this weight."""
        return self.volume_by(lambda part, x: ordered_fista(
            part, x, weight, self._subsets, sweeps=TRIAL_SWEEPS, tv_steps=TV_STEPS
        ))  # fmt: skip

    def volume_by(self, make: Callable[[VoxelProblem, F32], F32], start: F32 | None = None) -> F32:
        """The volume that `make` computes from a copy of the first one; that copy once the trials ended."""
        x = (self.start if start is None else start).copy()
        if self._ended:
            return x
        return make(replace(self.problem, rng=np.random.default_rng(0)), x)  # the same order of subsets for all

    def residuals(self, x: F32, beyond: F32 | None = None) -> F64:
        """`unseen_residuals` of a volume [y, x, z]; infinite if the trials were stopped.

        Args:
            beyond: [view held out, col, row], what its model adds to its projection.
        """
        unseen = self.unseen
        if self._ended:
            return np.full(len(unseen.data), np.inf)
        views = unseen.views if beyond is None else unseen.views - beyond
        return unseen_residuals(unseen.projector.forward_lines(x), views, unseen.weight, unseen.projector.resolution)
