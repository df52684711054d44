"""Views held out: what volumes of the others leave of them."""

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
"""Sweeps of total variation in the trial of a finish, and of `EarlyTv`: a trial that gets less far than its volume
prefers a heavier weight, one that gets further a lighter one."""

LEAST_VIEWS = 2 * ONE_IN

TRIAL_ROWS = 16
"""Rows of the slab that trials of a prior see."""

CHOICE_SWEEPS, EARLY_CHOICE_SWEEPS = TRIALS * USUAL_SWEEPS, TRIALS * TRIAL_SWEEPS
"""Sweeps of trials for a weight, as a rule: until volumes stand still, and of a finish."""


def choice_sweeps(geometry: Geometry, early: bool = False) -> float:
    """Cost of `choose_weight` in sweeps over all rows: four trials as a rule; 0 if no view is held out.

    Args:
        early: of a finish.
    """
    share = min(1.0, TRIAL_ROWS / geometry.detector_shape[0]) * (1 - 1 / ONE_IN)
    sweeps = EARLY_CHOICE_SWEEPS if early else CHOICE_SWEEPS
    return sweeps * share if geometry.n_views >= LEAST_VIEWS else 0.0


def predicted_views(
    method: Method, views: Views, grid: Grid, one_in: int, decide: Decisions | None = None
) -> tuple[NDArray[np.intp], F32]:
    """Numbers of the held-out views, and their images [view, row, col] predicted by a volume of the others.

    They are those of `split_views`, but for a turn whatever the axis: geometries are compared by the same views.
    """
    seen, unseen = split_views(views.geometry, one_in, 2 * np.pi)
    volume = method.run(ReconProblem(views.select(seen), grid), RunControl(decide=decide)).volume
    return unseen, Projector(views.geometry.select(unseen), grid).forward(volume.data)
