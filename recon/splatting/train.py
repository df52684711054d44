"""A whole R²-Gaussian fit: placing, steps against a count or a clock, held-out views, and what it leaves."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.volume import Grid, Volume
from recon.kernels.cpu.activation import F32
from recon.splatting import optimise as fit
from recon.splatting.backend import Backend, backend_for
from recon.splatting.checkpoint import arrays_of, state_from
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import Start, place
from recon.splatting.optimise import FitState, Progress
from recon.splatting.polish import polish
from recon.splatting.problem import Problem, coarser, joined
from recon.splatting.settings import FitSettings, growth, tv_size, tv_weight

_LOOK = 50  # steps between two looks at the views held out
_BEST = "best."  # names of the best model's arrays in a checkpoint begin so
_PATIENCE = 0.2  # of the steps planned, and at least six looks, may pass without a better one


@dataclass(frozen=True)
class FitRequest:
    """What is asked of a fit; the words are those of `reconstruct`."""

    settings: FitSettings
    steps: int | None
    seconds: float | None
    gaussians: int | Gaussians | None
    seed: int
    start: Start
    held_out: tuple[int, ...]
    early_stop: bool
    resume: Mapping[str, NDArray[Any]] | None
    device: str
    polish: int = 0


@dataclass(frozen=True, eq=False)
class Fitted:
    """What a fit leaves; the words are those of `Reconstruction`."""

    volume: Volume
    history: tuple[Progress, ...]
    gaussians: Gaussians
    settings: dict[str, Any]
    checkpoint: Mapping[str, NDArray[Any]]


@dataclass(eq=False)
class _Watch:
    """The residual of views held out, and the model that had it lowest."""

    problem: Problem | None
    settings: FitSettings
    value: float = float("nan")
    best: float = float("inf")
    best_step: int = 0
    kept: dict[str, NDArray[Any]] = field(default_factory=dict)

    @classmethod
    def over(
        cls, problem: Problem | None, settings: FitSettings, step: int, resume: Mapping[str, NDArray[Any]]
    ) -> _Watch:
        """At `step`, or as a checkpoint has left it."""
        if problem is None or "watch" not in resume:
            return cls(problem, settings, best_step=step)
        best, best_step = resume["watch"]
        kept = {name.removeprefix(_BEST): values for name, values in resume.items() if name.startswith(_BEST)}
        return cls(problem, settings, best=float(best), best_step=int(best_step), kept=kept)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What a checkpoint holds of it."""
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


