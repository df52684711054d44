"""Registration of energies: where the sample stood in the scan of each energy, from the views themselves."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F64
from recon.base.binning import bin_views
from recon.energy_fit import EnergyViews
from recon.voxels.displacement import Displacement, displaced, displacements, judge
from recon.voxels.held_out_weight import busiest_rows

_LEVELS = ((64, 2), (160, 4), (320, 2))  # columns, at most, and volumes of all views
_ROWS = 32  # binned rows looked at
_VIEWS = 60  # looked at, of each energy
_HELPS = 0.995  # of the deviation of views held out: a registration that leaves more is none
STEPS = sum(rounds for _, rounds in _LEVELS) + 1


def register_energies(
    views: EnergyViews, progress: Callable[[int, int], None] = lambda n, most: None
) -> tuple[EnergyViews, tuple[Displacement, ...]]:
    """Correct the geometry of the views by where the sample stood in the scan of each energy; a parallel beam.

    The energy with the most views is the reference. A volume of it predicts the others, each scaled by what it absorbs
    in the mean. A shift along x, y and z and a turn about the axis explain the differences (see
    `recon.voxels.displacement`). Edges tell it, so a material that absorbs unlike at two energies does no harm.

    Returns:
        The views, and the displacement of each energy. None is displaced where that predicts views held out no better.

    Raises:
        ValueError: a cone, whose rays a shift of the sample turns.
    """
    moves: list[Displacement] | None = None
    done = 0
    height = _ROWS * max(1, math.ceil(views.projections.shape[2] / _LEVELS[-1][0]))
    looked = views.select(_spread(views.energy), busiest_rows(views.projections, height))
    scaled = looked.projections * _strengths(looked)[looked.energy][:, None, None]
    measured = np.ones(scaled.shape[1:], np.bool_) if looked.weight is None else (looked.weight > 0).mean(0) > 0.5
    for columns, rounds in _LEVELS:
        factor = max(1, math.ceil(scaled.shape[2] / columns))
        factor = min(factor, scaled.shape[1])
        data, geometry = bin_views(scaled.astype(np.float32), factor), looked.geometry.binned(factor)
        known = bin_views(measured[None].astype(np.float32), factor)[0] > 0.5
        for _ in range(rounds):
            moves = displacements(data, geometry, looked.energy, known, moves, 1)
            done += 1
            progress(done, STEPS)
        if factor == 1:
            break
    assert moves is not None
    still = [Displacement()] * len(moves)
    before, after = (judge(data, geometry, looked.energy, known, at).overall for at in (still, moves))
    progress(STEPS, STEPS)
    found = moves if after < _HELPS * before else still
    return replace(views, geometry=displaced(views.geometry, views.energy, found)), tuple(found)


def _strengths(views: EnergyViews) -> F64:
    """[energy] factor that makes the mean of its views that of the first energy's."""
    energies = range(len(views.cross_sections))
    means = np.array([views.projections[views.energy == e].mean(dtype=np.float64) for e in energies])
    return np.divide(means[0], means, out=np.ones_like(means), where=means > 0)


def _spread(energy: NDArray[np.intp]) -> NDArray[np.intp]:
    """Indices of views that are evenly spread, at most `_VIEWS` of each energy."""
    own = (np.flatnonzero(energy == e) for e in np.unique(energy))
    return np.sort(np.concatenate([at[np.unique(np.linspace(0, at.size - 1, _VIEWS).astype(int))] for at in own]))
