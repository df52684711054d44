"""run_fit: a whole R²-Gaussian fit, by a number of steps or a clock, with views held out and checkpoints."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.assess.time_model import MODEL_STEPS, MOST_STEPS
from recon.base.arrays import F32
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.masks import masked, usual_weight
from recon.base.method import DataUse, Progress, ReconProblem, Reconstruction, RunControl
from recon.base.ray_width import NO_WIDTH
from recon.base.views import used_and_kept_back
from recon.base.volume import Grid, Volume
from recon.splatting import optimise as fit
from recon.splatting.backend import Backend, backend_for
from recon.splatting.checkpoint import HeldOutTracker, arrays_of, decisions_from, decisions_of, state_from
from recon.splatting.finish import Candidates, finish, judged
from recon.splatting.fit_method import FitMethod
from recon.splatting.gaussians import Gaussians, turned_by_rows
from recon.splatting.in_time import (
    FinishPlan,
    fill_seconds,
    planned_finish,
)
from recon.splatting.initialise import (
    default_count,
    first_volume,
    joined_for,
    mean_change,
    place,
)
from recon.splatting.optimise import FitState
from recon.splatting.problem import FitProblem, join_pixels
from recon.splatting.settings import FitSettings, growth, in_steps, tv_size, tv_weight
from recon.splatting.splat import voxel_means
from recon.voxels.held_out import LEAST_GAIN, cheapest_not_led, unseen_residuals
from recon.voxels.iterative import UNITS
from recon.voxels.methods import FistaTv, PnpDct
from recon.voxels.projector import Projector, projection_lines

_ON_VOXELS = FistaTv, PnpDct  # candidates that a fit is compared with, the simpler one first
_DECIDED = "candidate", UNITS, "weight", "strength"  # decisions that a checkpoint keeps

_TIMED = 3  # steps after which a fit's seconds are planned
_LOOK = 50  # steps between two measurements of the views held out
_PATIENCE = 0.2  # share of the planned steps, and at least six measurements, that may pass without a better model


@dataclass(frozen=True, eq=False)
class _Views:
    """The views of a fit, and those kept back.

    Attributes:
        all_geometry: geometry of all views, with an angle of each row.
        data, weights: of all views, finite; weights of a mean of about 1 on matter.
        used, kept_back: numbers of views.
        joined: pixels that are joined for the steps.
        seen: geometry of the views that the steps see, `p` their line integrals, `p_weights` their weights.
        field: box of the Gaussians.
        count: Gaussians at the start.
        fitted: what the finish sees.
    """

    all_geometry: Geometry
    data: F32
    weights: F32 | None
    used: NDArray[np.intp]
    kept_back: NDArray[np.intp]
    joined: int
    seen: Geometry
    p: F32
    p_weights: F32 | None
    field: Grid
    count: int
    fitted: ReconProblem

    @classmethod
    def of(cls, method: FitMethod, problem: ReconProblem) -> _Views:
        # Slices that turn against each other are a twist of the model: the fit sees all rows at the angle of the first.
        all_geometry, geometry = problem.geometry, problem.geometry.at_row(0)
        if all_geometry.skew and isinstance(method.gaussians, Gaussians):
            raise ValueError("Gaussians to start from are refused where rows have different angles: give their number")
        if geometry.width and problem.device != "cpu":
            warnings.warn(
                f"a fit on {problem.device} takes rays without a width: only its finish on voxels knows "
                f"{geometry.width}",
                stacklevel=3,
            )
            geometry = geometry.seen_with(NO_WIDTH)
        used, kept_back = used_and_kept_back(geometry.n_views, tuple(problem.use.held_out), method.early_stop)
        data, weights = masked(problem.projections, problem.use.weights)
        if weights is not None:  # only ratios of weights mean something: total variation has a weight of its own
            weights = weights / np.float32(usual_weight(weights, data))
        blank = kept_back[~data[kept_back].any(axis=(1, 2))]
        if blank.size:
            raise ValueError(f"held_out: views {blank.tolist()} are zero everywhere; choose other held-out views")
        views, start = geometry.select(used), method.gaussians
        pixel_grid = Grid.for_fit(geometry, problem.grid)
        usual = default_count(views, pixel_grid.voxel_size)
        count = start.n if isinstance(start, Gaussians) else usual if start is None else start
        if count < 1:
            raise ValueError(f"a model needs at least one Gaussian, got {count}")
        joined = method.fit.joined_pixels or joined_for(
            pixel_grid, geometry.is_cone, max(count, usual), geometry.detector_shape
        )  # fmt: skip
        measured, trusted = data[used], None if weights is None else weights[used]
        p, p_weights, seen = join_pixels(measured, trusted, views, joined)
        field = Grid.for_fit(seen, problem.grid, wider=problem.wide)
        fitted = replace(problem, projections=measured, geometry=all_geometry.select(used), use=DataUse(trusted))
        return cls(all_geometry, data, weights, used, kept_back, joined, seen, p, p_weights, field, count, fitted)

    def unseen(self, problem: FitProblem, settings: FitSettings, unit: float) -> FitProblem | None:
        """The views kept back, as the steps see theirs."""
        if not self.kept_back.size:
            return None
        weights = None if self.weights is None else self.weights[self.kept_back]
        geometry = self.all_geometry.at_row(0).select(self.kept_back).seen_with(self.seen.width)
        q, others, apart = join_pixels(self.data[self.kept_back], weights, geometry, self.joined)
        return fit.problem_of(q, apart, self.field, unit, settings, problem.backend, others)


@dataclass(eq=False)
class _Length:
    """Length of a fit, in steps or seconds.

    Attributes:
        steps: end the fit; None: only `seconds` end it.
        seconds: of the steps, by the caller's clock; None: `steps` alone end it.
        sweeps: of the finish; None: as it takes by default.
        trials: the finish may try priors.
        planned: the seconds are divided among steps and finish.
    """

    steps: int | None
    seconds: float | None
    sweeps: int | None
    trials: bool
    planned: bool

    def fraction(self, step: int, spent: float) -> float:
        """Share of the fit that is done after so many steps and seconds, 0..1."""
        by_steps = step / self.steps if self.steps else 0.0
        return min(1.0, max(by_steps, spent / self.seconds if self.seconds else 0.0))

    def plan(self, plan: FinishPlan, spent: float) -> None:
        """Reserve time for the finish."""
        self.sweeps, finishing, self.trials = plan
        self.planned = True
        if self.seconds is not None:
            self.seconds = max(spent, self.seconds - finishing)


@dataclass(eq=False)
class _Run:
    """A fit on its way: what its phases share."""

    method: FitMethod
    problem: ReconProblem
    control: RunControl
    decide: Decisions
    views: _Views
    begin: float
    end: float
    state: FitState
    fitting: FitProblem
    tracker: HeldOutTracker
    length: _Length
    settings: FitSettings
    history: list[Progress] = field(default_factory=list)

    @property
    def stopped(self) -> bool:
        return self.control.stop()

    @property
    def stopped_falling(self) -> bool:
        """Whether the residual of views held out has not fallen for a while."""
        patience = max(6 * _LOOK, _PATIENCE * (self.length.steps or 0))
        return self.state.step - self.tracker.best_step > patience

    def model(self) -> tuple[Volume, Gaussians]:
        """The volume of the Gaussians, and these, turned as the rows see them."""
        model = turned_by_rows(fit.gaussians_of(self.state, self.fitting.backend), self.views.all_geometry, 1)
        filled = voxel_means(
            model, self.problem.grid, self.fitting.geometry, truncation=self.method.fit.truncation
        ).numpy()
        return Volume(filled, self.problem.grid), model

    def report(self, at: float) -> None:
        state = self.state
        self.history.append(
            Progress(
                state.step, self.length.steps or 0, at - self.begin, float(state.loss), float(state.residual), state.n,
                self.views.seen.n_views, self.tracker.value,
            )
        )  # fmt: skip
        self.control.tell(self.history[-1])

    def checkpoint(self, state: FitState) -> dict[str, NDArray[Any]]:
        return arrays_of(state, self.fitting.backend) | self.tracker.arrays() | decisions_of(self.decide.made, _DECIDED)


def run_fit(method: FitMethod, problem: ReconProblem, control: RunControl) -> Reconstruction:
    """Fit the line integrals of a problem; see `R2`.

    Where the length of the fit is not given, views held out tell whether it predicts better than voxels do. If not, it
    is a short one, and its volume is that of the better prior on voxels, see `finish.judged`.

    Raises:
        ValueError: for a problem that the method cannot be fitted to.
    """
    begin, decide = control.now(), control.decide or Decisions(problem.seed)
    views = _Views.of(method, problem)
    decide.preset(decisions_from(control.resume or {}))
    fit_at = len(_ON_VOXELS)
    at = int(decide("candidate", lambda: _candidate(method, views, control, decide))) if method.by_content else fit_at
    run = _started(method, problem, control, decide, views, begin)
    if at < fit_at:
        run.length.steps = MODEL_STEPS
    n_start = run.state.n
    _steps(run)
    last = run.state
    if run.tracker.kept:
        run.state = state_from(run.tracker.kept, run.fitting.backend)
    volume, model = run.model()
    made_by, sweeps = method.name, 0
    if at < fit_at and not run.stopped:
        on_voxels = _ON_VOXELS[at](allow_negative=method.allow_negative)
        volume = on_voxels.run(views.fitted, replace(control, decide=decide)).volume
        made_by = on_voxels.name
    elif at == fit_at:
        volume, sweeps = _finished(run, volume, model)
    settings, state = run.settings, run.state
    record = {
        **asdict(settings), "kernel": state.kernel, "steps": state.step, "seed": problem.seed, "start": method.start,
        "gaussians_at_start": n_start, "gaussians": state.n, "held_out": tuple(problem.use.held_out),
        "device": problem.device, "finish": sweeps, "volume_by": made_by, "joined_pixels": views.joined,
        "tv_weight": tv_weight(settings, run.fitting, state.limit), "tv_size": tv_size(settings, views.field),
    }  # fmt: skip
    return Reconstruction(volume, record, tuple(run.history), model, run.checkpoint(last), started_from=n_start)


def trials_of(
    method: FitMethod, problem: ReconProblem, control: RunControl, least_gain: float = LEAST_GAIN
) -> Candidates:
    """Residuals of held-out views for a fit and for methods on voxels."""

    def short(part: ReconProblem, watched: RunControl, of_steps: float) -> Reconstruction:
        share = part.geometry.detector_shape[0] / problem.geometry.detector_shape[0]
        return run_fit(method.for_trial(share, of_steps), part, watched)

    return judged(problem, method.fit, control, short, least_gain)


def _candidate(method: FitMethod, views: _Views, control: RunControl, decide: Decisions) -> int:
    """Which of the methods on voxels predicts views held out best; their number: the fit. The prior is then decided."""
    tried = trials_of(method, views.fitted, control)
    decide.preset(tried.prior)
    at = cheapest_not_led((tried.smooth, tried.patches, tried.fit))
    return len(_ON_VOXELS) if at is None else at


def _started(
    method: FitMethod, problem: ReconProblem, control: RunControl, decide: Decisions, views: _Views, begin: float
) -> _Run:
    """The fit before its first step, or as a checkpoint holds it."""
    now, settings, start, backend = control.now, method.fit, method.gaussians, backend_for(problem.device)
    end = math.inf if method.seconds is None else begin + method.seconds
    first = None
    if control.resume is None:
        if not isinstance(start, Gaussians):
            first = first_volume(views.p, views.seen, views.field, method.start, problem.device)
            start = place(
                first, views.p, views.seen, views.count, np.random.default_rng(problem.seed),
                start=method.start, rays=settings.rays, kernel=settings.kernel,
            )  # fmt: skip
            first = first if method.start == "fbp" else None
        state = fit.init(start, problem.seed, growth(settings), backend)
    else:
        state = _resumed(control.resume, problem.geometry.n_views, backend)
    fitting = fit.problem_of(views.p, views.seen, views.field, state.unit, settings, backend, views.p_weights)
    if settings.tv_weight is None:
        change = decide("change", lambda: mean_change(views.p, views.seen, views.field, first, problem.device))
        fitting = replace(fitting, change=change)
    unseen = views.unseen(fitting, settings, state.unit)
    tracker = HeldOutTracker.over(unseen, settings, state.step, control.resume or {})
    seconds = method.seconds
    if seconds is not None:
        seconds = max(0.0, end - fill_seconds(fit.gaussians_of(state, backend), problem.grid, now) - now())
    planned = method.finish_sweeps == 0 or method.seconds is None
    length = _Length(method.planned_steps, seconds, method.finish, True, planned)
    if length.steps is not None:
        settings = in_steps(settings, length.steps)
    return _Run(method, problem, control, decide, views, begin, end, state, fitting, tracker, length, settings)


def _steps(run: _Run) -> None:
    """The steps of the fit, to its end or until it is stopped."""
    now, length, state, method = run.control.now, run.length, run.state, run.method
    begin = reported = saved = now()
    done = 0
    while length.steps is None or state.step < length.steps:
        spent = now() - begin
        if done and (run.stopped or (length.seconds is not None and spent >= length.seconds)):
            break
        fit.step(state, run.fitting, run.settings, length.fraction(state.step, spent))
        done += 1
        if done >= _TIMED and length.seconds is not None:
            _pace(run, length.seconds, now() - begin, done)
        if state.step % _LOOK == _LOOK - 1:  # before density control, whose changes take some steps to settle
            run.tracker.measure(state, method.early_stop)
        if now() - reported > 0.1 or done == 1:
            reported = now()
            run.report(reported)
        if run.control.on_checkpoint is not None and now() - saved >= run.control.checkpoint_every:
            run.control.on_checkpoint(run.checkpoint(state))
            saved = now()  # the time that saving takes must not crowd out the fit
        if method.early_stop and run.stopped_falling:
            break
    run.tracker.measure(state, method.early_stop)
    run.report(now())


def _pace(run: _Run, seconds: float, spent: float, done: int) -> None:
    """Plan the finish and the rates by the time that the first `done` steps took, for a fit of so many `seconds`."""
    length, state = run.length, run.state
    remaining, step = seconds - spent, spent / done
    if not length.planned and done == _TIMED:
        length.plan(FinishPlan(*run.decide("finish", partial(_finish_in_time, run, remaining, step))), spent)
        assert length.seconds is not None
        remaining = length.seconds - spent
    if step > 0:  # the first steps are slower than the others, so that this is learnt as they come
        expected = state.step + max(0.0, remaining) / step
        run.settings = in_steps(run.method.fit, min(expected, length.steps or expected))


def _finished(run: _Run, volume: Volume, model: Gaussians) -> tuple[Volume, int]:
    """The volume of the fit, refined on voxels where time is left for it, and the sweeps."""
    method, length, now, kept_back = run.method, run.length, run.control.now, run.views.kept_back
    if method.finish_sweeps == 0:
        return volume, 0
    if not length.planned:  # the fit has ended before
        length.plan(FinishPlan(*run.decide("finish", partial(_finish_in_time, run, run.end - now(), 0.0))), 0.0)
    if length.sweeps == 0 or now() >= run.end or run.stopped:
        return volume, 0
    control = replace(run.control, decide=run.decide)
    if method.seconds is not None:
        control = control.by(run.end)
    control = replace(control, stop_trials=None if length.trials else lambda: True)
    finished, sweeps = finish(
        volume, model, run.views.fitted, length.sweeps, method.fit, control, not method.allow_negative
    )  # fmt: skip
    if kept_back.size:
        views = run.views.all_geometry.select(kept_back)
        if _predicts_worse(finished, volume, run.views.data[kept_back], views):
            return volume, 0
    return finished, sweeps


def _finish_in_time(run: _Run, remaining: float, step: float) -> FinishPlan:
    """The plan of the finish, if so many seconds remain after first steps of `step` seconds each."""
    return planned_finish(run.method, remaining, MOST_STEPS * step, run.views.fitted, run.control.now)


def _predicts_worse(finished: Volume, fitted: Volume, unseen: F32, views: Geometry) -> bool:
    """Whether the finished volume leaves more of the views held out than the fit's, by more than 0.1 dB."""
    projector, lines = Projector(views, fitted.grid), projection_lines(unseen)
    after, before = (
        np.square(unseen_residuals(projection_lines(projector.forward(volume.data)), lines, None, projector.resolution))
        for volume in (finished, fitted)
    )
    return bool(after.mean() > 10 ** (0.1 / 10) * before.mean())


def _resumed(checkpoint: Mapping[str, NDArray[Any]], n_views: int, backend: Backend[Any]) -> FitState:
    """The state that a checkpoint holds."""
    state = state_from(checkpoint, backend)
    if max(state.drawn, default=0) >= n_views:
        raise ValueError(
            f"the checkpoint belongs to a fit with at least {max(state.drawn) + 1} views, these are {n_views}: "
            "resume takes the same data and settings"
        )
    return state