def run_fit(
    data: F32,
    weights: F32 | None,
    geometry: Geometry,
    grid: Grid,
    request: FitRequest,
    on_progress: Callable[[Progress], None] | None,
    should_stop: Callable[[], bool] | None,
    now: Callable[[], float],
    on_checkpoint: Callable[[Mapping[str, NDArray[Any]]], None] | None = None,
    checkpoint_every: float = 60.0,
) -> Fitted:
    """Fit line integrals [view, row, col]; see `reconstruct`.

    Raises:
        ValueError: as `reconstruct`.
    """
    begin, settings = now(), request.settings
    backend = backend_for(request.device)
    used, kept_back = _split(geometry.n_views, request.held_out, request.early_stop)
    data, weights = masked(data, weights)
    if weights is not None:  # only ratios of weights mean something: total variation has a weight of its own
        weights = weights / np.float32(np.mean(weights[weights > 0], dtype=np.float64))
    blank = kept_back[~data[kept_back].any(axis=(1, 2))]
    if blank.size:
        raise ValueError(f"held_out: views {blank.tolist()} are zero everywhere and can judge nothing; name others")
    seen, known = geometry.select(used), None if weights is None else weights[used]
    field_grid = Grid.for_fit(geometry, grid)
    joined(seen, settings.coarse)  # what cannot be joined is told before anything is computed
    state, n_start, unit = _first_state(data[used], seen, field_grid, request, backend)
    problem = fit.problem_of(data[used], seen, field_grid, unit, settings, backend, known)
    rough = problem
    if settings.coarse > 1:
        rough = coarser(problem, settings.coarse, settings.loss, settings.ssim_weight)
    unseen = None
    if kept_back.size:
        others = None if weights is None else weights[kept_back]
        unseen = fit.problem_of(
            data[kept_back], geometry.select(kept_back), field_grid, unit, settings, backend, others
        )  # fmt: skip
    watch = _Watch.over(unseen, settings, state.step, request.resume or {})

    planned, history = request.steps or 0, []  # 0 in a history: no number of steps was planned
    steps, seconds = request.steps, request.seconds

    def tell(at: float) -> None:
        history.append(
            Progress(
                state.step, planned, at - begin, float(state.loss), float(state.residual), state.n, seen.n_views,
                watch.value,
            )
        )  # fmt: skip
        if on_progress is not None:
            on_progress(history[-1])

    fit_begin = said = handed = now()
    done = 0
    while steps is None or state.step < steps:
        spent = now() - fit_begin
        if seconds is not None and spent >= seconds and done > 0:
            break
        fraction = min(1.0, max(state.step / planned if planned else 0.0, spent / seconds if seconds else 0.0))
        fit.step(state, rough if fraction < settings.coarse_until else problem, settings, fraction)
        done += 1
        if state.step % _LOOK == _LOOK - 1:  # before density control, whose changes take some steps to settle
            watch.look(state, request.early_stop)
        if now() - said > 0.1 or done == 1:
            said = now()
            tell(said)
        if on_checkpoint is not None and now() - handed >= checkpoint_every:
            on_checkpoint(arrays_of(state, backend) | watch.arrays())
            handed = now()  # what keeping it takes must not crowd out the fit
        if should_stop is not None and should_stop():
            break
        if request.early_stop and state.step - watch.best_step > max(6 * _LOOK, _PATIENCE * planned):
            break
    watch.look(state, request.early_stop)
    tell(now())
    last = state
    if watch.kept:
        state = state_from(watch.kept, backend)
    volume, model = fit.volume_of(state, grid, settings, backend), fit.gaussians_of(state, backend)
    if request.polish:
        volume = polish(
            volume, model, data[used], seen, request.polish,
            weights=known, rays=settings.rays, truncation=settings.truncation, should_stop=should_stop,
            seed=request.seed,
        )  # fmt: skip
    record = {
        **asdict(settings), "steps": state.step, "seed": request.seed, "start": request.start,
        "gaussians_at_start": n_start, "gaussians": state.n, "held_out": request.held_out, "device": request.device,
        "polish": request.polish, "tv_weight": tv_weight(settings, problem, state.limit),
        "tv_size": tv_size(settings, field_grid),
    }  # fmt: skip
    return Fitted(volume, tuple(history), model, record, arrays_of(last, backend) | watch.arrays())


def _split(n_views: int, held_out: tuple[int, ...], early_stop: bool) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
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


def _first_state(
    data: F32, geometry: Geometry, field_grid: Grid, request: FitRequest, backend: Backend[Any]
) -> tuple[FitState, int, float]:
    """The state to go on from, how many Gaussians it began with, and their density unit."""
    if request.resume is not None:
        state = state_from(request.resume, backend)
        if max(state.drawn, default=0) >= geometry.n_views:
            raise ValueError(
                f"the checkpoint is of a fit with at least {max(state.drawn) + 1} views, these are {geometry.n_views}: "
                "resume takes the same data and settings"
            )
        return state, state.n, state.unit
    start = request.gaussians
    if not isinstance(start, Gaussians):
        rng = np.random.default_rng(request.seed)
        start = place(data, geometry, field_grid, start, rng, start=request.start, rays=request.settings.rays)
    return fit.init(start, request.seed, growth(request.settings), backend), start.n, start.density_unit
