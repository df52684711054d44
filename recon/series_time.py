"""Series time: predicts how long a fit of volumes in time will take, from small fits on this machine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.base.geometry import Geometry
from recon.base.method import Clock
from recon.base.volume import Grid
from recon.energy_fit import EnergyFit
from recon.learnt_motion import JUDGED, JUDGED_SWEEPS, SWEEPS_OF_TURN, levels
from recon.run_time import Extent, RunTime, sample
from recon.series import MOMENTS, TimedViews, of_moments, refuse_few
from recon.voxels.motion import Motion

_COLUMNS, _ROWS, _VIEWS = (32, 96), 16, 216
_TIMED = 5  # sweeps; the quickest counts
_TRIALS = 24 * 11, 24 * 16  # sweeps of weights: of usual data, and at most
_TURN = 4  # sweeps that the steps of a motion take, beside its own
_FACTORS = 120, 60  # sweeps that factors take: of their trials, beside those of the fit, and of the solution


@dataclass(frozen=True)
class _Cost:
    """Seconds of a sweep: of each view, and of each voxel and view."""

    start: float
    voxel: float

    def of(self, views: float, voxels: float) -> float:
        return views * (self.start + voxels * self.voxel)


def series_seconds(geometry: Geometry, knots: int, motion: bool | None, sweeps: int, now: Clock) -> RunTime:
    """Seconds of `recon.fit_series`, without reading and correction; least: where nothing moves, if that is open.

    Raises:
        ValueError: the views do not suffice for so many volumes.
    """
    refuse_few(knots, geometry.n_views)
    still, moving = (_cost(geometry, knots, moves, now) for moves in (False, True))
    cols, n = geometry.detector_shape[1], geometry.n_views
    slices, _, across = Grid.matching(geometry).shape
    voxels = slices * across**2
    few = min(slices, _ROWS) * across**2 if geometry.rows_show_slices else voxels
    learning = sum(turns * (SWEEPS_OF_TURN + _TURN) * moving.of(n, voxels / wide**3) for wide, turns in levels(cols))
    wide = max(1, round(cols / JUDGED))
    judging = learning + JUDGED_SWEEPS * (still.of(n, voxels / wide**3) + moving.of(n, voxels / wide**3))
    at_rest = (sweeps + _FACTORS[1]) * still.of(n, voxels) + (sweeps + _FACTORS[0]) * still.of(n, few)
    moved = learning + sweeps * moving.of(n, voxels)
    first = judging if motion is None else 0.0
    least, most = (first + trials * still.of(n, few) for trials in _TRIALS)
    ends = {None: (min(at_rest, moved), max(at_rest, moved)), False: (at_rest, at_rest), True: (moved, moved)}[motion]
    return RunTime(most + ends[1], least + ends[0])


def _cost(geometry: Geometry, knots: int, moves: bool, now: Clock) -> _Cost:
    """From sweeps over two sizes; the first one may compile."""
    measured = []
    for cols in _COLUMNS:
        small, data = sample(Extent(geometry, [_ROWS]), min(geometry.n_views, _VIEWS), cols, _ROWS)
        grid, times = Grid.matching(small), np.arange(small.n_views, dtype=np.float64)
        views, past = of_moments(
            TimedViews(data, small, times), np.linspace(0, times[-1], knots), MOMENTS * (knots - 1)
        )
        nz, ny, nx = grid.shape
        motion = Motion.none((ny, nx, nz), past, 3, 3) if moves else None
        fit, marks = EnergyFit(views, grid, np.random.default_rng(0), motion), [now()]
        marks += [now() for _ in fit.sweeps(np.full(knots, 0.1), _TIMED)]
        measured.append((float(np.diff(marks).min()) / small.n_views, nz * ny * nx))
    (less, few), (more, many) = measured
    voxel = max(more - less, 0.0) / (many - few)
    return _Cost(max(less - voxel * few, 0.0), voxel)
