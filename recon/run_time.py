"""Run time: predicts how long a reconstruction will take, from a second or two of small runs on this machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from recon.base.arrays import F32
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.method import Clock, Method, RunControl, candidates_of
from recon.base.volume import Grid
from recon.fields.train import FieldMethod
from recon.methods import with_settings
from recon.reconstruction import reconstruct
from recon.splatting.fit_method import FitMethod
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import default_count
from recon.splatting.r2 import R2
from recon.voxels.direct import Fbp
from recon.voxels.fbp import fbp_nanoseconds
from recon.voxels.iterative import IterativeMethod
from recon.voxels.methods.fista_tv import FistaTv
from recon.voxels.projector import Projector

Decided = Mapping[str, Sequence[Any]]

# Of small runs, at most: with fewer columns the time is not that of voxels and views. Two numbers of views tell what a
# view costs.
_SWEPT_ROWS, _SWEPT_COLS, _VIEWS = 32, 256, (72, 216)
_SWEEPS = 4  # iterations that are timed
_TRIED = 72, 192, 16  # views, columns and rows of trials of a weight
_COMPILED = 24, 64, 16  # the same for a run that compiles
_FEW_ROWS = 16  # of FBP and fits
_FIT_COLS, _FIT_VIEWS = 128, 108
_FBP_COLS, _FBP_VIEWS = 512, 180
_STEPS = 12  # of a small fit
_FIELD_STEPS = 3  # of a small fit of a neural field


@dataclass(frozen=True)
class Extent:
    """The size of a reconstruction.

    Attributes:
        heights: slices of each slab, with its halo.
        decided: another slab has already made the decisions that follow from the data.
    """

    views: int
    cols: int
    heights: Sequence[int]
    decided: bool = False

    @property
    def rows(self) -> int:
        return sum(self.heights)


def run_seconds(method: Method, extent: Extent, now: Clock) -> float:
    """Seconds that the method takes, without reading and correction; `auto` is taken to choose its first candidate.

    Iterations cost views times voxels, plus voxels for their work on the volume alone. A weight of total variation is
    chosen once, on sixteen rows. A step of a fit costs voxels^(2/3) Gaussians^(1/3), as many pixels as they cover.
    """
    if isinstance(method, IterativeMethod):
        return _of_iterations(method, method.iterations, extent, now)
    if isinstance(method, FitMethod):
        return _of_fit(method, extent, now)
    if isinstance(method, FieldMethod):
        return _of_field(method, extent, now)
    candidates = candidates_of(method)
    if candidates[0] is method:
        return _of_direct(method, extent, now)
    tried = Extent(extent.views, extent.cols, [32])
    return sum(run_seconds(one, tried, now) for one in candidates) + run_seconds(candidates[0], extent, now)


def _of_iterations(method: Method, iterations: int, extent: Extent, now: Clock) -> float:
    _took(method, _COMPILED, 1, Decisions(), now)
    tried = _TRIED[0], min(_TRIED[1], extent.cols), _TRIED[2]
    deciding, decided = _took(method, tried, 1 + _SWEEPS, Decisions(), now)
    following, _ = _took(method, tried, 1 + _SWEEPS, Decisions(0, decided), now)
    cols, height = min(extent.cols, _SWEPT_COLS), min(max(extent.heights), _SWEPT_ROWS)
    few, many = (_of_sweeps(method, (views, cols, height), decided, now) for views in _VIEWS)
    at = (extent.views - _VIEWS[0]) / (_VIEWS[1] - _VIEWS[0])
    sweep, start = (max(a + at * (b - a), 0.0) for a, b in zip(few, many, strict=True))
    rays = extent.views * extent.cols**2 / (tried[0] * tried[1] ** 2)
    # Trials on sixteen rows; how many depends on the data.
    once = 0.0 if extent.decided else rays * max(deciding - following, 0.0)
    return (extent.cols / cols) ** 2 * extent.rows / height * (start + iterations * sweep) + once


def _of_sweeps(method: Method, size: tuple[int, int, int], decided: Decided, now: Clock) -> tuple[float, float]:
    """Seconds of an iteration, and seconds before the first one."""
    one, last = (_took(method, size, n, Decisions(0, decided), now)[0] for n in (1, 1 + _SWEEPS))
    sweep = (last - one) / _SWEEPS
    return sweep, one - sweep


def _took(
    method: Method, size: tuple[int, int, int], iterations: int, decide: Decisions, now: Clock
) -> tuple[float, Decided]:
    """Seconds of so many iterations, and their decisions."""
    geometry, data = _sample(*size)
    one = with_settings(method, {"iterations": iterations})
    begin = now()
    reconstruct(data, geometry, one, control=RunControl(decide=decide))
    return now() - begin, decide.made


def _of_direct(method: Method, extent: Extent, now: Clock) -> float:
    cols, views = min(extent.cols, _FBP_COLS), min(extent.views, _FBP_VIEWS)
    geometry, data = _sample(views, cols)
    times = []
    for _ in range(3):
        begin = now()
        reconstruct(data, geometry, method)
        times.append(now() - begin)
    share = min(times) / fbp_nanoseconds(views, cols, _FEW_ROWS)
    return share * sum(fbp_nanoseconds(extent.views, extent.cols, height) for height in extent.heights)


def _of_field(method: FieldMethod, extent: Extent, now: Clock) -> float:
    """A step costs as many samples as its rays have, and slices of the volume two fifths of that a voxel."""
    geometry, data = _sample(_FIT_VIEWS, _FIT_COLS)
    tried = with_settings(method, {"seconds": None, "early_stop": False})

    def took(steps: int) -> float:
        begin = now()
        reconstruct(data, geometry, with_settings(tried, {"steps": steps}))
        return now() - begin

    took(1)
    short, long = took(2), took(2 + _FIELD_STEPS)
    step = max(long - short, long / 4) / _FIELD_STEPS * method.samples_of(extent.cols) / method.samples_of(_FIT_COLS)
    steps, beside = method.steps * step * len(extent.heights), extent.rows * extent.cols**2
    steps = steps if method.seconds is None else min(steps, method.seconds)
    return steps + short * beside / (_FEW_ROWS * _FIT_COLS**2)


def _of_fit(method: FitMethod, extent: Extent, now: Clock) -> float:
    geometry, data = _sample(_FIT_VIEWS, _FIT_COLS)
    count = default_count(Grid.matching(geometry))

    def took(steps: int) -> float:
        begin = now()
        reconstruct(data, geometry, R2(steps=steps, finish=0, gaussians=count))
        return now() - begin

    took(2)
    short, long = (min(took(steps) for _ in range(2)) for steps in (_STEPS, 2 * _STEPS))
    mean = long / (2 * _STEPS)
    step = min(max((long - short) / _STEPS, mean / 4), mean)  # on a busy machine the longer run may take less
    voxels = _FEW_ROWS * _FIT_COLS**2
    given = method.gaussians.n if isinstance(method.gaussians, Gaussians) else method.gaussians
    fitted = 0.0
    for height in extent.heights:
        grid = Grid((height, extent.cols, extent.cols))
        of_slab = default_count(grid) if given is None else given * height / extent.rows
        fitted += ((height * extent.cols**2) / voxels) ** (2 / 3) * (of_slab / count) ** (1 / 3)
    steps = method.seconds if method.seconds is not None else (method.planned_steps or 0) * step * fitted
    sweeps = 8 if method.finish is None else method.finish
    finish = _of_iterations(FistaTv(), sweeps, extent, now) if sweeps else 0.0
    return steps + finish + _of_direct(Fbp(), extent, now)


def _sample(views: int, cols: int, rows: int = _FEW_ROWS) -> tuple[Geometry, F32]:
    """Views of a disc with a hole, with some noise."""
    geometry = Geometry.parallel(np.arange(views) * np.pi / views, (rows, cols))
    grid = Grid.matching(geometry)
    _, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    disc = (np.hypot(x, y) < 0.4 * cols) & ~(np.hypot(x - 0.1 * cols, y) < 0.1 * cols)
    data = Projector(geometry, grid).forward((disc / cols).astype(np.float32))
    return geometry, data + np.random.default_rng(0).normal(0, 0.02, data.shape).astype(np.float32)
