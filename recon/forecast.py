"""forecast: predicts the duration of a reconstruction from a few timed iterations on a part of the scan."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.method import Clock, Method, Progress, ReconProblem, RunControl
from recon.base.method_kinds import Direct, Series
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.splatting.finish import FINISH_SWEEPS
from recon.splatting.fit_method import Fit
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import count_for, joined_for
from recon.splatting.settings import growth
from recon.splatting.trial_fit import FIRST_SHARE
from recon.voxels.choice import TRIALS
from recon.voxels.held_out import CHOICE_SWEEPS, TRIAL_ROWS, TRIAL_SWEEPS, choice_sweeps
from recon.voxels.iterative import VoxelMethod
from recon.voxels.methods import FistaTv, PnpDct
from recon.voxels.ordered_fista import pull_methods
from recon.voxels.priors import STEPS

VOXELS = 2**20
"""Number of voxels in the timed part. It is so large that the part does not fit into the caches of a processor."""

_ROWS, _VIEWS = 48, 128  # largest numbers of rows and projections in the timed part
# number of timed iterations; only the end of the first one is known
_ITERATIONS, _PATCH_STEPS, _FIT_STEPS = 4, 2 * STEPS, 12
_LEAST_COLS = 32
_NOISE = np.float32(0.01)  # noise of the simulated projections; without noise the weight of total variation would be 0
_RENDER = 1 / 3  # time to render a projection, as a share of the time of a fit step (which also computes the gradient)


class Forecast(NamedTuple):
    """Expected duration of a reconstruction in seconds.

    Attributes:
        choice_seconds: duration of the test reconstructions that choose a method or the weight of a prior.
        volumes: duration of the volume itself, by the name of each method that may be chosen.
    """

    choice_seconds: float
    volumes: Mapping[str, float]

    @property
    def least(self) -> float:
        return self.choice_seconds + min(self.volumes.values())

    @property
    def most(self) -> float:
        return self.choice_seconds + max(self.volumes.values())


class RunTiming(NamedTuple):
    """Timing of a run: seconds outside its iterations, seconds of one iteration, and the planned number of
    iterations."""

    fixed: float
    each: float
    planned: int

    @property
    def total(self) -> float:
        return self.fixed + self.planned * self.each

    def scaled(self, fixed: float, each: float) -> RunTiming:
        return RunTiming(fixed * self.fixed, each * self.each, self.planned)


def forecast(method: Method, geometry: Geometry, grid: Grid, now: Clock) -> Forecast | None:
    """Expected duration of a method for these projections and voxels. None: the duration is unknown, because the method
    makes several volumes.

    Call `recon.warm_up` first, so that the kernels are compiled before they are timed.

    Args:
        now: the clock in s. With a clock of processor time, the result is that of a machine on which nothing else runs.

    Raises:
        ValueError: the method cannot use the projections.
    """
    return None if isinstance(method, Series) else Timing(geometry, grid, now).of(method)


class Timing:
    """Durations of methods for given projections and voxels. At the first request, a method is timed on a part of
    them."""

    def __init__(self, geometry: Geometry, grid: Grid, now: Clock, voxels: int = VOXELS) -> None:
        self._geometry, self._grid, self._now, self._voxels = geometry, grid, now, voxels
        self._part = part_of(geometry, grid, voxels)
        self._scale = _work(geometry, grid) / _work(self._part.geometry, self._part.grid)
        self._trial_share = choice_sweeps(geometry) / CHOICE_SWEEPS
        self._trial = part_of(geometry, grid, voxels, TRIAL_ROWS)
        self._paces, self._known = dict[str, RunTiming](), dict[str, Forecast]()

    def of(self, method: Method) -> Forecast:
        """The expected duration of a method, see `forecast`."""
        if (key := repr(method)) not in self._known:
            self._known[key] = self._of(method)
        return self._known[key]

    def _of(self, method: Method) -> Forecast:
        if len(method.alternatives) > 1:
            return self._of_choice(method.alternatives)
        if (limit := method.time_limit) is not None:
            return Forecast(0.0, {method.name: limit})
        if isinstance(method, Direct):
            return Forecast(0.0, {method.name: self.direct_seconds(method)})
        if isinstance(method, Fit):
            return self._of_fit(method)
        return Forecast(self.trial_seconds(method), {method.name: self.pace(method).total})

    def direct_seconds(self, method: Method) -> float:
        """Expected seconds of a direct method, timed with all columns, because its kernels depend on their number."""
        straight = self._geometry.is_straight and not self._geometry.is_cone
        part = part_of(self._geometry, self._grid, None) if straight else self._part
        begin = self._now()
        method.run(part, RunControl(now=self._now))
        return (self._now() - begin) * _work(self._geometry, self._grid) / _work(part.geometry, part.grid)

    def pace(self, method: Method, of_trial: bool = False) -> RunTiming:
        """Expected timing of an iterative method in all voxels, computed from a timed part of the voxels, or from the
        rows of a test reconstruction."""
        key = f"{of_trial} {method!r}"
        if key not in self._paces:
            part, on_voxels = self._trial if of_trial else self._part, isinstance(method, VoxelMethod)
            first = method.first_sweeps if isinstance(method, VoxelMethod) else 0
            timing = _timed(method, part, self._now, first + _PATCH_STEPS if first else _ITERATIONS, first)
            if isinstance(method, VoxelMethod):
                further = method.further_sweeps(self._geometry, self._grid)
                timing = timing._replace(planned=min(timing.planned, method.usual_sweeps) + further)
            scale = _work(self._geometry, self._grid) / _work(part.geometry, part.grid)
            # A step that uses only some projections takes the same time, however many projections there are. Its time
            # grows with the number of samples along a ray.
            size_ratio = max(self._grid.shape) / max(part.grid.shape)
            self._paces[key] = timing.scaled(scale, scale if on_voxels else size_ratio)
        return self._paces[key]

    @property
    def _smooth(self) -> RunTiming:
        return self.pace(FistaTv())

    def trial_seconds(self, method: Method) -> float:
        """Expected seconds of the test reconstructions that choose its prior."""
        sweeps = method.trial_sweeps
        if not (self._trial_share and sweeps):
            return 0.0
        smooth = self.pace(FistaTv(), of_trial=True).each
        if isinstance(method, PnpDct):
            patches = TRIALS * method.trial_steps * self.pace(PnpDct(), of_trial=True).each
            return self._trial_share * ((CHOICE_SWEEPS + TRIAL_SWEEPS) * smooth + patches)
        return self._trial_share * sweeps * smooth

    def fit_pace(self, method: Fit) -> RunTiming:
        """Expected timing of a fit without its voxel refinement."""
        field = Grid.for_fit(self._geometry, self._grid)
        n_stated = method.gaussians.n if isinstance(method.gaussians, Gaussians) else method.gaussians
        usual = count_for(field, self._geometry.is_cone)
        count, part = n_stated or usual, self._part
        joined = method.fit.joined_pixels or joined_for(
            field, self._geometry.is_cone, max(count, usual), self._geometry.detector_shape
        )
        n_of_part = count_for(Grid.for_fit(part.geometry, part.grid), part.geometry.is_cone)
        n_trial, short = max(1, round(n_of_part * count / usual)), cast(Any, method)
        short = replace(short, gaussians=n_trial, finish=0, fit=replace(method.fit, joined_pixels=joined))
        grown = ((1 + growth(method.fit)) / 2) ** (1 / 3)  # Gaussians are added during the fit
        covers = _covered(math.prod(self._grid.shape), count) / _covered(math.prod(part.grid.shape), n_trial)
        return _timed(short, part, self._now, _FIT_STEPS).scaled(self._scale, grown * covers)

    def _of_fit(self, method: Fit) -> Forecast:
        timing = self.fit_pace(method)
        if method.finish_sweeps == 0:
            return Forecast(0.0, {method.name: timing.total})
        finish = self._rendered(method) + self._smooth.fixed + method.finish_sweeps * self._smooth.each
        choice = self.trial_seconds(FistaTv() if method.finish is not None else PnpDct())
        if method.finish is None:
            choice += (
                sum(each.refused_sweeps for each in pull_methods()) / CHOICE_SWEEPS * self.trial_seconds(FistaTv())
            )
            finish += PnpDct.iterations * self.pace(PnpDct()).each
        return Forecast(choice, {method.name: timing.total + finish})

    def _rendered(self, method: Fit) -> float:
        """Expected seconds to render all projections of a fit, for its voxel refinement."""
        return 2 * _RENDER * self._geometry.n_views * self.fit_pace(method).each / method.fit.views_per_step

    def _of_choice(self, candidates: tuple[Method, ...]) -> Forecast:
        """Expected duration of a method that tries other methods. The search for a prior is made once for all of
        them."""
        each = [self.of(candidate) for candidate in candidates]
        if not self._trial_share:
            return each[-1]
        volumes = {name: seconds for one in reversed(each) for name, seconds in one.volumes.items()}
        choice = max(one.choice_seconds for one in each) + self._trial_share * sum(map(self._tried, candidates))
        return Forecast(choice, volumes)

    def _tried(self, method: Method) -> float:
        """Expected seconds of a method's volume in a test with all rows, without the search for priors."""
        if isinstance(method, Fit) and method.finish is None:
            timing = self.fit_pace(method)
            first = timing._replace(planned=round(FIRST_SHARE * timing.planned)).total
            return first + self._rendered(method) + FINISH_SWEEPS * self.pace(FistaTv(), of_trial=True).each
        return 0.0 if method.trial_sweeps else self.of(method).most


