"""The motion of a sample while it is scanned, learnt from coarse to fine voxels.

One volume, displaced, explains all views of a sample that only moves. So volume and motion improve each other in turns,
first on voxels so coarse that the motion is short.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from recon.base.arrays import F32, F64
from recon.base.volume import Grid
from recon.energy_fit import EnergyFit, EnergyViews
from recon.voxels.held_out_weight import ONE_IN
from recon.voxels.motion import Motion, Seen, improved
from recon.voxels.projector import Projector, projection_lines

_COARSEST = 12  # voxels across of the first level, at least; each other one has voxels half as wide
_FINE = 96  # pixels across up to which the last level has a voxel a pixel; of more, one for two
_TURNS = 6, 4, 2  # of the first levels; later ones have the last number
SWEEPS_OF_TURN = 6  # of a turn, which go on from the last one
_KNOTS, _CONTROLS = 3, 3  # of the motion: in time, and along each axis
_HEAVIER = 2.0  # weight of total variation: one volume for all times has less detail
JUDGED, JUDGED_SWEEPS = 48, 24  # voxels across of volumes that judge a motion, and their sweeps


def levels(cols: int) -> list[tuple[int, int]]:
    """Pixels in a voxel, and turns, of each level for so many pixels across."""
    last = 1 if cols <= _FINE else 2
    widths = [last]
    while cols // (2 * widths[0]) >= _COARSEST:
        widths.insert(0, 2 * widths[0])
    return [(width, _TURNS[min(n, len(_TURNS) - 1)]) for n, width in enumerate(widths)]


def motion_sweeps(cols: int) -> int:
    """Of `learnt_motion`."""
    return SWEEPS_OF_TURN * sum(turns for _, turns in levels(cols))


def unseen_residuals(
    views: EnergyViews, times: F64, weights: F64, go_on: Callable[[int, float], bool], stop: Callable[[], bool]
) -> tuple[float, float] | None:
    """Residuals of views held out, of volumes that do not move and of volumes that do; None: stopped.

    Of coarse voxels, each from seven of eight views. Arguments as of `learnt_motion`.
    """
    held_out = views.parted(ONE_IN) == ONE_IN // 2
    binning = max(1, round(views.geometry.detector_shape[1] / JUDGED))
    seen, unseen = (views.select(np.flatnonzero(chosen), slice(None)) for chosen in (~held_out, held_out))
    follow = 2 * JUDGED_SWEEPS
    motion = learnt_motion(seen, times, weights, lambda sweep, residual: go_on(sweep - follow, residual), stop)
    if motion is None:
        return None
    seen, unseen = _binned(seen, binning), _binned(unseen, binning)
    grid, left = Grid.matching(seen.geometry), []
    nz, ny, nx = grid.shape
    for now in (None, motion.on((ny, nx, nz), times)):
        fit = EnergyFit(seen, grid, np.random.default_rng(0), now, stop)
        for residual in fit.sweeps(weights, JUDGED_SWEEPS):
            follow -= 1
            if not go_on(-follow, residual):
                return None
        if stop():
            return None
        left.append(EnergyFit(unseen, grid, np.random.default_rng(0), now).residual_of(fit.densities()))
    return left[0], left[1]


def learnt_motion(
    views: EnergyViews, times: F64, weights: F64, go_on: Callable[[int, float], bool], stop: Callable[[], bool]
) -> Motion | None:
    """The motion on the voxels of `Grid.matching`; None: stopped.

    Args:
        views: each `energy` is a moment, each material a knot of the densities.
        times: [moment], 0 ... 1.
        weights: of total variation of the densities' components.
        go_on: called with (-n, residual) after each sweep, where n follow. False ends it.
        stop: asked many times within a sweep; True ends it.
    """
    cols = views.geometry.detector_shape[1]
    alone = replace(views, cross_sections=np.ones((times.size, 1)))
    motion, follow = None, motion_sweeps(cols)
    for wide, turns in levels(cols):
        some = _binned(alone, wide)
        grid = Grid.matching(some.geometry)
        nz, ny, nx = grid.shape
        motion = (
            Motion.none((ny, nx, nz), times, _KNOTS, _CONTROLS) if motion is None else motion.on((ny, nx, nz), times)
        )
        fit, seen = EnergyFit(some, grid, np.random.default_rng(0), motion, stop), _seen(some, grid)
        for _ in range(turns):
            for residual in fit.sweeps(np.full(1, _HEAVIER * weights.max()), SWEEPS_OF_TURN):
                follow -= 1
                if not go_on(-follow, residual):
                    return None
            if stop():
                return None
            motion = improved(motion, seen, fit.image)
            fit.move(motion)
    assert motion is not None
    nz, ny, nx = Grid.matching(views.geometry).shape
    return motion.on((ny, nx, nz), times)


def _binned(views: EnergyViews, n: int) -> EnergyViews:
    """Mean of n x n pixels; of their weights, too."""
    n = max(1, min(n, *views.geometry.detector_shape))

    def mean(images: F32) -> F32:
        count, rows, cols = images.shape
        part = images[:, : rows // n * n, : cols // n * n].reshape(count, rows // n, n, cols // n, n)
        return np.asarray(part.mean((2, 4), dtype=np.float32), np.float32)

    geometry = views.geometry.binned(n)
    if views.weight is None:
        return replace(views, projections=mean(views.projections), geometry=geometry)
    weight = mean(views.weight)
    data = np.divide(mean(views.projections * views.weight), np.maximum(weight, np.float32(1e-6)), dtype=np.float32)
    return replace(views, projections=data, geometry=geometry, weight=weight)


def _seen(views: EnergyViews, grid: Grid) -> list[Seen]:
    whole, data = Projector(views.geometry, grid), projection_lines(views.projections)
    weight = None if views.weight is None else projection_lines(views.weight)
    return [
        Seen(int(e), whole.subset(at), data[at], None if weight is None else weight[at])
        for e in np.unique(views.energy)
        for at in [np.flatnonzero(views.energy == e)]
    ]
