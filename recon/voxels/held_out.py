"""Held-out projections: how well volumes from the other projections predict them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32
from recon.base.decisions import Decisions
from recon.base.empirical import ONE_IN
from recon.base.geometry import Geometry
from recon.base.method import Method, ReconProblem, RunControl
from recon.base.view_data import Views, split_views
from recon.base.volume import Grid
from recon.voxels.choice import TRIALS
from recon.voxels.projector import Projector
from recon.voxels.standstill import USUAL_SWEEPS

TRIAL_SWEEPS = 20
"""Iterations of total variation in the test for a voxel refinement, and of `EarlyTv`.

A test with fewer iterations than its volume prefers a larger weight, a test with more iterations a smaller one.
"""

LEAST_VIEWS = 2 * ONE_IN

TRIAL_ROWS = 16
"""Number of rows in the tests that choose a prior."""

CHOICE_SWEEPS, EARLY_CHOICE_SWEEPS = TRIALS * USUAL_SWEEPS, TRIALS * TRIAL_SWEEPS
"""Usual number of iterations to choose a weight: until the volumes converge, and for a voxel refinement."""


def choice_sweeps(geometry: Geometry, early: bool = False) -> float:
    """Cost of `choose_weight` in iterations over all rows: usually four tests; 0 if no projection is held out.

    Args:
        early: True: the tests for a voxel refinement.
    """
    share = min(1.0, TRIAL_ROWS / geometry.detector_shape[0]) * (1 - 1 / ONE_IN)
    sweeps = EARLY_CHOICE_SWEEPS if early else CHOICE_SWEEPS
    return sweeps * share if geometry.n_views >= LEAST_VIEWS else 0.0


def predicted_views(
    method: Method, views: Views, grid: Grid, one_in: int, decide: Decisions | None = None
) -> tuple[NDArray[np.intp], F32]:
    """Numbers of the held-out projections, and their images [view, row, col] predicted by a volume from the others.

    They are chosen as in `split_views`, but with a period of 360° for every geometry, so that geometries are compared
    with the same projections.
    """
    fitted, held_out = split_views(views.geometry, one_in, 2 * np.pi)
    volume = method.run(ReconProblem(views.select(fitted), grid), RunControl(decide=decide)).volume
    return held_out, Projector(views.geometry.select(held_out), grid).forward(volume.data)
