"""The motion of a sample while it is scanned, learnt from coarse to fine voxels.

One volume, displaced, explains all views of a sample that only moves. So volume and motion improve each other in turns,
first on voxels so coarse that the motion is short.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64, bin_views
from recon.base.declared_types import check_arguments
from recon.base.views import spread
from recon.base.volume import Grid
from recon.features.joint.energy_fit import EnergyFit, EnergyViews
from recon.features.joint.motion import Motion, Seen, improved, moved, weighed
from recon.voxels.displacement import Displacement, displaced, displacements, judge, measured_unmagnified, unmagnified
from recon.voxels.field_edges import busiest_rows
from recon.voxels.projector import Projector, projection_lines, volume_lines

_COARSEST = 12  # voxels across of the first level, at least; each other one has voxels half as wide
_FINE = 96  # pixels across up to which the last level has a voxel a pixel; of more, one for two
_TURNS = 6, 4, 2  # of the first levels; later ones have the last number
SWEEPS_OF_TURN = 6  # of a turn, which go on from the last one
_KNOTS, _CONTROLS = 3, 3  # of the motion: in time, and along each axis
_HEAVIER = 2.0  # weight of total variation: one volume for all times has less detail
JUDGED, JUDGED_SWEEPS = 48, 24  # voxels across of volumes that judge a motion, and their sweeps
_BLOCKS, _ONE_BLOCK_IN = 32, 4  # of the scan's time, and one of so many held out: eight


def levels(cols: int) -> list[tuple[int, int]]:
    """Voxel size in pixels, and number of turns, of each resolution level for `cols` pixels across."""
    last = 1 if cols <= _FINE else 2
    widths = [last]
    while cols // (2 * widths[0]) >= _COARSEST:
        widths.insert(0, 2 * widths[0])
    return [(width, _TURNS[min(n, len(_TURNS) - 1)]) for n, width in enumerate(widths)]


class OfMoments(NamedTuple):
    """Views of a changing sample, each assigned to one of some moments.

    Attributes:
        views: each `energy` is a moment, each material a knot of the densities.
        times: [moment] within the scan, 0 ... 1.
        weights: of total variation of the densities' components.
    """

    views: EnergyViews
    times: F64
    weights: F64


def unseen_squares(
    coarse: OfMoments, fine: OfMoments, go_on: Callable[[int, float], bool], stop: Callable[[], bool]
) -> F64 | None:
    """Residual of held-out views for volumes without and with motion: squares [2, block], relative to the mean of the
    views' own; None if stopped.

    Views that follow each other are held out in blocks. Where angles rise with time, volumes in time predict a single
    view from those before and after it, even of a sample that moves. The motion is learnt from `coarse` moments of the
    other views; volumes of coarse voxels are fitted to `fine` ones, within which the sample hardly moves.

    Args:
        coarse, fine: the same views.
        go_on, stop: as of `learnt_motion`.
    """
    block = fine.views.energy * _BLOCKS // len(fine.views.cross_sections)
    held_out = block % _ONE_BLOCK_IN == _ONE_BLOCK_IN // 2
    used, follow = np.flatnonzero(~held_out), 2 * JUDGED_SWEEPS
    seen = coarse._replace(views=coarse.views.select(used, slice(None)))
    motion = learnt_motion(seen, lambda sweep, residual: go_on(sweep - follow, residual), stop)
    if motion is None:
        return None
    views = _binned(fine.views, round(fine.views.geometry.detector_shape[1] / JUDGED))
    grid, left = Grid.matching(views.geometry), []
    nz, ny, nx = grid.shape
    for now in (None, motion.on((ny, nx, nz), fine.times)):
        fit = EnergyFit(views.select(used, slice(None)), grid, np.random.default_rng(0), now, stop)
        for residual in fit.sweeps(fine.weights, JUDGED_SWEEPS):
            follow -= 1
            if not go_on(-follow, residual):
                return None
        if stop():
            return None
        left.append(_squares_left(views, fit.densities(), now, grid))
    numbers = np.unique(block[held_out])
    of_blocks = np.array([[squares[block == number].sum() for number in numbers] for squares in left])
    own = _squares_left(views, np.zeros_like(fit.densities()), None, grid)[held_out].sum() / numbers.size
    return of_blocks / (own or 1.0)


def _squares_left(views: EnergyViews, densities: F32, motion: Motion | None, grid: Grid) -> F64:
    """[view] weighted squared residual by densities [knot, z, y, x]."""
    projector, data = Projector(views.geometry, grid), projection_lines(views.projections)
    weight = None if views.weight is None else projection_lines(views.weight)
    squares = np.empty(len(data))
    for view, moment in enumerate(views.energy.tolist()):
        now = volume_lines(np.tensordot(views.cross_sections[moment].astype(np.float32), densities, 1))
        image = projector.subset([view]).forward_lines(moved(now, None if motion is None else motion.at(moment)))
        off = data[view : view + 1] - image
        squares[view] = np.vdot(off, weighed(off, None if weight is None else weight[view : view + 1]))
    return squares


def learnt_motion(
    of_moments: OfMoments, go_on: Callable[[int, float], bool], stop: Callable[[], bool]
) -> Motion | None:
    """Find the motion on the voxels of `Grid.matching`; None if stopped.

    Args:
        go_on: called with (-n, residual) after each sweep, where n follow. False ends it.
        stop: asked many times within a sweep; True ends it.
    """
    views, times, weights = of_moments
    cols = views.geometry.detector_shape[1]
    alone = replace(views, cross_sections=np.ones((times.size, 1)))
    motion, follow = None, SWEEPS_OF_TURN * sum(turns for _, turns in levels(cols))
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
    geometry = views.geometry.binned(n)
    if views.weight is None:
        return replace(views, projections=bin_views(views.projections, n), geometry=geometry)
    weight, sums = bin_views(views.weight, n), bin_views(views.projections * views.weight, n)
    data = np.divide(sums, np.maximum(weight, np.float32(1e-6)), dtype=np.float32)
    return replace(views, projections=data, geometry=geometry, weight=weight)


def _seen(views: EnergyViews, grid: Grid) -> list[Seen]:
    whole, data = Projector(views.geometry, grid), projection_lines(views.projections)
    weight = None if views.weight is None else projection_lines(views.weight)
    return [
        Seen(int(e), whole.subset(at), data[at], None if weight is None else weight[at])
        for e in np.unique(views.energy)
        for at in [np.flatnonzero(views.energy == e)]
    ]


_LEVELS = ((64, 2), (160, 4), (320, 2))  # columns, at most, and volumes of all views
_ROWS = 32  # binned rows looked at
_VIEWS = 60  # looked at, of each energy
_MOVES = 0.1  # columns by which a magnification moves the outermost pixel: less is none, and no view is interpolated
_HELPS = 0.995  # of the deviation of views held out: a registration that leaves more is none
STEPS = sum(rounds for _, rounds in _LEVELS) + 1


def register_energies(
    views: EnergyViews, progress: Callable[[int, int], None] = lambda n, most: None
) -> tuple[EnergyViews, tuple[Displacement, ...]]:
    """Align the scans of all energies, correcting the views for the sample's position and the optics; a parallel beam.

    The energy with the most views is the reference. A volume of it predicts the others, each scaled by what it absorbs
    in the mean. The sample is shifted along x, y and z and turned about the axis. The image is shifted along the rows
    and magnified. These six explain the differences (see `recon.voxels.displacement`). Edges tell it, so a material
    that absorbs unlike at two energies does no harm.

    Returns:
        The views, interpolated where their magnification differs, and the displacement of each energy. None is
        displaced where that predicts views held out no better.

    Raises:
        ValueError: a cone, whose rays a shift of the sample turns.
    """
    check_arguments(register_energies, locals())
    moves: list[Displacement] | None = None
    done = 0
    height = _ROWS * max(1, math.ceil(views.projections.shape[2] / _LEVELS[-1][0]))
    rows = busiest_rows(views.projections, height)
    looked = views.select(_spread(views.energy), rows)
    scaled = looked.projections * _strengths(looked)[looked.energy][:, None, None]
    measured = np.ones(scaled.shape[1:], np.bool_) if looked.weight is None else (looked.weight > 0).mean(0) > 0.5
    for columns, rounds in _LEVELS:
        factor = max(1, math.ceil(scaled.shape[2] / columns))
        factor = min(factor, scaled.shape[1])
        data, geometry = bin_views(scaled.astype(np.float32), factor), looked.geometry.binned(factor)
        known = bin_views(measured[None].astype(np.float32), factor)[0] > 0.5
        for _ in range(rounds):
            moves = displacements(data, geometry, looked.energy, known, moves, 1, optics=True)
            done += 1
            progress(done, STEPS)
        if factor == 1:
            break
    assert moves is not None
    still = [Displacement()] * len(moves)
    before, after = (judge(data, geometry, looked.energy, known, at).overall for at in (still, moves))
    progress(STEPS, STEPS)
    if not after < _HELPS * before:
        return views, tuple(still)
    least = 2 * _MOVES / views.projections.shape[2]
    moves_kept = [move if abs(move.magnification - 1) > least else replace(move, magnification=1.0) for move in moves]
    seen = _unmagnified(views, moves_kept, (rows.start + looked.geometry.axis_row, views.geometry.axis_col))
    return replace(seen, geometry=displaced(views.geometry, views.energy, moves_kept)), tuple(moves_kept)


def _unmagnified(views: EnergyViews, moves: Sequence[Displacement], centre: tuple[float, float]) -> EnergyViews:
    """All views at the magnification of the reference; pixels that were not measured weigh nothing."""
    if all(move.magnification == 1 for move in moves):
        return views
    data, weight = views.projections.copy(), np.ones_like(views.projections)
    if views.weight is not None:
        weight *= views.weight
        data[weight == 0] = 0
    for energy, move in enumerate(moves):
        if move.magnification != 1:
            own = views.energy == energy
            there = measured_unmagnified(weight[own] > 0, move.magnification, centre)
            data[own] = unmagnified(data[own], move.magnification, centre)
            weight[own] = there * unmagnified(weight[own], move.magnification, centre, order=1)
    return replace(views, projections=data, weight=weight)


def _strengths(views: EnergyViews) -> F64:
    """[energy] factor that makes the mean of its views that of the first energy's."""
    energies = range(len(views.cross_sections))
    means = np.array([views.projections[views.energy == e].mean(dtype=np.float64) for e in energies])
    return np.divide(means[0], means, out=np.ones_like(means), where=means > 0)


def _spread(energy: NDArray[np.intp]) -> NDArray[np.intp]:
    """Indices of views that are evenly spread, at most `_VIEWS` of each energy."""
    own = (np.flatnonzero(energy == e) for e in np.unique(energy))
    return np.sort(np.concatenate([spread(at, _VIEWS) for at in own]))
