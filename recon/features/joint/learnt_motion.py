"""The motion of a sample during the scan, estimated from coarse to fine voxels.

If a sample only moves, one displaced volume explains all projections. So volume and motion are improved alternately.
The first voxels are so coarse that the motion is only a few voxels long.
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

_COARSEST = 12  # smallest number of voxels across at the first level; at each following level, voxels are half as wide
# up to this many pixels across, the last level has one voxel per pixel; with more pixels, one voxel per two pixels
_FINE = 96
_ALTERNATIONS = 6, 4, 2  # number of alternations at each level; further levels have the last number
SWEEPS_OF_TURN = 6  # iterations in an alternation; they continue from the volume of the previous one
_KNOTS, _CONTROLS = 3, 3  # number of control points of the motion: in time, and along each axis
_WEIGHT_FACTOR = 2.0  # factor on the weight of total variation, because one volume for all times has less detail
JUDGED, JUDGED_SWEEPS = 48, 24  # voxels across of the test volumes that decide about motion, and their iterations
_BLOCKS, _ONE_BLOCK_IN = 32, 4  # blocks in time; one in this many is held out (eight blocks)


def levels(cols: int) -> list[tuple[int, int]]:
    """Voxel size in pixels and number of alternations for each resolution level, if the detector has `cols` columns."""
    last = 1 if cols <= _FINE else 2
    widths = [last]
    while cols // (2 * widths[0]) >= _COARSEST:
        widths.insert(0, 2 * widths[0])
    return [(width, _ALTERNATIONS[min(n, len(_ALTERNATIONS) - 1)]) for n, width in enumerate(widths)]


class OfMoments(NamedTuple):
    """Projections of a changing sample, each assigned to a moment.

    Attributes:
        views: the projections. Here, each `energy` is a moment, and each material is a volume at one time (a knot).
        times: [moment] time within the scan, 0 to 1.
        weights: weights of total variation for the components of the densities.
    """

    views: EnergyViews
    times: F64
    weights: F64


def unseen_squares(
    coarse: OfMoments, fine: OfMoments, go_on: Callable[[int, float], bool], stop: Callable[[], bool]
) -> F64 | None:
    """Squared residual of held-out projections for volumes without and with motion, [2, block]; None if the computation
    was stopped.

    The residual is divided by the mean of the squared projections.

    Blocks of successive projections are held out. If angles rise with time, a single held-out projection could be
    predicted from the projections before and after it, even if the sample moves and the volumes do not. The motion is
    estimated from the other projections in `coarse` moments. Volumes of coarse voxels are fitted to them in `fine`
    moments, within which the sample hardly moves.

    Args:
        coarse, fine: the same projections, in few and in many moments.
        go_on, stop: as in `learnt_motion`.
    """
    block = fine.views.energy * _BLOCKS // len(fine.views.cross_sections)
    held_out = block % _ONE_BLOCK_IN == _ONE_BLOCK_IN // 2
    used, remaining = np.flatnonzero(~held_out), 2 * JUDGED_SWEEPS
    fitted = coarse._replace(views=coarse.views.select(used, slice(None)))
    motion = learnt_motion(fitted, lambda sweep, residual: go_on(sweep - remaining, residual), stop)
    if motion is None:
        return None
    views = _binned(fine.views, round(fine.views.geometry.detector_shape[1] / JUDGED))
    grid, squares_of_fits = Grid.matching(views.geometry), []
    nz, ny, nx = grid.shape
    for tested_motion in (None, motion.on((ny, nx, nz), fine.times)):
        fit = EnergyFit(views.select(used, slice(None)), grid, np.random.default_rng(0), tested_motion, stop)
        for residual in fit.sweeps(fine.weights, JUDGED_SWEEPS):
            remaining -= 1
            if not go_on(-remaining, residual):
                return None
        if stop():
            return None
        squares_of_fits.append(_residual_squares(views, fit.densities(), tested_motion, grid))
    numbers = np.unique(block[held_out])
    of_blocks = np.array([[squares[block == number].sum() for number in numbers] for squares in squares_of_fits])
    squares_of_data = (
        _residual_squares(views, np.zeros_like(fit.densities()), None, grid)[held_out].sum() / numbers.size
    )
    return of_blocks / (squares_of_data or 1.0)


def _residual_squares(views: EnergyViews, densities: F32, motion: Motion | None, grid: Grid) -> F64:
    """[view] weighted squared residual for densities [knot, z, y, x]."""
    projector, data = Projector(views.geometry, grid), projection_lines(views.projections)
    weight = None if views.weight is None else projection_lines(views.weight)
    squares = np.empty(len(data))
    for view, moment in enumerate(views.energy.tolist()):
        density = volume_lines(np.tensordot(views.cross_sections[moment].astype(np.float32), densities, 1))
        image = projector.subset([view]).forward_lines(moved(density, None if motion is None else motion.at(moment)))
        difference = data[view : view + 1] - image
        squares[view] = np.vdot(difference, weighed(difference, None if weight is None else weight[view : view + 1]))
    return squares


def learnt_motion(
    of_moments: OfMoments, go_on: Callable[[int, float], bool], stop: Callable[[], bool]
) -> Motion | None:
    """Estimate the motion on the voxels of `Grid.matching`; None if the computation was stopped.

    Args:
        go_on: called with (-n, residual) after each iteration; n is the number of remaining iterations. False ends the
            computation.
        stop: called many times within an iteration; True ends the computation.
    """
    views, times, weights = of_moments
    cols = views.geometry.detector_shape[1]
    one_material = replace(views, cross_sections=np.ones((times.size, 1)))
    motion, remaining = None, SWEEPS_OF_TURN * sum(alternations for _, alternations in levels(cols))
    for binning, alternations in levels(cols):
        binned = _binned(one_material, binning)
        grid = Grid.matching(binned.geometry)
        nz, ny, nx = grid.shape
        motion = (
            Motion.none((ny, nx, nz), times, _KNOTS, _CONTROLS) if motion is None else motion.on((ny, nx, nz), times)
        )
        fit, energies = EnergyFit(binned, grid, np.random.default_rng(0), motion, stop), _seen(binned, grid)
        for _ in range(alternations):
            for residual in fit.sweeps(np.full(1, _WEIGHT_FACTOR * weights.max()), SWEEPS_OF_TURN):
                remaining -= 1
                if not go_on(-remaining, residual):
                    return None
            if stop():
                return None
            motion = improved(motion, energies, fit.image)
            fit.move(motion)
    assert motion is not None
    nz, ny, nx = Grid.matching(views.geometry).shape
    return motion.on((ny, nx, nz), times)


def _binned(views: EnergyViews, n: int) -> EnergyViews:
    """Projections binned by n x n pixels (mean values and mean weights)."""
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
        Seen(int(e), whole.subset(indices), data[indices], None if weight is None else weight[indices])
        for e in np.unique(views.energy)
        for indices in [np.flatnonzero(views.energy == e)]
    ]


_LEVELS = ((64, 2), (160, 4), (320, 2))  # levels: largest number of columns, and number of volumes from all projections
_ROWS = 32  # number of binned rows examined
_VIEWS = 60  # number of projections examined per energy
# columns by which a magnification moves the outermost pixel; a smaller one is ignored, so that nothing is interpolated
_LEAST_MAGNIFICATION_PX = 0.1
_LARGEST_DEVIATION_RATIO = 0.995  # a registration must lower the deviation of held-out projections to this share
STEPS = sum(rounds for _, rounds in _LEVELS) + 1


def register_energies(
    views: EnergyViews, progress: Callable[[int, int], None] = lambda n, total: None
) -> tuple[EnergyViews, tuple[Displacement, ...]]:
    """Align the scans at all energies: correct for the position of the sample and for the optics (parallel beam).

    The energy with the most projections is the reference. The volume at the reference energy, scaled by the mean
    absorption at another energy, predicts the projections at that energy. Six parameters describe how measured
    projections differ from predicted ones (see `recon.voxels.displacement`): the sample is shifted along x, y and z and
    rotated about the axis; the image is shifted along the rows and magnified. The six parameters are found from the
    edges in the projections, so it does not matter if a material absorbs differently at two energies.

    Returns:
        The projections (interpolated if their magnification differs), and the displacement at each energy. All
        displacements are 0 if the displacements found do not improve the prediction of held-out projections.

    Raises:
        ValueError: the beam is a cone: a shift of the sample then changes the directions of the rays through the
            sample.
    """
    check_arguments(register_energies, locals())
    moves: list[Displacement] | None = None
    done = 0
    height = _ROWS * max(1, math.ceil(views.projections.shape[2] / _LEVELS[-1][0]))
    rows = busiest_rows(views.projections, height)
    examined = views.select(_spread(views.energy), rows)
    scaled = examined.projections * _strengths(examined)[examined.energy][:, None, None]
    measured = np.ones(scaled.shape[1:], np.bool_) if examined.weight is None else (examined.weight > 0).mean(0) > 0.5
    for columns, rounds in _LEVELS:
        factor = max(1, math.ceil(scaled.shape[2] / columns))
        factor = min(factor, scaled.shape[1])
        data, geometry = bin_views(scaled.astype(np.float32), factor), examined.geometry.binned(factor)
        known = bin_views(measured[None].astype(np.float32), factor)[0] > 0.5
        for _ in range(rounds):
            moves = displacements(data, geometry, examined.energy, known, moves, 1, optics=True)
            done += 1
            progress(done, STEPS)
        if factor == 1:
            break
    assert moves is not None
    no_moves = [Displacement()] * len(moves)
    deviation_without, deviation_with = (
        judge(data, geometry, examined.energy, known, moves).overall for moves in (no_moves, moves)
    )
    progress(STEPS, STEPS)
    if not deviation_with < _LARGEST_DEVIATION_RATIO * deviation_without:
        return views, tuple(no_moves)
    least_change = 2 * _LEAST_MAGNIFICATION_PX / views.projections.shape[2]
    moves_kept = [
        move if abs(move.magnification - 1) > least_change else replace(move, magnification=1.0) for move in moves
    ]
    unmagnified = _unmagnified(views, moves_kept, (rows.start + examined.geometry.axis_row, views.geometry.axis_col))
    return replace(unmagnified, geometry=displaced(views.geometry, views.energy, moves_kept)), tuple(moves_kept)


def _unmagnified(views: EnergyViews, moves: Sequence[Displacement], centre: tuple[float, float]) -> EnergyViews:
    """All projections at the magnification of the reference; pixels without data get weight 0."""
    if all(move.magnification == 1 for move in moves):
        return views
    data, weight = views.projections.copy(), np.ones_like(views.projections)
    if views.weight is not None:
        weight *= views.weight
        data[weight == 0] = 0
    for energy, move in enumerate(moves):
        if move.magnification != 1:
            own = views.energy == energy
            measured = measured_unmagnified(weight[own] > 0, move.magnification, centre)
            data[own] = unmagnified(data[own], move.magnification, centre)
            weight[own] = measured * unmagnified(weight[own], move.magnification, centre, order=1)
    return replace(views, projections=data, weight=weight)


def _strengths(views: EnergyViews) -> F64:
    """[energy] factor that makes the mean of its projections equal to that of the first energy."""
    energies = range(len(views.cross_sections))
    means = np.array([views.projections[views.energy == e].mean(dtype=np.float64) for e in energies])
    return np.divide(means[0], means, out=np.ones_like(means), where=means > 0)


def _spread(energy: NDArray[np.intp]) -> NDArray[np.intp]:
    """Indices of evenly spread projections, at most `_VIEWS` per energy."""
    own = (np.flatnonzero(energy == e) for e in np.unique(energy))
    return np.sort(np.concatenate([spread(own_views, _VIEWS) for own_views in own]))
