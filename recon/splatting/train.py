"""run_fit: a whole R²-Gaussian fit, by a number of steps or a clock, with views held out and checkpoints."""

from __future__ import annotations

import math
import operator
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.assess.plans import best_steps
from recon.base.arrays import F32
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.method import DataUse, Progress, ReconProblem, Reconstruction, RunControl
from recon.base.ray_width import NO_WIDTH
from recon.base.volume import Grid, Volume
from recon.splatting import optimise as fit
from recon.splatting.backend import Backend, backend_for
from recon.splatting.checkpoint import arrays_of, state_from
from recon.splatting.finish import FinishTrial, finish, try_finish
from recon.splatting.fit_method import FitMethod
from recon.splatting.gaussians import Gaussians, turned_by_rows
from recon.splatting.in_time import (
    FINISH_SHARE,
    FinishPlan,
    fill_seconds,
    finish_within,
    first_draw_seconds,
    first_sweep_seconds,
)
from recon.splatting.initialise import (
    default_count,
    joined_for,
    leaves_the_field,
    mean_change,
    place,
    sweeps_of_start,
)
from recon.splatting.optimise import FitState
from recon.splatting.problem import FitProblem, join_pixels
from recon.splatting.schedule import TRIAL_AT, Schedule
from recon.splatting.settings import FitSettings, growth, tv_size, tv_weight
from recon.splatting.splat import voxelize
from recon.voxels.projector import data_residual

_TIMED = 3  # steps after which a fit's seconds are planned
_LOOK = 50  # steps between two measurements of the views held out
_BEST = "best."  # names of the best model's arrays in a checkpoint begin so
_START_SHARE = 0.5  # share of too few seconds that a start from binned views may take
_PATIENCE = 0.2  # share of the planned steps, and at least six measurements, that may pass without a better model