def part_of(geometry: Geometry, grid: Grid, voxels: int | None, most_rows: int = _ROWS) -> ReconProblem:
    """Noisy projections of a cylinder with some of the rows and columns, and the grid that matches these projections.

    Args:
        voxels: approximate number of voxels; None: all columns of all projections, which direct methods need.
    """
    rows, cols = geometry.detector_shape
    height = min(rows, most_rows)
    width = cols if voxels is None else min(cols, max(_LEAST_COLS, math.isqrt(voxels // height)))
    each = 1 if voxels is None else -(-geometry.n_views // _VIEWS)
    first = (rows - height) // 2
    views = geometry.select(slice(None, None, each)).rows(first, first + height)
    views = replace(views, detector_shape=(height, width), axis_col=(width - 1) / 2)
    box = Grid.matching(views)
    wider = grid.shape[1] / Grid.matching(geometry).shape[1]  # a sample that continues outside the field of view
    nz, ny, nx = box.shape
    box = replace(box, shape=(nz, round(wider * ny), round(wider * nx)))
    columns_from_middle = np.arange(width) - (width - 1) / 2
    lines = np.sqrt(np.maximum((0.35 * width) ** 2 - columns_from_middle**2, 0)) / width
    noise = np.random.default_rng(0).standard_normal((views.n_views, height, width), np.float32)
    data: F32 = lines.astype(np.float32) + _NOISE * noise
    return ReconProblem(Views(data, views), box)


def _work(geometry: Geometry, grid: Grid) -> float:
    """A number proportional to the work of projecting the volume once."""
    return float(geometry.n_views * math.prod(grid.shape))


def _covered(voxels: float, gaussians: float) -> float:
    """A number proportional to the number of pixels that the Gaussians cover in a projection, if each is as wide as the
    distance to its neighbours."""
    return float(voxels ** (2 / 3) * gaussians ** (1 / 3))


def _timed(method: Method, part: ReconProblem, now: Clock, last: int, untimed_steps: int = 0) -> RunTiming:
    """The timing of the iterations from `untimed_steps` to `last`, without test reconstructions."""
    reached: list[tuple[int, float]] = []
    planned = last

    def heard(progress: Progress) -> None:
        nonlocal planned
        if not progress.unit:
            planned = progress.steps or last
            reached.append((progress.step, now()))

    control = RunControl(lambda: bool(reached) and reached[-1][0] >= last, heard, now=now, stop_trials=lambda: True)
    begin = now()
    method.run(part, control)
    seconds = now() - begin
    timed_marks = [mark for mark in reached if mark[0] >= (untimed_steps + STEPS if untimed_steps else 1)]
    if len(timed_marks) < 2:
        return RunTiming(0.0, seconds / planned, planned) if planned else RunTiming(seconds, 0.0, 0)
    (step, start_seconds), (end, until) = timed_marks[0], timed_marks[-1]
    each = (until - start_seconds) / (end - step)
    return RunTiming(seconds - (end - untimed_steps) * each, each, planned - untimed_steps)
