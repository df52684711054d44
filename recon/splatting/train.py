"""run_fit: a complete R²-Gaussian fit, ended by steps or time, with held-out projections and checkpoints."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.assess.time_model import MOST_STEPS
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.masks import usual_weight
from recon.base.method import Progress, ReconProblem, Reconstruction, RunControl
from recon.base.ray_width import NO_WIDTH
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.splatting import optimise as fit
from recon.splatting.backend import Backend, backend_for
from recon.splatting.checkpoint import HeldOutTracker, arrays_of, state_from
from recon.splatting.finish import finish
from recon.splatting.fit_method import Fit
from recon.splatting.gaussians import Gaussians, turned_by_rows
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
from recon.splatting.time_limit import (
    FinishPlan,
    fill_seconds,
    planned_finish,
)
from recon.voxels.residuals import residuals_of

_TIMED_STEPS = 3  # number of steps after which the time of a fit is planned
_LOOK = 50  # number of steps between two measurements in held-out projections
_PATIENCE_SHARE = 0.2  # share of the planned steps that may pass without a better model, but at least six measurements


@dataclass(frozen=True, eq=False)
class _FitViews:
    """The projections of a fit, and the held-out ones.

    Attributes:
        fitted: projections for the voxel refinement: all values finite, mean weight in the sample about 1.
        kept_back: the held-out projections in the same form; None: there are none.
        joined: factor by which pixels are binned for the fitting steps.
        step_views: geometry and data of the projections in the form that the fitting steps use.
        field: box of the Gaussians.
        count: number of Gaussians at the start.
    """

    fitted: ReconProblem
    kept_back: Views | None
    joined: int
    step_views: Views
    field: Grid
    count: int

    @classmethod
    def of(cls, method: Fit, problem: ReconProblem) -> _FitViews:
        if problem.geometry.skew and isinstance(method.gaussians, Gaussians):
            raise ValueError(
                "a fit whose rows have different angles cannot start from given Gaussians; give a number of "
                "Gaussians instead"
            )
        if problem.geometry.width and problem.device != "cpu":
            warnings.warn(
                f"on {problem.device} the Gaussian fit ignores the width of the rays; only the voxel refinement takes "
                f"{problem.geometry.width} into account",
                stacklevel=3,
            )
        views = problem.views.masked()
        if method.early_stop and not views.held_out.size:
            raise ValueError("early_stop needs held-out projections; state their numbers in held_out")
        # only ratios of weights matter, because total variation has its own weight
        if (rays := views.weights) is not None:
            views = replace(views, weights=rays / np.float32(usual_weight(rays, views.data)))
        kept_back = views.unseen
        blank = views.held_out[~views.data[views.held_out].any(axis=(1, 2))]
        if blank.size:
            raise ValueError(
                f"hold out other projections: the held-out projections {blank.tolist()} are zero everywhere"
            )
        measured, start = views.seen, method.gaussians
        geometry = _of_steps(measured.geometry, problem.device)
        pixel_grid = Grid.for_fit(_of_steps(views.geometry, problem.device), problem.grid)
        usual = default_count(geometry, pixel_grid.voxel_size)
        count = start.n if isinstance(start, Gaussians) else usual if start is None else start
        if count < 1:
            raise ValueError(f"a fit needs at least one Gaussian, got {count}")
        joined = method.fit.joined_pixels or joined_for(
            pixel_grid, geometry.is_cone, max(count, usual), geometry.detector_shape
        )  # fmt: skip
        step_views = join_pixels(replace(measured, geometry=geometry), joined)
        field = Grid.for_fit(step_views.geometry, problem.grid, wider=problem.wide)
        return cls(replace(problem, views=measured), kept_back, joined, step_views, field, count)

    def unseen(self, problem: FitProblem, settings: FitSettings, unit: float) -> FitProblem | None:
        """The held-out projections, prepared as those of the fitting steps."""
        if self.kept_back is None:
            return None
        geometry = self.kept_back.geometry.at_row(0).seen_with(self.step_views.geometry.width)
        views = join_pixels(replace(self.kept_back, geometry=geometry), self.joined)
        return fit.problem_of(views, self.field, unit, settings, problem.backend)


def _of_steps(geometry: Geometry, device: str) -> Geometry:
    """The geometry of the fitting steps: all rows have the angle of the first row. On a GPU, rays have no width.

    With a different angle for each row, slices would turn against each other and twist the model.
    """
    first = geometry.at_row(0)
    return first if device == "cpu" else first.seen_with(NO_WIDTH)


@dataclass(eq=False)
class _Length:
    """Length of a fit, in steps or seconds.

    Attributes:
        steps: number of steps after which the fit ends; None: only `seconds` ends it.
        seconds: time for the steps by the caller's clock; None: only `steps` ends the fit.
        sweeps: iterations of the voxel refinement; None: its default.
        trials: True: the voxel refinement may make test reconstructions to choose its regularisation. planned: True:
            the seconds have been divided between steps and voxel refinement.
    """

    steps: int | None
    seconds: float | None
    sweeps: int | None
    trials: bool
    planned: bool

    def fraction(self, step: int, spent: float) -> float:
        """Share of the fit, 0 to 1, that is done after `step` steps and `spent` s."""
        by_steps = step / self.steps if self.steps else 0.0
        return min(1.0, max(by_steps, spent / self.seconds if self.seconds else 0.0))

    def plan(self, plan: FinishPlan, spent: float) -> None:
        """Reserve time for the voxel refinement."""
        self.sweeps, finishing, self.trials = plan
        self.planned = True
        if self.seconds is not None:
            self.seconds = max(spent, self.seconds - finishing)


@dataclass(eq=False)
class _Run:
    """A running fit: the data that all of its phases use."""

    method: Fit
    problem: ReconProblem
    control: RunControl
    decide: Decisions
    views: _FitViews
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
        """Whether the residual in held-out projections no longer falls."""
        patience = max(6 * _LOOK, _PATIENCE_SHARE * (self.length.steps or 0))
        return self.state.step - self.tracker.best_step > patience

    def model(self) -> tuple[Volume, Gaussians]:
        """The volume of the Gaussians, and the Gaussians, each rotated by the skew at its row."""
        model = turned_by_rows(fit.gaussians_of(self.state, self.fitting.backend), self.problem.geometry, 1)
        filled = voxel_means(
            model, self.problem.grid, self.fitting.geometry, truncation=self.method.fit.truncation
        ).numpy()
        return Volume(filled, self.problem.grid), model

    def report(self, now: float) -> None:
        state = self.state
        self.history.append(
            Progress(
                state.step, self.length.steps or 0, now - self.begin, float(state.loss), float(state.residual), state.n,
                self.views.step_views.geometry.n_views, self.tracker.value,
            )
        )  # fmt: skip
        self.control.tell(self.history[-1])

    def checkpoint(self, state: FitState) -> dict[str, NDArray[Any]]:
        return arrays_of(state, self.fitting.backend) | self.tracker.arrays()


def run_fit(method: Fit, problem: ReconProblem, control: RunControl) -> Reconstruction:
    """Fit the line integrals of a problem; see `R2`.

    Raises:
        ValueError: the method cannot be fitted to this problem.
    """
    begin, decide = control.now(), control.decide or Decisions(problem.seed)
    views = _FitViews.of(method, problem)
    run = _started(method, problem, control, decide, views, begin)
    n_start = run.state.n
    _steps(run)
    last = run.state
    if run.tracker.best_state:
        run.state = state_from(run.tracker.best_state, run.fitting.backend)
    volume, model = run.model()
    volume, sweeps = _finished(run, volume, model)
    settings, state = run.settings, run.state
    record = {
        **asdict(settings), "kernel": state.kernel, "steps": state.step, "seed": problem.seed, "start": method.start,
        "gaussians_at_start": n_start, "gaussians": state.n, "held_out": problem.use.held_out,
        "device": problem.device, "finish": sweeps, "joined_pixels": views.joined,
        "tv_weight": tv_weight(settings, run.fitting, state.limit), "tv_size": tv_size(settings, views.field),
        **(decide.record if sweeps else {}),
    }  # fmt: skip
    return Reconstruction(volume, record, tuple(run.history), model, run.checkpoint(last), started_from=n_start)


def _started(
    method: Fit, problem: ReconProblem, control: RunControl, decide: Decisions, views: _FitViews, begin: float
) -> _Run:
    """A fit before its first step, or in the state of a checkpoint."""
    settings, start, backend = method.fit, method.gaussians, backend_for(problem.device)
    end = math.inf if method.seconds is None else begin + method.seconds
    first = None
    if control.resume is None:
        if not isinstance(start, Gaussians):
            first = first_volume(
                views.step_views.data, views.step_views.geometry, views.field, method.start, problem.device
            )
            start = place(
                first, views.step_views, views.count, np.random.default_rng(problem.seed),
                start=method.start, rays=settings.rays, kernel=settings.kernel,
            )  # fmt: skip
            first = first if method.start == "fbp" else None
        state = fit.init(start, problem.seed, growth(settings), backend)
    else:
        state = _resumed(control.resume, problem.geometry.n_views, backend)
    fitting = fit.problem_of(views.step_views, views.field, state.unit, settings, backend)
    if settings.tv_weight is None:
        change = decide(
            "change",
            lambda: mean_change(views.step_views.data, views.step_views.geometry, views.field, first, problem.device),
        )
        fitting = replace(fitting, change=change)
    unseen = views.unseen(fitting, settings, state.unit)
    tracker = HeldOutTracker.over(unseen, settings, state.step, control.resume or {})
    planned = method.finish_sweeps == 0 or method.seconds is None
    length = _Length(method.planned_steps, method.seconds, method.finish, True, planned)
    if length.steps is not None:
        settings = in_steps(settings, length.steps)
    return _Run(method, problem, control, decide, views, begin, end, state, fitting, tracker, length, settings)


def _steps(run: _Run) -> None:
    """Make the steps of the fit until its end or until it is stopped."""
    now, length, state, method = run.control.now, run.length, run.state, run.method
    if length.seconds is not None:  # reserve time to fill the volume after the steps
        filling = fill_seconds(fit.gaussians_of(state, run.fitting.backend), run.problem.grid, now)
        length.seconds = max(0.0, run.end - filling - now())
    begin = reported = saved = now()
    done = 0
    while length.steps is None or state.step < length.steps:
        spent = now() - begin
        if done and (run.stopped or (length.seconds is not None and spent >= length.seconds)):
            break
        fit.step(state, run.fitting, run.settings, length.fraction(state.step, spent))
        done += 1
        if done >= _TIMED_STEPS and length.seconds is not None:
            _pace(run, length.seconds, now() - begin, done)
        if (
            state.step % _LOOK == _LOOK - 1
        ):  # measured before density control, because its changes need some steps to settle
            run.tracker.measure(state, method.early_stop)
        if now() - reported > 0.1 or done == 1:
            reported = now()
            run.report(reported)
        if run.control.on_checkpoint is not None and now() - saved >= run.control.checkpoint_every:
            run.control.on_checkpoint(run.checkpoint(state))
            saved = now()  # saving checkpoints must take only a small part of the time
        if method.early_stop and run.stopped_falling:
            break
    run.tracker.measure(state, method.early_stop)
    run.report(now())


def _pace(run: _Run, seconds: float, spent: float, done: int) -> None:
    """Plan the voxel refinement and the rates of a fit with a time limit of `seconds` s, from the duration of its first
    `done` steps."""
    length, state = run.length, run.state
    remaining, step = seconds - spent, spent / done
    if not length.planned and done == _TIMED_STEPS:
        length.plan(FinishPlan(*run.decide("finish", partial(_finish_in_time, run, remaining, step))), spent)
        assert length.seconds is not None
        remaining = length.seconds - spent
    if step > 0:  # the first steps are slower than the others, so the estimate is updated
        expected = state.step + max(0.0, remaining) / step
        run.settings = in_steps(run.method.fit, min(expected, length.steps or expected))


def _finished(run: _Run, volume: Volume, model: Gaussians) -> tuple[Volume, int]:
    """The volume of the fit after the voxel refinement (if there is time for it), and the number of iterations."""
    method, length, now, kept_back = run.method, run.length, run.control.now, run.views.kept_back
    if method.finish_sweeps == 0:
        return volume, 0
    if not length.planned:  # the fit ended before the time was planned
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
    if kept_back is not None and _predicts_worse(finished, volume, kept_back):
        return volume, 0
    return finished, sweeps


def _finish_in_time(run: _Run, remaining: float, step: float) -> FinishPlan:
    """The plan of the voxel refinement if `remaining` s are left and the first steps took `step` s each."""
    return planned_finish(run.method, remaining, MOST_STEPS * step, run.views.fitted, run.control.now)


def _predicts_worse(finished: Volume, fitted: Volume, unseen: Views) -> bool:
    """Whether the refinement increased the residual in held-out projections by more than 0.1 dB."""
    square_after, square_before = (np.square(residuals_of(volume, unseen)).mean() for volume in (finished, fitted))
    return bool(square_after > 10 ** (0.1 / 10) * square_before)


def _resumed(checkpoint: Mapping[str, NDArray[Any]], n_views: int, backend: Backend[Any]) -> FitState:
    """The state in a checkpoint."""
    state = state_from(checkpoint, backend)
    if max(state.drawn, default=0) >= n_views:
        raise ValueError(
            f"to resume, use the same data and settings: the checkpoint belongs to a fit of at least "
            f"{max(state.drawn) + 1} projections, but the data have {n_views}"
        )
    return state
