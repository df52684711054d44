"""In time: divides a fit's seconds among its start, its steps, its finish on voxels, and its volume."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from recon.base.geometry import Geometry
from recon.base.method import Clock
from recon.base.volume import Grid, Volume
from recon.splatting.finish import FINISH_SWEEPS, SUBSETS, TV_STEPS
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import sample_gaussians
from recon.splatting.splat import voxelize
from recon.voxels.held_out import CHOICE_SWEEPS, choice_sweeps
from recon.voxels.methods import PnpDct
from recon.voxels.priors import subsets_of
from recon.voxels.projector import Projector
from recon.voxels.voxel_problem import TotalVariationProx, difference_weights

FINISH_SHARE = 0.8
"""Largest share of the finish in the time after the first steps: it adds more than most steps before it."""

_GROWTH = 1.5  # a fit may end with so many times the Gaussians, and filling then takes so many times longer
_SLAB = 16  # slices that are filled to measure it
_DRAWN = 8  # slices that Gaussians are drawn from to measure it
_SWEPT_VIEWS = 8
_COLS = 96  # binned pixels of the views that time a start
# Work before the sweeps of a finish, beside the choice of its weight, in sweeps: the largest eigenvalue of a subset,
# projections and an FBP.
_EIGENVALUE_ROUNDS, _FIRST_SWEEPS = 6, 3


def sweep_seconds(geometry: Geometry, grid: Grid, now: Clock) -> float:
    """Time of a sweep of FISTA-TV over all views.

    It is measured on projections of a few views in both directions and one proximal step of total variation.
    """
    some = geometry.select(np.arange(0, geometry.n_views, max(1, geometry.n_views // _SWEPT_VIEWS))[:_SWEPT_VIEWS])
    projector = Projector(some, grid)
    begin = now()
    x = projector.adjoint_lines(projector.forward_lines(np.ones((*grid.shape[1:], grid.shape[0]), np.float32)))
    projected = now()
    TotalVariationProx(x.shape, difference_weights(grid), True, TV_STEPS)(x, float(x.max()) / 100)
    parts = subsets_of(geometry, SUBSETS)
    return (projected - begin) * geometry.n_views / some.n_views + (now() - projected) * parts


def first_sweep_seconds(geometry: Geometry, grid: Grid, now: Clock) -> float:
    """The same, estimated quickly at the beginning from binned pixels."""
    factor = max(1, min(geometry.detector_shape[1] // _COLS, geometry.detector_shape[0]))
    coarse = geometry.binned(factor)
    box = Grid.of_field(coarse, coarse.sample_pitch)
    share = math.prod(grid.shape) / math.prod(box.shape)
    return sweep_seconds(coarse, box, now) * share


def first_draw_seconds(grid: Grid, count: int, now: Clock) -> float:
    """Time to draw so many Gaussians from a first volume, measured on some slices of noise, which count as matter."""
    nz, ny, nx = grid.shape
    slices = min(_DRAWN, nz)
    slab, rng = grid.part(slice(0, slices), slice(0, ny), slice(0, nx)), np.random.default_rng(0)
    noise = Volume(rng.random(slab.shape, dtype=np.float32), slab)
    begin = now()
    sample_gaussians(noise, max(1, count * slices // nz), rng, field_radius=math.inf)
    return (now() - begin) * nz / slices


def fill_seconds(gaussians: Gaussians, grid: Grid, now: Clock) -> float:
    """Time to fill the grid at the end of a fit that starts from these Gaussians, measured on a slab."""
    slab = replace(grid, shape=(min(_SLAB, grid.shape[0]), *grid.shape[1:]))
    begin = now()
    voxelize(gaussians, slab)
    return (now() - begin) * grid.shape[0] / slab.shape[0] * _GROWTH


class FinishPlan(NamedTuple):
    """What a finish may take.

    Attributes:
        sweeps: of total variation; None: as many as it makes by default, and steps with sparse patches.
        seconds: that it will take.
        trials: views held out choose its prior; else it is total variation by the noise.
    """

    sweeps: int | None
    seconds: float
    trials: bool = True


def finish_within(seconds: float, beside_steps: float, geometry: Geometry, grid: Grid, now: Clock) -> FinishPlan:
    """A fit's finish within `seconds`: the usual sweeps at most, unless `beside_steps` suffice for patches and trials.

    Where time is short it goes without trials of its weight, which on few rows cost more than seven finishes. A time
    for fewer than two sweeps gives 0, because the work before them takes as long.
    """
    if seconds <= 0:
        return FinishPlan(0, 0.0)
    sweep = sweep_seconds(geometry, grid, now)
    before = (_EIGENVALUE_ROUNDS / subsets_of(geometry, SUBSETS) + _FIRST_SWEEPS) * sweep
    choice, patches = choice_sweeps(geometry) * sweep, PnpDct()
    most = before + (FINISH_SWEEPS + patches.iterations) * sweep + choice * patches.trial_sweeps / CHOICE_SWEEPS
    if choice and most <= min(seconds, beside_steps):
        return FinishPlan(None, most)
    trials = before + choice + FINISH_SWEEPS * sweep <= seconds
    before += choice if trials else 0.0
    if not before + 2 * sweep <= seconds:
        return FinishPlan(0, 0.0)
    sweeps = min(FINISH_SWEEPS, int((seconds - before) / sweep)) if sweep > 0 else FINISH_SWEEPS
    return FinishPlan(sweeps, before + sweeps * sweep, trials)
