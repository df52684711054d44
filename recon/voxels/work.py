"""The work of operations on voxels, as `recon.base.work` counts it, and of the trials that choose a prior."""

from __future__ import annotations

import math
from dataclasses import replace

from recon.base.empirical import FEWEST_SUBSETS, ONE_IN
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.base.work import Work
from recon.voxels.direct import direct_work
from recon.voxels.held_out import (
    CHOICE_SWEEPS,
    LEAST_VIEWS,
    SUBSETS,
    TRIAL_ROWS,
    TRIAL_SWEEPS,
    TRIALS,
    TV_STEPS,
)
from recon.voxels.priors import STEPS, subsets_of
from recon.voxels.projector import Projector, views_of_exposure
from recon.voxels.voxel_problem import POWER_ROUNDS, POWER_ROWS

_PASSES_AHEAD = 2.0  # over the volume, of a step of `Momentum`


def beam_of(geometry: Geometry, grid: Grid) -> str:
    """The kernels of `Projector` for these views."""
    if not geometry.is_straight:
        return "posed"
    if grid.shape[0] == 1:
        return "slice"
    return "cone" if geometry.is_cone else "parallel"


def sweep(geometry: Geometry, grid: Grid) -> Work:
    """Work of a projection of all views and its adjoint.

    Raises:
        ValueError: no projector takes these views.
    """
    Projector(geometry.select([0]), grid)  # refuses what it does not take
    nz, ny, nx = grid.shape
    lines = float(len(views_of_exposure(geometry)) * geometry.n_views * ny * nx)
    return Work.of(f"sweep, {beam_of(geometry, grid)}", lines, lines * nz)


def on_volume(operation: str, grid: Grid, times: float = 1.0) -> Work:
    """Passes over the volume, of "pass" (of sums and products), "tv" (dual steps), "slope" (of TV) or "patches"."""
    nz, ny, nx = grid.shape
    return Work.of(operation, times * ny * nx, times * ny * nx * nz)


def power_rounds(geometry: Geometry, grid: Grid, subsets: int = 1) -> Work:
    """Work of `largest_eigenvalue` of a subset of the views, all rays alike."""
    rows = min(POWER_ROWS, grid.shape[0]) if geometry.rows_show_slices else grid.shape[0]
    some = replace(grid, shape=(rows, *grid.shape[1:]))
    return sweep(geometry, some) * (POWER_ROUNDS / subsets)


def fista_sweeps(geometry: Geometry, grid: Grid, sweeps: float, subsets: int, tv_steps: int, fewest: int = 1) -> Work:
    """Work of sweeps of `ordered_fista`; subsets as of `subsets_of`."""
    count = subsets_of(geometry, subsets, fewest)
    step = on_volume("pass", grid, 1 + _PASSES_AHEAD) + on_volume("tv", grid, tv_steps + 1)
    return sweeps * (sweep(geometry, grid) + count * step)


def ordered_sweeps(geometry: Geometry, grid: Grid, sweeps: float, subsets: int) -> Work:
    """Work of passes over ordered subsets, with those for the sums before the first one."""
    if subsets >= geometry.n_views:
        work = sweep(geometry, grid)
        return (sweeps + 1) * Work({f"single {name}": amounts for name, amounts in work.amounts.items()})
    return (sweeps + 1) * (sweep(geometry, grid) + on_volume("pass", grid, subsets))


def patch_steps(geometry: Geometry, grid: Grid, steps: int) -> Work:
    """Work of steps of `pnp_dct`."""
    rounds = -(-steps // STEPS)
    towards = sweep(geometry, grid) + on_volume("pass", grid, 2)
    return steps * towards + on_volume("patches", grid, rounds + 1) + power_rounds(geometry, grid)


def trial_part(geometry: Geometry, grid: Grid, rows: int = TRIAL_ROWS) -> tuple[Geometry, Grid] | None:
    """Views and voxels of a trial by held-out views, see `HeldOutTrial`; None if there is none."""
    if geometry.n_views < LEAST_VIEWS:
        return None
    seen = geometry.n_views - geometry.n_views // ONE_IN
    rows = min(rows, geometry.detector_shape[0])
    slices = min(rows, grid.shape[0])
    if not geometry.rows_show_slices:  # voxels that any ray to these rows meets
        tall = (rows + 1) * geometry.sample_pitch + 2 * geometry.lean
        tall *= 1 + geometry.reach / geometry.sod if geometry.is_cone else 1
        slices = min(grid.shape[0], math.ceil(tall / grid.spacing[0]))
    some = geometry.select(slice(0, seen)).rows(0, rows)
    return some, replace(grid, shape=(slices, *grid.shape[1:]))


def weight_choice(geometry: Geometry, grid: Grid) -> Work:
    """Work of `choose_weight`: FBP, its noise, and the usual number of trials."""
    first = direct_work(geometry, grid) + on_volume("slope", grid)
    part = trial_part(geometry, grid)
    if part is None:
        return first
    count = subsets_of(geometry, SUBSETS, FEWEST_SUBSETS)
    trials = fista_sweeps(*part, CHOICE_SWEEPS, count, TV_STEPS, count)
    return first + direct_work(*part) + power_rounds(*part, count) + trials


def patch_choice(geometry: Geometry, grid: Grid, steps: int) -> Work:
    """Work of `choose_patches`: the noise of a volume, and the usual number of trials of so many steps."""
    noise = power_rounds(geometry, grid) + STEPS * (sweep(geometry, grid) + on_volume("pass", grid, 2))
    part = trial_part(geometry, grid)
    if part is None:
        return noise
    smooth = fista_sweeps(*part, TRIAL_SWEEPS, SUBSETS, TV_STEPS, FEWEST_SUBSETS)
    return noise + smooth + TRIALS * patch_steps(*part, steps)
