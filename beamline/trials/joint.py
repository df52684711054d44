"""Trials of views that show more than one volume, in time or at several energies: by parts, or in one fit of all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from beamline.trials.data import Data
from beamline.trials.trial import Trial
from beamline.trials.varied import MOTION
from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.energy_fit import EnergyViews
from recon.series import TimedViews, fit_series
from recon.share_fit import fit_share
from recon.spectral import fit_materials
from recon.warm_up import toy_of

VolumeAt = Callable[[float], F32]
"""The volume [z, y, x] that a view of this time, or of the energy of this number, shows."""
PartFit = Callable[[F32, Geometry, F32 | None], F32]
"""The volume of some views, by line integrals [view, row, col], geometry, and weights of rays."""
_TOYS = 12  # copies of the four views of a toy


def jointly(trial: Trial, data: Data, seed: int, **given: Any) -> VolumeAt:
    """The volumes of `recon.fit_series` or `recon.fit_materials`.

    Args:
        given: other arguments of these.

    Raises:
        ValueError: too few views, or settings that there are not.
    """
    n = data.geometry.n_views
    weights = None if data.weights is None else data.weights[:n]
    shown = data.projections if weights is None else np.where(weights > 0, data.projections, np.float32(0))
    if data.sections is None:
        timed = TimedViews(shown, data.geometry, data.shown[:n], weights)
        motion, _ = MOTION[str(trial.settings["motion"])]
        return fit_series(timed, int(trial.settings["volumes"] or 0), motion=motion, seed=seed, **given).at
    sections, grid = data.sections, Grid.matching(data.geometry)
    views = EnergyViews(shown, data.geometry, data.shown[:n].astype(np.intp), sections, weights)
    made = fit_materials(views, grid, seed=seed, **given)
    if trial.settings.get("share"):
        made = fit_share(views, made, (data.states[0], data.states[1]))
    return lambda energy: np.tensordot(sections[int(energy)].astype(np.float32), made.densities, 1)


def by_parts(trial: Trial, data: Data, fit: PartFit) -> VolumeAt:
    """A volume of each part of the views: of each energy, or of so long, with linear change between their middles."""
    n = data.geometry.n_views
    own = data.shown[:n]
    if data.sections is None:
        edges = np.arange(trial.parts + 1) * n // trial.parts
        in_order = np.argsort(own, kind="stable")
        parts = [np.sort(in_order[first:stop]) for first, stop in pairwise(edges.tolist())]
    else:
        parts = [np.flatnonzero(own == energy) for energy in range(trial.parts)]
    weights = None if data.weights is None else data.weights[:n]
    volumes = np.stack([
        fit(data.projections[at], data.geometry.select(at), None if weights is None else weights[at]) for at in parts
    ])  # fmt: skip
    middles = np.array([own[at].mean() for at in parts])
    return lambda view: np.tensordot(_linear(view, middles), volumes, 1)


def _linear(at: float, knots: F64) -> F32:
    return np.array([np.interp(at, knots, row) for row in np.eye(knots.size)], np.float32)


def toy_like(data_geometry: Geometry, trial: Trial) -> Data:
    """Small views on which the same kernels run, with times or energies as the trial needs them."""
    lines, views = toy_of(data_geometry)
    many = views
    for _ in range(_TOYS - 1):
        many = many.followed_by(views)
    numbers = np.arange(many.n_views, dtype=np.float64)
    joint = Data(np.tile(lines, (_TOYS, 1, 1)), many, None, None, of_view=numbers)
    if trial.method != "materials":
        return joint
    return replace(joint, of_view=numbers % 2, sections=np.array([[1, 0.5], [0.5, 1]]), states=(0, 1))
