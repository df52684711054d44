"""Trials: methods on a part of a scan, judged by how well their volumes predict unseen views."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.assess.lost_mass import compare
from recon.base.arrays import F32, F64, median_deviation
from recon.base.binning import bin_views
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.method import DataUse, Method, Progress, ReconProblem, RunControl
from recon.base.volume import Grid, Volume
from recon.voxels.held_out_weight import (
    LEAST_VIEWS,
    ONE_IN,
    PREFERRED,
    busiest_rows,
    middle_of_cone,
    slab_of,
    split_views,
)
from recon.voxels.iterative import UNITS
from recon.voxels.projector import Projector
from recon.voxels.unexplained import LIMIT, unexplained

ROWS = 32  # rows of a slab; enough for total variation along z
_SMALLEST = 64  # pixels a side: smaller detectors are not binned
_MATTER = 0.1  # share of the largest line integrals
_FULL_TO_WEAK, _FEWEST = 4, 8  # ratio of rows; rows that TV along z needs
_WEAK = 0.05  # share of the fullest rows, from which on rows show the sample
_ERRORS, _NEAR = 2.0, 1.04  # standard errors, and the factor, within which residuals count as equal


@dataclass(frozen=True, eq=False)
class Score:
    """How well a volume predicts unseen views, and how well it explains its own.

    Attributes:
        at: number of its method.
        residuals: [view], median deviation of each view held out from that of the volume, on rays with matter.
        residual_seen: the same of views that it was made from, their mean.
        loses: it lost weak matter that a direct method shows, see `lost_mass`.
        hides: tells whether it leaves structure in its own views, see `unexplained`; called only if others are level.
    """

    at: int
    method: Method
    residuals: F64
    residual_seen: float = math.inf
    loses: bool = False
    hides: Callable[[], bool] = lambda: False

    @property
    def residual(self) -> float:
        """Residual of the views held out."""
        return float(self.residuals.mean())

    @property
    def overfit(self) -> float:
        """Ratio of the residuals of views held out and of its own views; above 1 it follows the noise of the latter."""
        return max(1.0, self.residual / self.residual_seen) if self.residual_seen > 0 else 1.0

    @property
    def penalised(self) -> float:
        """The residual times `overfit`: line integrals average over the noise that a volume follows, so that views
        held out say too little of it (docs/notes/exploration.md)."""
        return self.residual * self.overfit


def predicts_best(
    part: ReconProblem,
    methods: Sequence[Method],
    control: RunControl,
    spare: int | None = None,
    order: Sequence[int] | None = None,
) -> tuple[int | None, str]:
    """Which of the methods predicts unseen views best (one of eight is held out), with all residuals in words.

    A weight of total variation that one trial finds by views held out is that of the next ones. None where `control`
    ends the trials before two are done; one that it cuts short is not judged.

    Args:
        methods: by preference.
        spare: one that is tried only where one after it would be taken.
        order: in which they are tried; None: by preference.

    Raises:
        ValueError: no method takes these views or data.
    """
    n, geometry = part.geometry.n_views, part.geometry
    seen, unseen = split_views(geometry)
    trial, judge, some = (of_views(part, views) for views in (seen, unseen, seen[:: ONE_IN // 2]))
    found: list[tuple[Score, F32]] = []
    refused, begin = [], control.now()
    common: dict[str, Sequence[Any]] = {}

    def stopped() -> bool:
        return control.should_stop is not None and control.should_stop()

    def attempt(at: int) -> None:
        if stopped():
            return
        method = methods[at]
        device = part.device if method.traits.device else "cpu"
        try:
            decide = Decisions(part.seed, common)
            run = RunControl(control.should_stop, _of_trial(control, method.name), now=control.now, decide=decide)
            volume = method.run(replace(trial, device=device), run).volume
        except ValueError as error:
            refused.append(f"{method.name}: {error}")
            return
        if stopped():
            return
        common.update(shared_decisions(decide.made))
        own = float(_residuals(volume, some).mean())
        hides = partial(_hides, volume, trial)
        score = Score(at, method, _residuals(volume, judge), own, hides=hides)
        found.append((score, volume.data))
        if control.on_progress is not None:
            last, done = score.residual, len(found) + len(refused)
            seconds = control.now() - begin
            control.on_progress(Progress(done, len(methods), seconds, last, last, 0, n, unit="methods tried"))

    def scores() -> list[Score]:
        shown = next((volume for score, volume in found if score.method.traits.direct), None)
        return [replace(score, loses=shown is not None and _loses(volume, shown, part)) for score, volume in found]

    regular = [at for at in order or range(len(methods)) if at != spare]
    for at in regular:
        attempt(at)
    if spare is not None and found and best_of(scores())[0].at > spare:
        attempt(spare)
    if len(found) < min(2, len(regular)) and stopped():
        return None, "stopped before the choice"
    if not found:
        raise ValueError("; ".join(refused))
    judged = scores()
    best, passed = best_of(judged)
    listed = [
        f"{s.method.name}{' with more sweeps' * (s.at == spare)} {s.residual:.4g} ({s.overfit:.2f} of seen views"
        f"{', ' * (s.at in passed)}{passed.get(s.at, '')})"
        for s in sorted(judged, key=lambda s: s.residual)
    ]
    late = [methods[at].name for at in regular[len(found) + len(refused) :]] if stopped() else []
    return best.at, "; ".join(listed + [f"{name} not tried in time" for name in late])


def shared_decisions(made: Mapping[str, Sequence[Any]]) -> Mapping[str, Sequence[Any]]:
    """Decisions of a trial that hold for other methods on the same views: the weight of total variation that views held
    out prefer, with its units. Empty where no such weight was found.

    It is not that of more views: from 92 in place of 105 views it is 6 % lighter, which costs 0.1 to 0.4 dB.
    """
    if None in made.get(PREFERRED, [None]):
        return {}
    return {name: made[name][:1] for name in (UNITS, PREFERRED)}


def _of_trial(control: RunControl, name: str) -> Callable[[Progress], None] | None:
    """A listener to one trial, which adds the name of the method. None in a slab: there only slices are counted."""
    listen = control.on_progress
    if listen is None or control.decide is not None:
        return None

    def on_progress(progress: Progress) -> None:
        word = progress.unit or ("steps" if progress.n_gaussians else "iterations")
        listen(replace(progress, unit=f"{word} of the trial of {name}"))

    return on_progress


def best_of(scores: Sequence[Score]) -> tuple[Score, dict[int, str]]:
    """The score to prefer: of those that are level the first that hides nothing. What loses weak matter is not asked,
    unless all do. Returns it, and for each one that is passed over the reason, by its number.

    A residual is level with the smallest one if it lies within two of its standard errors (by its scatter over the
    views) and 4 %. The same holds for the penalised residual. The residual alone prefers a volume that lost some noise,
    and with it a thin crack, which few rays see. It also prefers FISTA-TV to a fit that FISTA-TV finished, though that
    is nearer to the sample (0.1 to 2.6 dB). The penalised one alone prefers what is smooth.
    """
    passed = {score.at: "loses weak matter" for score in scores if score.loses}
    scores = [score for score in scores if not score.loses] or scores
    least, least_penalised = (min(scores, key=attrgetter(name)) for name in ("residual", "penalised"))
    level = [
        score
        for score in sorted(scores, key=lambda s: s.at)
        if score.residual <= _bound(least, least.residual)
        or score.penalised <= _bound(least_penalised, least_penalised.penalised)
    ]
    for score in level if len(level) > 1 else ():
        if not score.hides():
            return score, passed
        passed[score.at] = "hides structure"
    return least, passed


def _bound(least: Score, value: float) -> float:
    """The largest value that is level with the least one, by the scatter of its residuals over the views."""
    many = least.residuals.size > 1 and least.residual > 0
    error = float(least.residuals.std(ddof=1)) / math.sqrt(least.residuals.size) if many else 0.0
    return value * (1 + min(_ERRORS * error / least.residual if many else 0.0, _NEAR - 1))


def part_of(problem: ReconProblem, height: int = ROWS) -> tuple[ReconProblem | None, str]:
    """A part of the problem for trials, and its name: a slab of so many rows, or all rows with binned pixels.

    None if nothing can be held out or projected, with the reason.
    """
    geometry, (rows, cols) = problem.geometry, problem.geometry.detector_shape
    data, weights = problem.projections, problem.use.weights
    if geometry.n_views < LEAST_VIEWS:
        return None, f"{geometry.n_views} views are too few to hold any out"
    if not geometry.is_cone:
        if rows <= height:
            return problem, "all rows"
        some = masked(data[:: max(1, len(data) // 8)])[0]
        apart = geometry.rows_show_slices and not geometry.skew
        taken = _full_and_weak_rows(some, height, _lit_rows(problem)) if apart else [busiest_rows(some, height)]
        count = sum(each.stop - each.start for each in taken)
        first = taken[0].start if len(taken) == 1 else 0  # rows that were put together lie anywhere
        return _of_rows(problem, taken, *slab_of(geometry, problem.grid, first, first + count))
    if min(rows, cols) < _SMALLEST:
        return problem, "all rows"
    middle = _middle_rows(problem, height)
    if middle is not None:
        return middle
    filled = masked(data, weights)[0]
    views = geometry.binned(2)
    coarse = replace(
        problem, projections=bin_views(filled, 2), geometry=views, grid=Grid.matching(views), use=DataUse()
    )
    return coarse, "binned 2 x 2"


def _lit_rows(problem: ReconProblem) -> NDArray[np.bool_] | None:
    """[row] whether some view has a ray of weight there; None: all have."""
    weights = problem.use.weights
    return None if weights is None else np.asarray((weights != 0).any(axis=(0, 2)))


def _full_and_weak_rows(some: F32, height: int, lit: NDArray[np.bool_] | None) -> list[slice]:
    """Rows of line integrals [view, row, col]: so many where the sample is fullest, and some where it is weakest.

    Rows that are not lit were filled from others and are never the weakest.
    """
    full, few = busiest_rows(some, height), height // _FULL_TO_WEAK
    matter = some.mean(axis=0, dtype=np.float64).std(axis=1)  # 0 where there is air alone, whatever its level
    if lit is not None:
        matter[~lit] = 0
    matter[matter < _WEAK * matter.max()] = np.inf
    sums = np.convolve(matter, np.ones(few), "valid")
    first = int(np.argmin(sums))
    if few < _FEWEST or math.isinf(sums[first]) or (full.start <= first + few and first <= full.stop):
        return [full]
    return sorted([slice(first, first + few), full], key=attrgetter("start"))


def _middle_rows(problem: ReconProblem, height: int) -> tuple[ReconProblem, str] | None:
    """So many rows in the middle of a cone and the box that holds their rays; None if they have little matter."""
    some = masked(problem.projections[:: max(1, len(problem.projections) // 8)])[0]
    found = middle_of_cone(problem.geometry, problem.grid, some, height)
    if found is None:
        return None
    rows, views, box = found
    return _of_rows(problem, [rows], views, box)


def _of_rows(problem: ReconProblem, rows: Sequence[slice], views: Geometry, grid: Grid) -> tuple[ReconProblem, str]:
    """The problem of some rows, put together."""
    weights = problem.use.weights
    cut = _rows_of(problem.projections, rows)
    use = DataUse(None if weights is None else _rows_of(weights, rows))
    part = replace(problem, projections=cut, geometry=views, grid=grid, use=use)
    return part, "rows " + " and ".join(f"{r.start} to {r.stop - 1}" for r in rows)


def _rows_of(data: F32, rows: Sequence[slice]) -> F32:
    return np.concatenate([data[:, some] for some in rows], axis=1)


def of_views(problem: ReconProblem, views: NDArray[np.intp]) -> ReconProblem:
    """The problem of these views alone."""
    weights = problem.use.weights
    return replace(
        problem, projections=problem.projections[views], geometry=problem.geometry.select(views),
        use=DataUse(None if weights is None else weights[views]),
    )  # fmt: skip


def _residuals(volume: Volume, problem: ReconProblem) -> F64:
    """Median deviation [view] of the views from those of a volume, negative values at zero, on rays with matter."""
    left = problem.projections - Projector(problem.geometry, volume.grid).forward(np.maximum(volume.data, 0))
    if problem.use.weights is not None:
        left[problem.use.weights == 0] = np.nan
    matter = problem.projections > _MATTER * np.nanpercentile(problem.projections, 99)
    seen = np.where(matter, left, np.nan) if matter.any() else left
    found = np.array([median_deviation(view) for view in seen if np.isfinite(view).any()])
    return found if found.size else np.full(1, np.inf)


def _loses(volume: F32, shown: F32, problem: ReconProblem) -> bool:
    """The volume lost weak matter that this one, of a direct method, shows."""
    lit = _lit_rows(problem) if problem.geometry.rows_show_slices else None
    beside = compare(volume, shown, lit if lit is not None and lit.size == len(volume) else None)
    return beside is not None and beside.lost is not None


def _hides(volume: Volume, problem: ReconProblem) -> bool:
    """The volume leaves structure in the views that it was made from, such as a crack that it fills."""
    left = unexplained(volume, masked(problem.projections)[0], problem.geometry, np.random.default_rng(problem.seed))
    return left is not None and left.share > LIMIT
