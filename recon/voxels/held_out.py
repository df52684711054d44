"""Views held out: what volumes of the others leave of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64
from recon.base.empirical import ONE_IN
from recon.base.geometry import Geometry
from recon.base.method import Method, ReconProblem, RunControl
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.voxels.choice import TRIALS
from recon.voxels.projector import Projector, projection_lines
from recon.voxels.resolution import ViewResolution, at_voxel_resolution
from recon.voxels.voxel_problem import whitened

TRIAL_SWEEPS = 20
"""Sweeps of total variation in a trial, and by default of `FistaTv`: a trial that gets less far than its volume prefers
a heavier weight, one that gets further a lighter one."""

LEAST_VIEWS = 2 * ONE_IN

TRIAL_ROWS = 16
"""Rows of the slab that trials of a prior see."""

CHOICE_SWEEPS = TRIALS * TRIAL_SWEEPS
"""Sweeps of trials for a weight, as a rule."""


def unseen_residuals(model: F32, views: F32, weight: F32 | None, resolution: ViewResolution) -> F64:
    """[view] root mean square residual of a volume in each view, at the resolution of voxels.

    The truth leaves the noise alone, by that; of views as measured it would leave more than a sharper volume does.

    Args:
        model: [view, col, row], the projection of the volume by a `Projector` of this resolution.
        views: line integrals as measured, less what no voxel can explain. Values that are not finite do not count.
        weight: of the rays; None: one for all.

    Returns:
        One value for each view of which a ray counts; [inf] where there is none.
    """
    counts = np.isfinite(views) if weight is None else np.isfinite(views) & (weight > 0)
    left = whitened(model - at_voxel_resolution(views, resolution, counts), weight)
    counting = [view[there] for view, there in zip(left, counts, strict=True) if there.any()]
    if not counting:
        return np.full(1, np.inf)
    return np.sqrt(np.array([np.mean(np.square(view, dtype=np.float64)) for view in counting]))


def residuals_of(volume: Volume, views: Views) -> F64:
    """`unseen_residuals` of a volume in views without weights."""
    projector = Projector(views.geometry, volume.grid)
    model = projection_lines(projector.forward(volume.data))
    return unseen_residuals(model, projection_lines(views.data), None, projector.resolution)


def choice_sweeps(geometry: Geometry) -> float:
    """Cost of `choose_weight` in sweeps over all rows: four trials as a rule; 0 if no view is held out."""
    share = min(1.0, TRIAL_ROWS / geometry.detector_shape[0]) * (1 - 1 / ONE_IN)
    return CHOICE_SWEEPS * share if geometry.n_views >= LEAST_VIEWS else 0.0


def predicted_views(
    method: Method, data: F32, geometry: Geometry, grid: Grid, known: NDArray[Any] | None, one_in: int
) -> tuple[NDArray[np.intp], F32]:
    """Numbers of the held-out views, one in so many by angle, and their images [view, row, col] predicted by the
    others.

    Args:
        method: that makes the volume.
        data: line integrals [view, row, col].
        known: [row, col] or [view, row, col] weights of pixels; None: one for all.
    """
    order = np.argsort(np.mod(geometry.angles, 2 * np.pi), kind="stable")
    unseen = order[1::one_in]
    seen = np.setdiff1d(order, unseen)
    weights = None if known is None else np.broadcast_to(known, data.shape)[seen].astype(np.float32)
    views = Views(data[seen], geometry.select(seen), weights)
    volume = method.run(ReconProblem(views, grid), RunControl()).volume
    return unseen, Projector(geometry.select(unseen), grid).forward(volume.data)
