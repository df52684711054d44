"""Views held out: how strengths, priors and methods are chosen, and the trials that judge them.

One of eight views is held out. Each candidate makes a volume from the others, on some rows, and its residual of each
view held out is measured. The candidate of the least mean residual is taken. Two candidates are compared view by view
where a search, or a trial fit, may end before all has been tried: views differ more than candidates do.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64
from recon.base.decisions import Decisions
from recon.base.empirical import ENOUGH_MATTER, ONE_IN
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.priors import NoiseBalance, Subsets, ordered_fista
from recon.voxels.projector import Projector
from recon.voxels.resolution import ViewResolution, at_voxel_resolution
from recon.voxels.voxel_problem import VoxelProblem, whitened

TRIAL_SWEEPS = 16
"""Sweeps of total variation. Without, after 8, a weight twice as heavy seems best: -0.8 to -2.9 dB on a teapot."""

AIR = 0.03
"""Of the largest line integral: trials leave out columns below it. Without: a tooth takes 129 CPU s instead of 55."""

BESIDE_MATTER = 0.05
"""Of the width of the matter: air on either side that they keep, so that no matter is cut at the edge."""

LEAST_VIEWS = 2 * ONE_IN

_ERRORS = 1.0  # standard errors of the difference, up to which two candidates predict alike
TRIAL_ROWS = 16
"""Rows of the slab that trials of a prior see."""

SUBSETS, TV_STEPS = 9, 3  # of a trial
_OCTAVES = 10  # from the first strength, at most: cones of coarse voxels take 6 to 9, and 40 change nothing
TRIALS = 4
"""Trials of a strength, as a rule: 3 to 6 on five scans, some of fewer columns, see `columns_of_matter`."""
CHOICE_SWEEPS = TRIALS * TRIAL_SWEEPS
"""Sweeps of trials for a weight, as a rule."""
MOST_TRIALS = (2 + _OCTAVES) / TRIALS
"""The most sweeps of trials, over those as a rule."""


def beyond_chance(gains: F64, errors: float) -> bool:
    """The mean of gains [view held out] is more than so many of its standard errors, by their scatter."""
    scatter = float(gains.std(ddof=1)) / math.sqrt(gains.size) if gains.size > 1 else 0.0
    return float(gains.mean()) > errors * scatter


def unseen_residuals(model: F32, views: F32, weight: F32 | None, resolution: ViewResolution) -> F64:
    """[view] root mean square of what a volume leaves of each view, at the resolution of voxels.

    The truth leaves the noise alone, by that; of views as measured it would leave more than a sharper volume does.

    Args:
        model: [view, col, row], the projection of the volume by a `Projector` of this resolution.
        views: line integrals as measured, less what no voxel can explain. Values that are not finite do not count.
        weight: of the rays; None: one for all.

    Returns:
        One value for each view of which a ray counts; [inf] where there is none.
    """
    counts = np.isfinite(views) if weight is None else np.isfinite(views) & (weight > 0)
    left = whitened(model - at_voxel_resolution(views, resolution, counts), weight)
    counting = [view[there] for view, there in zip(left, counts, strict=True) if there.any()]
    if not counting:
        return np.full(1, np.inf)
    return np.sqrt(np.array([np.mean(np.square(view, dtype=np.float64)) for view in counting]))


def split_views(geometry: Geometry, one_in: int = ONE_IN) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Views to reconstruct from, and one of so many to judge by, evenly spread in angle."""
    order = np.argsort(np.mod(geometry.angles, geometry.period), kind="stable")
    unseen = np.sort(order[one_in // 2 :: one_in])
    return np.setdiff1d(np.arange(geometry.n_views), unseen), unseen


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


def columns_of_matter(geometry: Geometry, grid: Grid, images: F32) -> tuple[slice, Geometry, Grid] | None:
    """The columns of `images` [view, row, col] that see matter, with some air beside it, and the box that holds it.

    None: they are all columns, or rows do not show slices around the detector's middle.
    """
    if not geometry.rows_show_slices or geometry.is_off_middle or any(grid.centre[1:]):
        return None
    deepest = images.mean(axis=1).max(axis=0)
    there = np.flatnonzero(deepest > AIR * deepest.max())
    axis, width = geometry.axis_col + geometry.shifts[:, 0], geometry.detector_shape[1]
    if not there.size:
        return None
    half = (1 + 2 * BESIDE_MATTER) * max(axis.max() - there[0], there[-1] - axis.min()) + 2
    first, stop = max(0, math.floor(axis.min() - half)), min(width, math.ceil(axis.max() + half) + 1)
    if stop - first == width:
        return None
    views = replace(
        geometry, detector_shape=(geometry.detector_shape[0], stop - first), axis_col=geometry.axis_col - first
    )
    across = 2 * half * geometry.sample_pitch / grid.voxel_size
    sides = (n - 2 * max(0, math.floor((n - across) / 2)) for n in grid.shape[1:])
    return slice(first, stop), views, replace(grid, shape=(grid.shape[0], *sides))


def middle_of_cone(geometry: Geometry, grid: Grid, data: F32, height: int) -> tuple[slice, Geometry, Grid] | None:
    """So many rows in the middle of a cone, as a geometry, and the box that holds their rays.

    None: views of a circle are displaced along the rows, or these rows show little of the matter in `data` [view, row,
    col].
    """
    off, around = geometry.offsets[:, 1], not geometry.centres.any()
    first = round(geometry.axis_row + (0.0 if around else float(np.median(off))) - (height - 1) / 2)
    rows = slice(first, first + height)
    if (around and np.abs(off).max() > 1) or first < 0 or rows.stop > geometry.detector_shape[0]:
        return None
    some = data[:: max(1, len(data) // 8)]
    if np.abs(some[:, rows]).sum() < ENOUGH_MATTER * np.abs(some[:, busiest_rows(some, height)]).sum():
        return None
    # At the far side of the field.
    climb = 0.0 if around else float(np.ptp(off))
    tall = (height + 1 + climb) * geometry.sample_pitch + 2 * geometry.lean
    tall *= 1 + geometry.reach / geometry.source_distance
    slices = math.ceil(tall / grid.spacing[0])
    box = replace(grid, shape=(slices, *grid.shape[1:]), centre=(0.0, *grid.centre[1:]))
    return rows, geometry.rows(rows.start, rows.stop), box


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
    share = min(1.0, TRIAL_ROWS / geometry.detector_shape[0]) * (1 - 1 / ONE_IN)
    return CHOICE_SWEEPS * share if geometry.n_views >= LEAST_VIEWS else 0.0


@dataclass(frozen=True, eq=False)
class Preferred:
    """The strength of a prior that views held out prefer, and the least residual in its search, of each [view]."""

    strength: float
    residuals: F64


def preferred_strength(residuals_of: Callable[[float], F64], first: float) -> Preferred | None:
    """The strength of a prior whose residual is least, sought in octaves from `first`.

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
    return Preferred(first * 2.0**vertex, tried[octave])


def choose_weight(
    problem: VoxelProblem, start: F32, sweeps: int, trial: Callable[[], HeldOutTrial | None] | None = None
) -> NoiseBalance | float:
    """The weight μ of min ½||A x - p||² + μ TV(x), x >= 0: by views held out, where there are any, else by the noise.

    μ is that of all views: noise and prior do not depend on their number. It is sought from FBP: a fit knows the views
    held out, and any weight takes it away from them.

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
        judge.keep("weight", preferred)
        return [preferred.strength]

    first, *noise = problem.decide("weight", chosen)
    return NoiseBalance(first, noise[0], sweeps) if noise else first


class WideViews(NamedTuple):
    """The rows of a trial with all columns, air beside the sample, too: a fit of narrower views is a poorer one.

    Attributes:
        cols: those of the trial.
        seen: makes the problem of the views that are not held out.
        unseen: the geometry of those that are.
    """

    cols: slice
    seen: Callable[[], VoxelProblem]
    unseen: Geometry


class HeldOutTrial:
    """Volumes of a slab from seven of eight views, judged by the others.

    Attributes:
        problem: of the slab.
        start: [y, x, z], the first volume: FBP, or none where no direct method takes the views.
        unseen: the views held out.
        wide: both with all columns.
        direct: the first volume is FBP.
        smooth: the volume of total variation that predicts these best, of those made so far.
    """

    def __init__(
        self, problem: VoxelProblem, start: F32, unseen: VoxelProblem, wide: WideViews, direct: bool
    ) -> None:  # fmt: skip
        self.problem, self.start, self.unseen = replace(problem, go_on=self._go_on), start, unseen
        self.wide, self.direct = wide, direct
        self._subsets = Subsets.of(problem, SUBSETS)
        self._ended, self._least = False, math.inf
        self._known: dict[tuple[str, float], F64] = {}
        self.smooth: F32 | None = None

    @classmethod
    def of(cls, problem: VoxelProblem) -> HeldOutTrial | None:
        """The trial of the rows with most matter; of a cone of those in the middle.

        Columns of air far beside the sample are left out.

        None: fewer than 16 views, a cone as `middle_of_cone`, views held out that weigh nothing in these rows, or
        `problem.trial_goes_on` ends it.
        """
        geometry, grid = problem.projector.geometry, problem.projector.grid
        if geometry.n_views < LEAST_VIEWS or not problem.trial_goes_on():
            return None
        images = problem.data.swapaxes(1, 2)
        if not geometry.is_cone:
            rows = busiest_rows(images, TRIAL_ROWS)
            views, box = slab_of(geometry, grid, rows.start, rows.stop)
            return cls._of_rows(problem, rows, views, box, columns_of_matter(views, box, images[:, rows]))
        if geometry.detector_shape[0] <= TRIAL_ROWS:
            return cls._of_rows(problem, slice(0, geometry.detector_shape[0]), geometry, grid)
        middle = middle_of_cone(geometry, grid, images, TRIAL_ROWS)
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
                projector=Projector(views.select(chosen), box),
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
        wide = WideViews(cols, partial(of_views, others, slice(None), views, box), views.select(judges))
        return cls(seen, np.maximum(first, 0, out=first) if direct else first, unseen, wide, direct)

    def _go_on(self, sweep: int, residual: float) -> bool:
        self._ended = self._ended or not self.problem.trial_goes_on()
        return not self._ended

    @property
    def ended(self) -> bool:
        """The trials were ended; no volume is judged any more."""
        return self._ended

    def residuals_of(self, prior: str, strength: float, volume: Callable[[float], F32]) -> F64:
        """`residuals` of the volume of this prior and strength; kept, so that each volume is made once."""
        if (prior, strength) not in self._known:
            self._known[prior, strength] = self.residuals(volume(strength))
        return self._known[prior, strength]

    def keep(self, prior: str, preferred: Preferred) -> None:
        """Take the least residual of a search as that of the strength it prefers."""
        self._known[prior, preferred.strength] = preferred.residuals

    def of_weight(self, weight: float) -> F64:
        """`residuals` of total variation with this weight; the best volume of all is kept as `smooth`."""
        if ("weight", weight) not in self._known:
            volume = self.with_weight(weight)
            residuals = self._known["weight", weight] = self.residuals(volume)
            if residuals.mean() < self._least:
                self.smooth, self._least = volume, float(residuals.mean())
        return self._known["weight", weight]

    def with_weight(self, weight: float) -> F32:
        """The volume of total variation with this weight."""
        return self.made(lambda part, x: ordered_fista(
            part, x, weight, self._subsets, sweeps=TRIAL_SWEEPS, tv_steps=TV_STEPS
        ))  # fmt: skip

    def made(self, make: Callable[[VoxelProblem, F32], F32], start: F32 | None = None) -> F32:
        """The volume that `make` makes of the first one, which it may overwrite; that one where the trials ended."""
        x = (self.start if start is None else start).copy()
        if self._ended:
            return x
        return make(replace(self.problem, rng=np.random.default_rng(0)), x)  # the same order of subsets for all

    def residuals(self, x: F32, beyond: F32 | None = None) -> F64:
        """`unseen_residuals` of a volume [y, x, z]; infinite where the trials were ended.

        Args:
            beyond: [view held out, col, row], what its model adds to its projection.
        """
        unseen = self.unseen
        if self._ended:
            return np.full(len(unseen.data), np.inf)
        views = unseen.views if beyond is None else unseen.views - beyond
        return unseen_residuals(unseen.projector.forward_lines(x), views, unseen.weight, unseen.projector.resolution)
