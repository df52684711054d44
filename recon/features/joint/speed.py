"""How fast this machine sweeps several volumes: views, and voxels x views; at rest, moving or of energies."""

from __future__ import annotations

import math

import numpy as np

from recon.base.volume import Grid
from recon.features.joint.energy_fit import EnergyFit, EnergyViews
from recon.features.joint.motion import Motion
from recon.features.joint.series import MOMENTS, TimedViews, of_moments
from recon.machine_speed import SizedRun, views_of_disc


def timed(which: str) -> tuple[SizedRun, ...]:
    """Sweeps of so many volumes, as of "moving 3"."""
    how, volumes = which.split()
    if how == "energies":
        return _by_energy(int(volumes), 32), _by_energy(int(volumes), 80)
    return _serial(int(volumes), how == "moving", 32), _serial(int(volumes), how == "moving", 80)


def _by_energy(materials: int, cols: int) -> SizedRun:
    """Of materials at as many energies."""
    geometry, _, data = views_of_disc("parallel", 16, cols, 12 * materials)
    energies = np.arange(geometry.n_views) * materials // geometry.n_views
    views = EnergyViews(data, geometry, energies, np.eye(materials) + 0.5)
    return _timed_sweeps(EnergyFit(views, Grid.matching(geometry), np.random.default_rng(0)), materials)


def _serial(knots: int, moves: bool, cols: int) -> SizedRun:
    """Of volumes in time."""
    geometry, _, data = views_of_disc("parallel", 16, cols, 12 * knots)
    grid, times = Grid.matching(geometry), np.arange(geometry.n_views, dtype=np.float64)
    views, past = of_moments(TimedViews(data, geometry, times), np.linspace(0, times[-1], knots), MOMENTS * (knots - 1))
    nz, ny, nx = grid.shape
    fit = EnergyFit(views, grid, np.random.default_rng(0), Motion.none((ny, nx, nz), past, 3, 3) if moves else None)
    return _timed_sweeps(fit, knots)


def _timed_sweeps(fit: EnergyFit, volumes: int) -> SizedRun:
    n = float(fit.views.geometry.n_views)
    return SizedRun(n, n * math.prod(fit.grid.shape), lambda: list(fit.sweeps(np.full(volumes, 0.1), 1)))
