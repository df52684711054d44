"""Registration: where the sample stood, and how the optics magnified, in scans at several energies."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F64, bin_views
from recon.base.declared_types import check_arguments
from recon.base.views import spread
from recon.features.joint.energy_fit import EnergyViews
from recon.voxels.displacement import Displacement, displaced, displacements, judge, measured_unmagnified, unmagnified
from recon.voxels.field_edges import busiest_rows

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
