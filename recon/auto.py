"""Auto: the method that predicts views held out best, chosen on a part of the scan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F64, bin_views
from recon.base.choices import AUTO, Quality
from recon.base.decisions import Decisions
from recon.base.declared_types import NonNegative, check_settings
from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.method import (
    DataUse,
    Method,
    Progress,
    ReconProblem,
    Reconstruction,
    RunControl,
    Traits,
)
from recon.base.volume import Grid
from recon.splatting.finish import FIRST_SHARE, beyond_voxels, level_of
from recon.splatting.fit_method import FitMethod
from recon.splatting.r2 import R2
from recon.splatting.train import trials_of
from recon.voxels.direct import Fbp
from recon.voxels.field_edges import busiest_rows, middle_of_cone, slab_of
from recon.voxels.held_out import (
    LEAST_GAIN,
    LEAST_VIEWS,
    TRIAL_ROWS,
    cheapest_not_led,
    split_views,
    unseen_residuals,
)
from recon.voxels.iterative import prior_decisions
from recon.voxels.methods import FistaTv, PnpDct
from recon.voxels.projector import Projector, projection_lines

LEFT = "root mean square left of views held out, in line integrals"
"""What a trial states: on some rows, with rays weighed. The data residual of a volume is a share of the views."""

ROWS = 32  # rows of a slab; enough for total variation along z
_SMALLEST = 64  # pixels a side: smaller detectors are not binned


class TrialsVerdict(NamedTuple):
    """Result of trials.

    Attributes:
        best: number of the method to take; None: the trials ended before two were done.
        reason: all residuals in words.
    """

    best: int | None
    reason: str


def predicts_best(
    part: ReconProblem,
    methods: Sequence[Method],
    control: RunControl,
    least_gain: float = LEAST_GAIN,
) -> TrialsVerdict:
    """Which method predicts held-out views (one of eight) as well as the best, and is the first to do so.

    A prior that one trial chooses by views held out is that of the next ones. A method that `control` cuts short is not
    judged.

    Args:
        methods: the simplest and cheapest first.
        least_gain: as of `cheapest_not_led`.

    Raises:
        ValueError: no method takes these views or data.
    """
    n, begin = part.geometry.n_views, control.now()
    trial, judge = (of_views(part, views) for views in split_views(part.geometry))
    residuals: dict[int, F64] = {}
    refused: list[str] = []
    decided: dict[str, Sequence[Any]] = {}

    for at, method in enumerate(map(_candidate, methods)):
        if control.stop():
            break
        device, decide = part.device if method.traits.device else "cpu", Decisions(part.seed, decided)
        tell = _of_trial(control, f"{method.name}, {at + 1} of {len(methods)}")
        run = RunControl(control.should_stop, tell, now=control.now, decide=decide)
        try:
            made = method.run(replace(trial, device=device), run)
        except ValueError as error:
            refused.append(f"{method.name}: {error}")
            continue
        if control.stop():
            break
        decided.update(prior_decisions(decide.made))
        residuals[at] = _residuals(made, method, judge)
        last = float(residuals[at].mean())
        control.tell(Progress(at + 1, len(methods), control.now() - begin, last, last, 0, n, unit="methods tried"))
    tried = sorted(residuals)
    listed = "; ".join(f"{methods[at].name} {residuals[at].mean():.4g}" for at in tried)
    if len(tried) + len(refused) < len(methods):
        if len(tried) < 2:
            return TrialsVerdict(None, "stopped before the choice")
        listed += "; the others not tried in time"
    if not tried:
        raise ValueError("; ".join(refused))
    return TrialsVerdict(cheapest_not_led([residuals.get(at) for at in range(len(methods))], least_gain), listed)


def _candidate(method: Method) -> Method:
    """The method as it competes: one that would itself choose among others makes its own volume."""
    return method.as_candidate() if isinstance(method, FitMethod) else method


def _of_trial(control: RunControl, name: str) -> Callable[[Progress], None] | None:
    """A listener to one trial, which adds its name. None in a slab: there only slices are counted."""
    listen = control.on_progress
    if listen is None or control.decide is not None:
        return None

    def on_progress(progress: Progress) -> None:
        word = progress.unit or ("steps" if progress.n_gaussians else "iterations")
        listen(replace(progress, unit=f"{word} of the trial of {name}"))

    return on_progress


def part_of(problem: ReconProblem, height: int = ROWS) -> tuple[ReconProblem | None, str]:
    """The part of the problem used for trials, and its name: a slab of so many rows, or all rows with binned pixels.

    None if nothing can be held out or projected, with the reason.
    """
    geometry, (rows, cols) = problem.geometry, problem.geometry.detector_shape
    data = problem.projections
    if geometry.n_views < LEAST_VIEWS:
        return None, f"{geometry.n_views} views are too few to hold any out"
    if not geometry.is_cone:
        if rows <= height:
            return problem, "all rows"
        taken = busiest_rows(masked(data[:: max(1, len(data) // 8)])[0], height)
        return _of_rows(problem, taken, *slab_of(geometry, problem.grid, taken.start, taken.stop))
    if min(rows, cols) < _SMALLEST:
        return problem, "all rows"
    some = masked(data[:: max(1, len(data) // 8)])[0]
    if (middle := middle_of_cone(geometry, problem.grid, some, height)) is not None:
        return _of_rows(problem, *middle)
    filled = masked(data, problem.use.weights)[0]
    views = geometry.binned(2)
    coarse = replace(
        problem, projections=bin_views(filled, 2), geometry=views, grid=Grid.matching(views), use=DataUse()
    )
    return coarse, "binned 2 x 2"


def _of_rows(problem: ReconProblem, rows: slice, views: Geometry, grid: Grid) -> tuple[ReconProblem, str]:
    """The problem of some rows."""
    weights = problem.use.weights
    use = DataUse(None if weights is None else np.ascontiguousarray(weights[:, rows]))
    part = replace(
        problem, projections=np.ascontiguousarray(problem.projections[:, rows]), geometry=views, grid=grid, use=use
    )
    return part, f"rows {rows.start} to {rows.stop - 1}"


def of_views(problem: ReconProblem, views: NDArray[np.intp]) -> ReconProblem:
    """The problem restricted to these views."""
    weights = problem.use.weights
    return replace(
        problem, projections=problem.projections[views], geometry=problem.geometry.select(views),
        use=DataUse(None if weights is None else weights[views]),
    )  # fmt: skip


def _residuals(made: Reconstruction, method: Method, problem: ReconProblem) -> F64:
    """`unseen_residuals` of a result, negative values at zero; of a fit less the level of what is beyond them."""
    grid = made.volume.grid
    projector, views = Projector(problem.geometry, grid), problem.projections
    if made.gaussians is not None and isinstance(method, FitMethod):
        beyond = beyond_voxels(made.gaussians, problem.geometry, grid, method.fit)
        views = views if beyond is None else views - level_of(beyond)
    model, weights = projector.forward(np.maximum(made.volume.data, 0)), problem.use.weights
    model, views = (projection_lines(each) for each in (model, views))
    rays = None if weights is None else projection_lines(weights)
    return unseen_residuals(model, views, rays, projector.resolution)


@dataclass(frozen=True, eq=False)
class Auto:
    """Tries methods on a part of the scan, and takes the cheapest that predicts views held out as well as the best.

    The part is the sixteen rows where most matter is, of a cone those in its middle. One of eight views is held out.
    Where the middle of a cone holds little matter, or methods have settings of their own, each is run on 32 rows, or on
    all of them at half the resolution. Trials need at least 16 views; with fewer the last candidate is used.
    docs/choosing.md has reasons.

    Attributes:
        candidates: the methods, the simplest and cheapest first.
        least_gain: share by which a costlier method must lower the residual of views held out.
    """

    name: ClassVar[str] = AUTO
    label: ClassVar[str] = "Automatic choice"
    traits: ClassVar[Traits] = Traits(
        device=True, budget=True, presets=True, needs_matter=True, halo=max(R2.traits.halo, FistaTv.traits.halo)
    )

    candidates: tuple[Method, ...] = field(default_factory=lambda: (Fbp(), FistaTv(), PnpDct(), R2()))
    least_gain: NonNegative = LEAST_GAIN

    def __post_init__(self) -> None:
        check_settings(self)
        if not self.candidates:
            raise ValueError("candidates must contain at least one method, got none")

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        """The result of the chosen method, with the reason for the choice.

        Raises:
            ValueError: no candidate takes these views or data.
        """
        decide = control.decide or Decisions(problem.seed)
        at, because, tried = decide("method", lambda: self.choose(problem, control, decide))
        chosen = self.candidates[at]
        if tried:  # with its rivals
            chosen = _candidate(chosen)
        device = problem.device if chosen.traits.device else "cpu"
        result = chosen.run(replace(problem, device=device), replace(control, decide=decide))
        settings = {**result.settings, "chosen_method": chosen.name, "chosen_because": because}
        return replace(result, settings=settings, method=chosen.name, chosen=because)

    def choose(self, problem: ReconProblem, control: RunControl, decide: Decisions) -> tuple[int, str, bool]:
        """Number of the chosen method, the reason, and whether there were trials.

        Methods that views held out judge in one trial, as `r2` does, are not run for it. `decide` takes its prior.
        """
        data = problem.projections
        if not any(np.isfinite(view).any() and np.nan_to_num(view, posinf=0, neginf=0).any() for view in data):
            raise ValueError("projections are zero everywhere: there is nothing to reconstruct")
        last = len(self.candidates) - 1
        fit = self._fit
        if fit is not None:
            listen = control.on_progress if control.decide is None else None  # in a slab only slices are counted
            tried = trials_of(fit, problem, replace(control, on_progress=listen), self.least_gain)
            of_voxels = {Fbp: tried.direct, FistaTv: tried.smooth, PnpDct: tried.patches}
            residuals = [of_voxels.get(type(method), tried.fit) for method in self.candidates]
            at = cheapest_not_led(residuals, self.least_gain)
            if at is not None:
                decide.preset(tried.prior)
                named = zip(self.candidates, residuals, strict=True)
                listed = "; ".join(f"{method.name} {each.mean():.4g}" for method, each in named if each is not None)
                rows = min(TRIAL_ROWS, problem.geometry.detector_shape[0])
                return at, f"trials on {rows} rows, {LEFT}: {listed}{_ended_early(fit, tried.full_trial_seconds)}", True
        part, where = part_of(problem)
        if part is None:
            return last, where, False
        at, because = predicts_best(part, self.candidates, control, least_gain=self.least_gain)
        if at is None:
            return last, because, False
        return at, f"trials on {where}, {LEFT}: {because}", True

    @property
    def _fit(self) -> FitMethod | None:
        """The fit among the candidates, where one trial judges all of them; else None."""
        *others, last = self.candidates
        fits = last if isinstance(last, FitMethod) and last.by_content else None
        return fits if all(_judged_beside(method) for method in others) else None

    def with_quality(self, quality: Quality, default_count: int) -> Self:
        """A preview has no costly candidates; the best needs no minimum gain, and ends no fit that is behind."""
        if quality == "preview":
            return replace(self, candidates=self.candidates[:2])
        return replace(self, least_gain=0.0) if quality == "best" else self

    def toy(self) -> Self:
        return replace(self, candidates=tuple(method.toy() for method in self.candidates))

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        return max(method.memory(geometry, grid, weighted) for method in self.candidates)


def _judged_beside(method: Method) -> bool:
    """The trial of a fit judges this method, too."""
    match method:
        case FistaTv():
            return method.tv_weight is None
        case PnpDct():
            return method.patch_threshold is None
    return isinstance(method, Fbp)


def _ended_early(fit: FitMethod, seconds: float) -> str:
    """What a trial would cost whose fit ended early."""
    after = f"; {fit.name} stopped after {FIRST_SHARE:.0%} of its steps, too far behind"
    return f"{after} (a full trial: about {seconds:.2g} s; --quality best runs it)" if seconds else ""