@dataclass(eq=False)
class _HeldOutTracker:
    """Tracks the residual of views held out, and keeps the model with the lowest one."""

    problem: FitProblem | None
    settings: FitSettings
    value: float = float("nan")
    best: float = float("inf")
    best_step: int = 0
    kept: dict[str, NDArray[Any]] = field(default_factory=dict)

    @classmethod
    def over(
        cls, problem: FitProblem | None, settings: FitSettings, step: int, resume: Mapping[str, NDArray[Any]]
    ) -> _HeldOutTracker:
        """A tracker for a fit at `step`, or the tracker of a checkpoint."""
        if problem is None or "watch" not in resume:
            return cls(problem, settings, best_step=step)
        best, best_step = resume["watch"]
        kept = {name.removeprefix(_BEST): values for name, values in resume.items() if name.startswith(_BEST)}
        return cls(problem, settings, best=float(best), best_step=int(best_step), kept=kept)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Its arrays in a checkpoint."""
        if self.problem is None:
            return {}
        best = {_BEST + name: values for name, values in self.kept.items()}
        return {"watch": np.array([self.best, self.best_step]), **best}

    def look(self, state: FitState, keep: bool) -> None:
        if self.problem is None:
            return
        self.value = fit.misfit_of(state, self.problem, self.settings)
        if self.value < self.best:
            self.best, self.best_step = self.value, state.step
            if keep:
                self.kept = arrays_of(state, self.problem.backend)


def run_fit(method: FitMethod, problem: ReconProblem, control: RunControl) -> Reconstruction:
    """Fit the line integrals of a problem; see `R2`.

    Raises:
        ValueError: for a problem that the method cannot be fitted to.
    """
    # Slices that turn against each other are a twist of the model: the fit sees all rows at the angle of the first.
    now, settings, told, geometry = control.now, method.fit, problem.geometry, problem.geometry.at_row(0)
    if told.skew and isinstance(method.gaussians, Gaussians):
        raise ValueError("Gaussians to start from are not taken where rows see angles of their own: give their number")
    if geometry.width and problem.device != "cpu":
        warnings.warn(
            f"a fit on {problem.device} takes rays without a width: only its finish on voxels knows {geometry.width}",
            stacklevel=2,
        )
        geometry = geometry.seen_with(NO_WIDTH)
    begin, decide = now(), control.decide or Decisions(problem.seed)
    sweeps = method.finish_sweeps
    held_out = tuple(problem.use.held_out)
    backend = backend_for(problem.device)
    used, kept_back = split_views(geometry.n_views, held_out, method.early_stop)
    data, weights = masked(problem.projections, problem.use.weights)
    if weights is not None:  # only ratios of weights mean something: total variation has a weight of its own
        weights = weights / np.float32(_usual(weights, data))
    blank = kept_back[~data[kept_back].any(axis=(1, 2))]
    if blank.size:
        raise ValueError(f"held_out: views {blank.tolist()} are zero everywhere and can judge nothing; name others")
    views = geometry.select(used)
    wider = leaves_the_field(data[used], views)
    start, pixel_grid = method.gaussians, Grid.for_fit(geometry, problem.grid)
    usual = default_count(views, pixel_grid.voxel_size)
    count = start.n if isinstance(start, Gaussians) else usual if start is None else start
    joined = settings.joined_pixels or joined_for(
        pixel_grid, geometry.is_cone, max(count, usual), geometry.detector_shape
    )  # fmt: skip
    measured, trusted = data[used], None if weights is None else weights[used]
    p, known, seen = join_pixels(measured, trusted, views, joined)
    field_grid = Grid.for_fit(seen, problem.grid, wider=wider)
    end = math.inf if method.seconds is None else begin + method.seconds
    if control.resume is None:
        factor = 1 if method.seconds is None else _factor_in_time(method, seen, field_grid, now, end)
        if not isinstance(start, Gaussians):
            start = place(
                p, seen, field_grid, count, np.random.default_rng(problem.seed), start=method.start,
                rays=settings.rays, kernel=settings.kernel, factor=factor,
            )  # fmt: skip
        state = fit.init(start, problem.seed, growth(settings), backend)
    else:
        state = _resumed(control.resume, geometry.n_views, backend)
    n_start, unit = state.n, state.unit
    fitting = fit.problem_of(p, seen, field_grid, unit, settings, backend, known)
    if settings.tv_weight is None:
        fitting = replace(fitting, change=decide("change", lambda: mean_change(p, seen, field_grid)))
    unseen = None
    if kept_back.size:
        others = None if weights is None else weights[kept_back]
        q, others, apart = join_pixels(data[kept_back], others, geometry.select(kept_back), joined)
        unseen = fit.problem_of(q, apart, field_grid, unit, settings, backend, others)
    tracker = _HeldOutTracker.over(unseen, settings, state.step, control.resume or {})

    by_content = method.least_steps != method.planned_steps
    wanted, trials, planned, seconds = method.finish, True, sweeps == 0 or method.seconds is None, method.seconds
    if seconds is not None:
        seconds = max(0.0, end - fill_seconds(fit.gaussians_of(state, backend), problem.grid, now) - now())
    schedule = Schedule(method.planned_steps, seconds, by_content)
    schedule = Schedule.resumed(schedule, control.resume or {})
    # The trial costs more than all steps on joined pixels.
    tries_finish = by_content and method.finish is None and joined == 1
    tries_finish = tries_finish and not (wider or method.early_stop or seen.is_cone)
    fitted = replace(problem, projections=measured, geometry=told.select(used), use=DataUse(trusted))
    history: list[Progress] = []

    def of_model() -> tuple[Volume, Gaussians]:
        model = turned_by_rows(fit.gaussians_of(state, backend), told, 1)
        return Volume(voxelize(model, problem.grid, truncation=settings.truncation).numpy(), problem.grid), model

    def trial() -> list[float] | None:
        found = try_finish(*of_model(), fitted, settings, control)
        return None if found is None else list(found)

    def report(at: float) -> None:
        history.append(
            Progress(
                state.step, schedule.steps or 0, at - begin, float(state.loss), float(state.residual), state.n,
                seen.n_views, tracker.value, least_steps=schedule.least(state.step, tries_finish),
            )
        )  # fmt: skip
        if control.on_progress is not None:
            control.on_progress(history[-1])

    fit_begin = reported = saved = now()
    done = 0
    while schedule.steps is None or state.step < schedule.steps:
        if tries_finish and state.step == TRIAL_AT and schedule.trial is None:
            found = decide("fit", trial)
            schedule.after_trial(None if found is None else FinishTrial.of(found), state.step)
        # Before a further step: a fit that was left during its trial makes it again.
        if (done or state.step == TRIAL_AT) and control.should_stop is not None and control.should_stop():
            break
        spent = now() - fit_begin
        if schedule.seconds is not None and spent >= schedule.seconds and done > 0:
            break
        fraction = schedule.fraction(state.step, spent)
        fit.step(state, fitting, settings, fraction)
        done += 1
        if not planned and done == _TIMED and schedule.seconds is not None:
            spent = now() - fit_begin
            left, step, planned = schedule.seconds - spent, spent / done, True
            finish_in_time = partial(_finish_in_time, method, views, problem.grid, now, left, step)
            wanted, finishing, trials = decide("finish", finish_in_time)
            schedule.seconds = max(spent, schedule.seconds - finishing)
        schedule.look(state, fitting)
        if state.step % _LOOK == _LOOK - 1:  # before density control, whose changes take some steps to settle
            tracker.look(state, method.early_stop)
        if now() - reported > 0.1 or done == 1:
            reported = now()
            report(reported)
        if control.on_checkpoint is not None and now() - saved >= control.checkpoint_every:
            control.on_checkpoint(arrays_of(state, backend) | tracker.arrays() | schedule.arrays())
            saved = now()  # the time that saving takes must not crowd out the fit
        if method.early_stop and state.step - tracker.best_step > max(6 * _LOOK, _PATIENCE * (schedule.steps or 0)):
            break
    tracker.look(state, method.early_stop)
    report(now())
    last = state
    if tracker.kept:
        state = state_from(tracker.kept, backend)
    volume, model = of_model()
    if not planned:  # the fit has ended before
        left = end - now()
        wanted, _, trials = decide("finish", lambda: _finish_in_time(method, views, problem.grid, now, left, 0.0))
    if wanted == 0 or now() >= end or (control.should_stop is not None and control.should_stop()):
        sweeps = 0
    if sweeps:
        if method.seconds is not None:
            control = replace(control, should_stop=_until(control, end))
        control = replace(control, stop_trials=None if trials else lambda: True)
        finished, sweeps = finish(
            volume, model, fitted, wanted, settings, control, not method.allow_negative, schedule.trial
        )
        if kept_back.size and _worse(finished, volume, data[kept_back], told.select(kept_back)):
            sweeps = 0
        else:
            volume = finished
    record = {
        **asdict(settings), "kernel": state.kernel, "steps": state.step, "seed": problem.seed, "start": method.start,
        "gaussians_at_start": n_start, "gaussians": state.n, "held_out": held_out, "device": problem.device,
        "finish": sweeps, "joined_pixels": joined, "tv_weight": tv_weight(settings, fitting, state.limit),
        "tv_size": tv_size(settings, field_grid),
    }  # fmt: skip
    checkpoint = arrays_of(last, backend) | tracker.arrays() | schedule.arrays()
    return Reconstruction(volume, record, tuple(history), model, checkpoint)


def _factor_in_time(method: FitMethod, geometry: Geometry, grid: Grid, now: Callable[[], float], end: float) -> int:
    """The binning of the views for the start of a fit, so that its seconds suffice for the start.

    Warns:
        UserWarning: they do not suffice for a start from all pixels.
    """
    if isinstance(method.gaussians, Gaussians):
        return 1
    count = method.gaussians or default_count(geometry, grid.voxel_size)
    needed = sweeps_of_start(geometry, method.start) * first_sweep_seconds(geometry, grid, now)
    needed += first_draw_seconds(grid, count, now)
    left = max(end - now(), 0.0)
    if needed <= left:
        return 1
    factors = [n for n in (2, 4, 8) if n <= min(geometry.detector_shape) // 4] or [1]
    factor = next((n for n in factors if needed / n**3 <= _START_SHARE * left), factors[-1])
    then = f"it starts from views binned {factor} x {factor}, and ends with what is left of the time"
    warnings.warn(
        f"{method.seconds:.3g} s do not suffice for the start of the fit, which takes about {needed:.3g} s: "
        f"{then if factor > 1 else 'it ends late'}",
        stacklevel=2,
    )
    return factor


def _finish_in_time(
    method: FitMethod, geometry: Geometry, grid: Grid, now: Callable[[], float], left: float, step: float
) -> FinishPlan:
    """The sweeps of the finish and their seconds, if `left` seconds remain after first steps of `step` seconds each.
    `finish_within` gives the sweeps; if the time suffices for two, the method's own number is used."""
    room = FINISH_SHARE * left
    plan = finish_within(room, left - best_steps(method.name) * step, geometry, grid, now)
    return plan if method.finish is None or plan.sweeps == 0 else plan._replace(sweeps=method.finish, seconds=room)


