"""Run time: predicts how long a reconstruction will take, from a second or two of small runs on this machine."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from recon.base.arrays import F32, F64
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.method import ChoosingMethod, Clock, Method, RunControl, candidates_of
from recon.base.volume import Grid
from recon.fields.train import FieldMethod
from recon.methods import with_settings
from recon.reconstruction import reconstruct
from recon.splatting.fit_method import FitMethod
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import count_for, joined_for
from recon.splatting.r2 import R2
from recon.splatting.settings import growth
from recon.voxels.direct import Fbp
from recon.voxels.fbp import fbp_nanoseconds
from recon.voxels.held_out import CHOICE_SWEEPS, LEAST_VIEWS, TRIAL_ROWS
from recon.voxels.iterative import IterativeMethod, PreparedMethod
from recon.voxels.methods.fista_tv import FistaTv
from recon.voxels.methods.pnp_dct import PnpDct
from recon.voxels.projector import Projector

Decided = Mapping[str, Sequence[Any]]

# Small runs have the scan's own views where these are few enough. Of many views, two numbers tell what a view costs.
_SWEPT_ROWS, _SWEPT_COLS, _VIEWS = 32, 256, (108, 216)
_SWEEPS = 4  # iterations that are timed
_TRIED = 72, 192, 16  # views, columns and rows of trials of a weight
_COMPILED = 24, 64, 16  # the same for a run that compiles
_FEW_ROWS = 16  # of FBP and fits
_FIT_COLS, _FIT_VIEWS = 128, 108  # of a neural field
_FITS, _FITTED_VIEWS = ((96, 16), (160, 48)), 24  # columns and rows of small fits
_FBP_COLS, _FBP_VIEWS = 512, 180
_STEPS = 12, 32  # of small fits, whose views have all been seen after the first number
_FIELD_STEPS = 3  # of a small fit of a neural field

Size = tuple[int, int, int]  # views, columns, rows


@dataclass(frozen=True)
class Extent:
    """Views and slices that a reconstruction takes.

    Attributes:
        geometry: of the views; small runs are made of the same beam.
        heights: slices of each slab, with its halo.
        decided: another slab has already made the decisions that follow from the data.
    """

    geometry: Geometry
    heights: Sequence[int]
    decided: bool = False

    @property
    def views(self) -> int:
        return self.geometry.n_views

    @property
    def cols(self) -> int:
        """Columns of a slice, which are more than those of the detector where the axis stands off its middle."""
        return Grid.matching(self.geometry).shape[2]

    @property
    def slices(self) -> int:
        return sum(self.heights)


class RunTime(NamedTuple):
    """Seconds that a run takes.

    Attributes:
        most: where a fit makes all of its steps.
        least: where the data end it as early as they may; of other methods, `most`.
    """

    most: float
    least: float


def run_seconds(method: Method, extent: Extent, now: Clock) -> RunTime:
    """Seconds that the method takes, without reading and correction; `auto` is taken to choose its last candidate.

    Small runs are made of the scan's own beam, with its lean, its exposures and as many rows, if they are few.
    Iterations cost views times voxels, plus voxels for their work on the volume alone. A weight of total variation is
    chosen once, on sixteen rows. A step of a fit costs voxels^(2/3) Gaussians^(1/3), as many pixels as they cover; of
    joined pixels there are fewer voxels.
    """
    if isinstance(method, FitMethod):
        return _of_fit(method, extent, now)
    candidates = candidates_of(method)
    if candidates[0] is method:
        if isinstance(method, IterativeMethod):
            trials = method.trial_sweeps if isinstance(method, PreparedMethod) else CHOICE_SWEEPS
            seconds = _of_iterations(method, extent, now, method.iterations, trials)
        elif isinstance(method, FieldMethod):
            seconds = _of_field(method, extent, now)
        else:
            seconds = _of_direct(method, extent, now)
        return RunTime(seconds, seconds)
    first = [min(32, max(extent.heights))]
    parts = [  # the prior of all trials is sought once
        run_seconds(
            _candidate(candidate), Extent(extent.geometry, first, not isinstance(candidate, PreparedMethod)), now
        )
        for candidate in candidates
    ]
    parts.append(run_seconds(_candidate(candidates[-1]), extent, now))
    return RunTime(*(sum(seconds) for seconds in zip(*parts, strict=True)))


def _candidate(method: Method) -> Method:
    return method.as_candidate() if isinstance(method, ChoosingMethod) else method


def _of_iterations(method: Method, extent: Extent, now: Clock, sweeps: int, trials: int = CHOICE_SWEEPS) -> float:
    """Seconds of so many iterations, and of so many sweeps of trials, where the method makes any."""
    took = partial(_took, method, extent, now)
    took(_COMPILED, 1, Decisions())
    tried = min(_TRIED[0], extent.views), *_within(extent, *_TRIED[1:])
    deciding, decided, asked = took(tried, 1 + _SWEEPS, Decisions())
    following, *_ = took(tried, 1 + _SWEEPS, Decisions(0, decided))
    cols, height = _within(extent, _SWEPT_COLS, _SWEPT_ROWS)

    def of_sweeps(views: int) -> tuple[float, float]:
        """Seconds of an iteration, and seconds before the first one."""
        one, last = (took((views, cols, height), n, Decisions(0, decided))[0] for n in (1, 1 + _SWEEPS))
        sweep = (last - one) / _SWEEPS
        return sweep, one - sweep

    few, many = _VIEWS
    found = [of_sweeps(extent.views)] if extent.views <= many else [of_sweeps(views) for views in _VIEWS]
    at = (extent.views - few) / (many - few)
    sweep, start = (max(a + at * (b - a), 0.0) for a, b in zip(found[0], found[-1], strict=True))
    # Trials see sixteen rows; how many there are depends on the data. A weight without trials is of all rows.
    rays = extent.views * extent.cols**2 / (tried[0] * tried[1] ** 2)
    once = rays * max(deciding - following, 0.0) * (trials / asked if asked else extent.slices / tried[2])
    whole = (extent.cols / cols) ** 2 * extent.slices / height
    return whole * (start + sweeps * sweep) + (0.0 if extent.decided else once)


def _took(
    method: Method, extent: Extent, now: Clock, size: Size, iterations: int, decide: Decisions
) -> tuple[float, Decided, int]:
    """Seconds of so many iterations, their decisions, and the sweeps of trials among them."""
    geometry, data = sample(extent, *size)
    one, asked = with_settings(method, {"iterations": iterations}), 0

    def count() -> bool:
        nonlocal asked
        asked += 1
        return False

    begin = now()
    reconstruct(data, geometry, one, control=RunControl(decide=decide, stop_trials=count))
    return now() - begin, decide.made, asked


def _of_direct(method: Method, extent: Extent, now: Clock) -> float:
    views, (cols, rows) = min(extent.views, _FBP_VIEWS), _within(extent, _FBP_COLS, _FEW_ROWS)
    geometry, data = sample(extent, views, cols, rows)
    times = []
    for _ in range(3):
        begin = now()
        reconstruct(data, geometry, method)
        times.append(now() - begin)
    cost = _cone_nanoseconds if extent.geometry.is_cone or not extent.geometry.is_straight else fbp_nanoseconds
    share = min(times) / cost(views, cols, rows)
    return share * sum(cost(extent.views, extent.cols, height) for height in extent.heights)


def _cone_nanoseconds(views: int, cols: int, slices: int) -> float:
    """In units of a voxel and view: each is taken from where its ray meets the detector."""
    return float(views * cols**2 * slices)


def _of_field(method: FieldMethod, extent: Extent, now: Clock) -> float:
    """A step costs as many samples as its rays have, and slices of the volume two fifths of that a voxel."""
    cols, rows = _within(extent, _FIT_COLS, _FEW_ROWS)
    geometry, data = sample(extent, _FIT_VIEWS, cols, rows)
    tried = with_settings(method, {"seconds": None, "early_stop": False})

    def took(steps: int) -> float:
        begin = now()
        reconstruct(data, geometry, with_settings(tried, {"steps": steps}))
        return now() - begin

    took(1)
    short, long = took(2), took(2 + _FIELD_STEPS)
    step = max(long - short, long / 4) / _FIELD_STEPS * method.samples_of(extent.cols) / method.samples_of(cols)
    steps, beside = method.steps * step * len(extent.heights), extent.slices * extent.cols**2
    steps = steps if method.seconds is None else min(steps, method.seconds)
    return steps + short * beside / (rows * cols**2)


def _of_fit(method: FitMethod, extent: Extent, now: Clock) -> RunTime:
    """Steps cost a fixed time and one by their work, which small fits of two sizes tell apart."""
    tried = [_step_of_fit(extent, now, *size) for size in _FITS]
    (few, less), (many, more) = tried[0], tried[-1]
    slope = max(more - less, 0.0) / (many - few) if many > few else less / few
    given = method.gaussians.n if isinstance(method.gaussians, Gaussians) else method.gaussians
    cone = extent.geometry.is_cone
    seconds, may_end_early = 0.0, extent.views >= LEAST_VIEWS
    for height in extent.heights:
        field = Grid((height, extent.cols, extent.cols))
        first = count_for(field, cone)
        count = first if given is None else given * height / extent.slices
        joined = method.fit.joined_pixels or joined_for(field, cone, max(count, first), (height, extent.cols))
        seconds += max(less + slope * (_work(math.prod(field.shape) / joined**3, count) - few), 0.0)
    grown = (1 + growth(method.fit)) / 2  # small fits end before the first Gaussians are added
    planned, fewest = method.planned_steps or 0, method.least_steps or 0
    if not may_end_early:  # no view can be held out
        fewest = planned
    most = method.seconds if method.seconds is not None else planned * seconds * grown
    least = min(most, fewest * seconds * (grown if fewest == planned else 1))  # it ends before Gaussians are added
    if fewest < planned:  # the fit of the trial
        trial = planned * seconds * min(1.0, TRIAL_ROWS / extent.slices)
        most, least = most + trial, least + trial
    beside = _of_direct(Fbp(), extent, now)
    if method.finish != 0:
        patches = PnpDct()
        by_default = patches.first_sweeps + patches.iterations, patches.trial_sweeps
        sweeps, trials = by_default if method.finish is None else (method.finish, CHOICE_SWEEPS)
        beside += _of_iterations(FistaTv(), extent, now, sweeps, trials)
    return RunTime(most + beside, least + beside)


def _step_of_fit(extent: Extent, now: Clock, cols: int, rows: int) -> tuple[float, float]:
    """The work of a step of a small fit, and its seconds."""
    cols, rows = _within(extent, cols, rows)
    geometry, data = sample(extent, min(extent.views, _FITTED_VIEWS), cols, rows)
    count = count_for(Grid((rows, cols, cols)), geometry.is_cone)

    def took(steps: int) -> float:
        begin = now()
        reconstruct(data, geometry, R2(steps=steps, finish=0, gaussians=count))
        return now() - begin

    took(2)
    short, long = (min(took(steps) for _ in range(2)) for steps in _STEPS)
    step, mean = (long - short) / (_STEPS[1] - _STEPS[0]), long / _STEPS[1]
    step = min(max(step, mean / 3), mean)  # on a busy machine the longer run may take less
    return _work(rows * cols**2, count), step


def _work(voxels: float, gaussians: float) -> float:
    """In proportion to the pixels that Gaussians cover, whose widths are their distances."""
    return float(voxels ** (2 / 3) * gaussians ** (1 / 3))


def _within(extent: Extent, cols: int, rows: int) -> tuple[int, int]:
    """Columns and rows of a small run, of as many voxels as given, and no more of either than the scan has.

    Of few rows, as of a fan, it has more columns: a single slice has kernels and threads of its own.
    """
    height = min(extent.geometry.detector_shape[0], rows)
    return min(extent.cols, round(cols * math.sqrt(rows / height))), height


def sample(extent: Extent, views: int, cols: int, rows: int) -> tuple[Geometry, F32]:
    """Views of a disc with a hole, with some noise, through the beam of the scan."""
    geometry = _fewer(extent.geometry, views, cols, rows)
    grid = Grid.matching(geometry)
    width = cols * grid.voxel_size
    _, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    disc = (np.hypot(x, y) < 0.4 * width) & ~(np.hypot(x - 0.1 * width, y) < 0.1 * width)
    data = Projector(geometry, grid).forward((disc / width).astype(np.float32))
    return geometry, data + np.random.default_rng(0).normal(0, 0.02, data.shape).astype(np.float32)


def _fewer(geometry: Geometry, views: int, cols: int, rows: int) -> Geometry:
    """The same beam with so many views, columns and rows: as wide a fan, and as many pixels of motion in an exposure.

    Displacements along the rotation axis are left out: slices are counted instead.
    """
    n, (all_rows, all_cols) = geometry.n_views, geometry.detector_shape
    factor, at, order = all_cols / cols, np.linspace(0, n - 1, views), np.argsort(geometry.angles)

    def some(values: F64) -> F64:
        return np.interp(at, np.arange(n), values[order])

    return replace(
        geometry,
        angles=some(geometry.angles),
        detector_shape=(rows, cols),
        pixel_pitch=geometry.pixel_pitch * factor,
        axis_col=(geometry.axis_col + 0.5) / factor - 0.5,
        axis_row=(rows - 1) / 2 + (geometry.axis_row - (all_rows - 1) / 2) / factor,
        shifts=np.column_stack((some(geometry.shifts[:, 0]) / factor, np.zeros(views))),
        roll=some(geometry.roll),
        tilt=some(geometry.tilt),
        width=replace(geometry.width, arc=geometry.width.arc * factor),
        skew=geometry.skew * factor,
    )
