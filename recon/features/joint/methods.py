"""TimeSeries: the reconstruction method for several volumes at different times, from all projections together."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Self

import numpy as np

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.method import Progress, ReconProblem, Reconstruction, RunControl
from recon.base.method_kinds import Series
from recon.base.setting import Count, NonNegative, Setting
from recon.base.volume import Grid, Volume, VolumeSeries
from recon.features.joint.series import LEAST_VIEWS, SWEEPS, TimedViews, fit_series

# number of volumes in memory: for each volume of the result; for displacements and displaced volumes
_VOLUMES, _FIELDS = 8, 12
# copies of the line integrals: lines, a held-out part, moments, binned projections, weights, and their copy
_COPIES = 6


@dataclass(frozen=True)
class TimeSeries(Series):
    """Reconstructs volumes at evenly spaced times from one scan of a changing sample, see `fit_series`.

    Attributes:
        volumes: number of volumes, 2 or more, from the time of the first projection to the time of the last, each with
            at least twelve projections.
        moves: True: the sample also moves; False: only densities change; None: held-out projections decide whether the
            sample moves.
        sweeps: number of iterations of the fit.
        weight: weight of total variation, `tv_weight` of `fit_series`; None: held-out projections decide.

    Raises: ValueError: `volumes` is below 2, or `sweeps` or `weight` has a value that is not allowed.
    """

    name: ClassVar[str] = "series"
    label: ClassVar[str] = "Volumes in time"
    least_views: ClassVar[int] = LEAST_VIEWS

    volumes: Annotated[int, Setting(ge=2)] = 2
    moves: bool | None = None
    sweeps: Count = SWEEPS
    weight: NonNegative | None = None

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        if problem.grid != Grid.matching(problem.geometry):
            raise ValueError("do not give a grid: a series is reconstructed on the grid that matches its projections")
        n, times = problem.geometry.n_views, problem.use.times
        times = np.arange(n, dtype=np.float64) if times is None else np.asarray(times, np.float64)
        history = _History(self.sweeps, n, control)
        data, weights = _measured(problem)
        volumes = fit_series(
            TimedViews(data, problem.geometry, times, weights),
            self.volumes,
            motion=self.moves,
            tv_weight=self.weight,
            sweeps=self.sweeps,
            seed=problem.seed,
            go_on=history.heard,
            stop=control.stop,
        )
        series = VolumeSeries(
            volumes.times - times.min(), np.stack([volumes.at(time) for time in volumes.times]), volumes.residual
        )
        settings: dict[str, Any] = {"volumes": self.volumes, "moves": volumes.motion is not None, "sweeps": self.sweeps}
        settings |= {"view_seconds": times - times.min()} | (
            {} if volumes.smooth is None else {"smooth": volumes.smooth}
        )
        if volumes.unseen_residuals is None:
            return history.result(series, volumes.grid, settings, volumes.at)
        because = _because(*volumes.unseen_residuals, moves=volumes.motion is not None)
        settings["chosen_because"] = because
        return replace(history.result(series, volumes.grid, settings, volumes.at), chosen=because)

    def toy(self) -> Self:
        return replace(self, volumes=2, moves=True if self.moves is None else self.moves, sweeps=1)

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        views = 4 * geometry.n_views * math.prod(geometry.detector_shape)
        return (_VOLUMES * self.volumes + _FIELDS) * 4 * math.prod(grid.shape) + _COPIES * views


@dataclass
class _History:
    """Reports and records the progress of a fit. Iterations of tests count down to 0; iterations of the fit are
    recorded in the history."""

    sweeps: int
    n_views: int
    control: RunControl
    of_sweeps: tuple[Progress, ...] = ()
    tried: int = 0

    def __post_init__(self) -> None:
        self.began = self.control.now()

    def heard(self, sweep: int, residual: float) -> bool:
        """The `go_on` of `fit_series`."""
        if sweep > 0:
            self.tell(sweep, residual)
        else:
            self.tried += 1
            self.control.report_progress(self.tried, self.tried - sweep, self.began, self.n_views, "trial sweeps")
            self.tried = 0 if sweep == 0 else self.tried
        return not self.control.stop()

    def tell(self, sweep: int, residual: float) -> None:
        """Record and report an iteration of the fit."""
        seconds = self.control.now() - self.began
        reached = Progress(sweep, self.sweeps, seconds, residual, residual, 0, self.n_views)
        self.of_sweeps = (*self.of_sweeps, reached)
        self.control.tell(reached)

    def result(
        self, series: VolumeSeries, grid: Grid, settings: dict[str, Any], volume_at: Callable[[float], F32]
    ) -> Reconstruction:
        """The reconstruction with this history."""
        if not self.of_sweeps:  # the fit was stopped before its first iteration
            self.tell(0, series.residual)
        return Reconstruction(Volume(series.data[0], grid), settings, self.of_sweeps, series=series, at=volume_at)


def _measured(problem: ReconProblem) -> tuple[F32, F32 | None]:
    """Line integrals [view, row, col] and weights of the same shape; pixels without data have value 0 and weight 0.

    Raises:
        ValueError: no measured line integral is above 0.
    """
    data, weights = problem.views.data, problem.views.weights
    if not (finite := np.isfinite(data)).all():
        weights = finite.astype(np.float32) if weights is None else weights * finite
    if weights is not None:
        data = np.where(weights > 0, data, np.float32(0))
    if not data.max() > 0:
        raise ValueError(
            "these projections show no material: expected a line integral above 0 that is finite and has a weight "
            "above 0"
        )
    return data, weights


def _because(without_motion: float, with_motion: float, moves: bool) -> str:
    """Text on how held-out projections decided whether the sample moves, with advice if the residuals hardly differ."""
    judged = (
        f"the residual in held-out projections is {without_motion:.4g} without motion and {with_motion:.4g} with motion"
    )
    if moves or with_motion >= without_motion:
        return f"{'motion' if moves else 'no motion'}, because {judged}"
    return (
        "if the sample moved, make a second volume with --moves, and compare it with this volume. This volume was made "
        f"without motion: {judged}, but a difference as small as this may be chance"
    )
