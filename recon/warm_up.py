"""warm_up: compile every kernel of a fit on a toy, so that compilation never falls into a fit's time."""

from __future__ import annotations

import numpy as np

from recon import fit
from recon.backend import backend_for
from recon.density_control import DensityPolicy
from recon.geometry import Geometry
from recon.initialise import place
from recon.problem import Loss
from recon.volume import Grid


def warm_up(device: str = "cpu", loss: Loss = "l1") -> None:
    """Fit a toy for three steps: some 12 s on a machine that has never done it, a fraction of a second afterwards.

    numba keeps what it compiles beside the package (or in the user's cache folder), once for each kind of processor.

    Args:
        device: that the fit will compute on.
        loss: of the fit; a GPU's kernels are compiled for one.
    """
    backend = backend_for(device)
    views = Geometry.parallel([0.0, 0.8, 1.6, 2.4], (12, 16))
    u = np.arange(16) - views.axis_col
    data = np.broadcast_to(np.exp(-(u**2) / 18).astype(np.float32), (4, 12, 16))
    grid = Grid.matching(views)
    settings = fit.FitSettings(loss=loss, policy=DensityPolicy(start=0, every=1, threshold=0.0))
    placed = place(data, views, grid, 50, np.random.default_rng(0))
    problem = fit.problem_of(data, views, grid, placed.density_unit, settings, backend)
    state = fit.init(placed, 0, fit.growth(settings), backend)
    fit.run(state, problem, settings, 3)
    fit.volume_of(state, grid, settings, backend)