def _until(control: RunControl, end: float) -> Callable[[], bool]:
    """Stops with `control`, or when its clock shows `end`."""
    return lambda: control.now() >= end or (control.should_stop is not None and control.should_stop())


def _worse(finished: Volume, fitted: Volume, unseen: F32, views: Geometry) -> bool:
    """Whether the finished volume explains the views held out worse than the fit's, by more than 0.1 dB."""
    return data_residual(finished, unseen, views) > 10 ** (0.1 / 20) * data_residual(fitted, unseen, views)


def _usual(weights: F32, data: F32) -> float:
    """The weight of a typical ray through matter: the mean over rays with weight, each counted by its line integral.

    Rays past the sample may weigh most, as with photons. A plain mean would then leave the sample to total variation.
    """
    top = max(float(np.percentile(data.reshape(-1)[:: max(1, data.size // 100_003)], 99)), 0.0)
    matter, weighed = 0.0, 0.0
    for view, weight in zip(data, weights, strict=True):
        depth = np.clip(view, 0, top) * (weight > 0)
        matter += float(depth.sum(dtype=np.float64))
        weighed += float((depth * weight).sum(dtype=np.float64))
    return weighed / matter if matter > 0 else float(np.mean(weights[weights > 0], dtype=np.float64))


def split_views(n_views: int, held_out: tuple[int, ...], early_stop: bool) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    if any(isinstance(view, bool | np.bool_) for view in held_out):
        raise ValueError("held_out must be the numbers of views, got a mask of booleans: use numpy.flatnonzero of it")
    kept_back = np.unique(np.array([operator.index(view) for view in held_out], np.intp))
    if kept_back.size and not (kept_back[0] >= 0 and kept_back[-1] < n_views):
        raise ValueError(f"held_out must name views 0 to {n_views - 1}, got {kept_back[[0, -1]].tolist()}")
    if kept_back.size >= n_views:
        raise ValueError(f"all {n_views} views are held out: none is left for the fit")
    if early_stop and not kept_back.size:
        raise ValueError("early_stop looks at views held out, and there are none")
    return np.setdiff1d(np.arange(n_views), kept_back), kept_back


def _resumed(checkpoint: Mapping[str, NDArray[Any]], n_views: int, backend: Backend[Any]) -> FitState:
    """The state that a checkpoint holds."""
    state = state_from(checkpoint, backend)
    if max(state.drawn, default=0) >= n_views:
        raise ValueError(
            f"the checkpoint is of a fit with at least {max(state.drawn) + 1} views, these are {n_views}: "
            "resume takes the same data and settings"
        )
    return state
