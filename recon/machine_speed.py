"""measured_speeds: the speed of this machine on a scan, from about a second of small runs, scaled to the whole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon.assess.plans import Speeds
from recon.base.arrays import F32
from recon.base.binning import bin_views
from recon.base.geometry import Geometry
from recon.base.method import Clock, RunControl
from recon.base.volume import Grid
from recon.reconstruction import reconstruct
from recon.splatting.gaussians import Gaussians
from recon.splatting.in_time import sweep_seconds
from recon.splatting.initialise import MATTER, count_for, density_unit, first_volume, sample_gaussians
from recon.splatting.r2 import R2
from recon.splatting.settings import FitSettings
from recon.splatting.splat import voxelize
from recon.voxels.held_out import busiest_rows, choice_sweeps

_SLAB_ROWS, _SLAB_VIEWS = 16, 16
_COARSE_COLS, _COARSE_VIEWS = 64, 60
_STEP_VIEWS, _STEPS = 4, 6
_SWEPT_ROWS = 64  # fewer rows take longer for each row: 1.5 times at 16


def measured_speeds(projections: F32, geometry: Geometry, grid: Grid, now: Clock) -> Speeds:
    """Measure each part of a reconstruction on a part of the scan.

    The first volume (FBP, or its replacement, see `first_volume`), placing and filling run on a slab of rows. The step
    runs on whole views, with the number of Gaussians that a fit would start from, spread over the matter in a coarse
    first volume: the time of a step depends on how much they overlap.

    Raises:
        ValueError: the scan holds no matter.
    """
    field = Grid.for_fit(geometry, grid)
    count = count_for(field, geometry.is_cone)
    slab, part = _slab(projections, geometry)
    slices = Grid.of_field(part, part.sample_pitch)
    whole = field.shape[0] / slices.shape[0]
    views = geometry.n_views / part.n_views
    first_volume(slab, part, slices)  # starts threads and loads pages; not timed
    begin = now()
    first = first_volume(slab, part, slices)
    fbp_seconds = (now() - begin) * whole * views

    begin = now()
    placed = sample_gaussians(
        first, max(1, round(count / whole)), np.random.default_rng(0), field_radius=geometry.reach,
        kernel=FitSettings().kernel,
    )  # fmt: skip
    start_seconds = (now() - begin) * whole
    voxelize(placed, slices)
    begin = now()
    voxelize(placed, slices)
    fill_seconds = (now() - begin) * grid.shape[0] / slices.shape[0]

    step_seconds, view_seconds = _step(projections, geometry, grid, _spread_out(projections, geometry, count), now)
    # Placing scales its densities by a projection of twelve views, which is about a third of as many steps.
    start_seconds += 4 * step_seconds + view_seconds * geometry.n_views
    high = geometry.rows(0, min(_SWEPT_ROWS, geometry.detector_shape[0]))
    some = Grid.of_field(high, high.sample_pitch)
    sweep = sweep_seconds(high, some, now) * grid.shape[0] / some.shape[0]
    trials = choice_sweeps(geometry) * sweep
    return Speeds(fbp_seconds, start_seconds, step_seconds, fill_seconds, sweep, trials)


def _slab(projections: F32, geometry: Geometry) -> tuple[F32, Geometry]:
    """A few views of the rows with most matter."""
    views = _around(geometry, _SLAB_VIEWS)
    some = projections[views]
    rows = busiest_rows(some, _SLAB_ROWS)
    return np.ascontiguousarray(some[:, rows]), geometry.select(views).rows(rows.start, rows.stop)


def _spread_out(projections: F32, geometry: Geometry, count: int) -> Gaussians:
    """`count` Gaussians where a coarse first volume shows matter, with the widths of placed ones."""
    factor = max(1, min(-(-geometry.detector_shape[1] // _COARSE_COLS), geometry.detector_shape[0]))
    views = _around(geometry, _COARSE_VIEWS)
    coarse = geometry.select(views).binned(factor)
    grid = Grid.of_field(coarse, coarse.sample_pitch)
    volume = first_volume(bin_views(projections[views], factor), coarse, grid)
    unit = density_unit(volume)
    cells = np.flatnonzero(volume.data.ravel() > MATTER * unit) if unit > 0 else np.empty(0, np.int64)
    if cells.size == 0:
        raise ValueError("a coarse FBP shows no matter: are the projections line integrals (-log of the transmission)?")
    rng = np.random.default_rng(0)
    k, j, i = np.unravel_index(rng.choice(cells, count), grid.shape)
    z, y, x = grid.coordinates()
    means = np.stack((x[i], y[j], z[k]), 1) + (rng.random((count, 3)) - 0.5) * grid.spacing[::-1]
    # Root mean square distance of a random point to its three nearest neighbours: 0.75 of a cell with one point each.
    distance = 0.75 * (cells.size * float(np.prod(grid.spacing)) / count) ** (1 / 3)
    width = max(0.8 * distance, 0.5 * geometry.sample_pitch)
    return Gaussians.from_physical(
        means, np.full((count, 3), width), np.full(count, 0.5 * unit), density_unit=unit, kernel=FitSettings().kernel
    )


def _step(projections: F32, geometry: Geometry, grid: Grid, gaussians: Gaussians, now: Clock) -> tuple[float, float]:
    """(s a step, s for each view before the first step), from a short fit's own record."""
    views = _around(geometry, _STEP_VIEWS)
    point = Grid((1, 1, 1), grid.voxel_size)  # filling a volume is measured elsewhere
    fit = R2(steps=_STEPS, gaussians=gaussians, fit=FitSettings(policy=None))
    data = np.ascontiguousarray(projections[views])
    result = reconstruct(data, geometry.select(views), fit, grid=point, control=RunControl(now=now))
    first, last = result.history[0], result.history[-1]
    step = (last.seconds - first.seconds) / max(1, last.step - first.step)
    return step, max(0.0, first.seconds - step) / len(views)


def _around(geometry: Geometry, most: int) -> NDArray[np.int64]:
    """Some views from all around, so that they need the same kind of first volume as all views."""
    n = geometry.n_views
    order = np.argsort(np.mod(geometry.angles, geometry.period), kind="stable")
    return np.sort(order[np.arange(min(n, most)) * n // min(n, most)])
