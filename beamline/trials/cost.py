"""Cost: what a trial takes in sweeps, projections of all views and their adjoints, and what a sweep takes here."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from beamline.trials.trial import Trial
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.run_time import Extent, sample
from recon.splatting.fit_method import FitMethod
from recon.splatting.initialise import default_count
from recon.voxels.projector import Projector

_SWEEPS: Mapping[str, tuple[float, float]] = {
    "fbp": (1.0, 0.0), "sirt": (2.0, 1.0), "sart": (2.0, 6.0), "cgls": (1.0, 1.0), "mlem": (2.0, 1.2),
    "osem": (2.0, 1.5), "asd-pocs": (2.0, 10.0), "fista-tv": (200.0, 2.0), "os-sirt-tv": (200.0, 1.0),
    "pnp-dct": (450.0, 3.0),
}  # fmt: skip
"""Of each method before its first iteration, most of them of trials on `_TRIED` rows, and of each iteration; measured
on 60 views of 16 x 128 pixels."""
_STEP = 55.0  # sweeps of as many voxels and views as the pixels that all Gaussians cover in a step of a fit
_FINISH = 120.0  # sweeps on voxels after a fit, with the trials of their weight
_TRIED = 16  # rows that trials of a weight see
_SMALL = 48, 160, 16  # views, columns and rows of the sweep that is measured


def sweep_seconds(geometry: Geometry, now: Callable[[], float]) -> float:
    """s of a projection of all views and its adjoint, from a small one through the same beam."""
    extent = Extent(geometry, [1])
    rows = min(geometry.detector_shape[0], _SMALL[2])
    cols = min(extent.cols, round(_SMALL[1] * math.sqrt(_SMALL[2] / rows)))  # as many voxels where rows are few
    small, lines = sample(extent, min(geometry.n_views, _SMALL[0]), cols, rows)
    projector = Projector(small, Grid.matching(small))
    times = []
    for _ in range(3):  # the first one loads kernels
        begin = now()
        projector.forward(projector.adjoint(lines))
        times.append(now() - begin)
    return min(times) * _rays_and_voxels(geometry) / _rays_and_voxels(small)


def expected_seconds(trial: Trial, geometry: Geometry, sweep: float = 1.0) -> float | None:
    """s of processor time of a trial; None: not known before it is tried.

    Args:
        sweep: s of one sweep of all views, see `sweep_seconds`; 1: in sweeps.
    """
    if trial.joint is not None:
        return None
    method, share = trial.build(), trial.views / geometry.n_views / trial.binning**3
    before, each = _SWEEPS.get(trial.method, (0.0, 1.0))
    if isinstance(method, FitMethod):
        grid = Grid.matching(geometry)
        voxels = grid.shape[0] * grid.shape[1] * grid.shape[2] / trial.binning**3
        gaussians = method.gaussians if isinstance(method.gaussians, int) else default_count(geometry, grid.voxel_size)
        pixels = voxels ** (2 / 3) * gaussians ** (1 / 3)
        before, each = _FINISH, _STEP * pixels / (voxels * trial.views)
        length = method.planned_steps or 0
    elif hasattr(method, "iterations"):
        length = method.iterations
        if length is None and hasattr(method, "most_iterations"):
            length = method.most_iterations
    elif method.traits.direct:
        length = 0
    else:
        return None
    if trial.seconds_asked is not None and not method.traits.own_length:
        return trial.seconds_asked
    tried = min(1.0, _TRIED * trial.binning / geometry.detector_shape[0])
    seconds = sweep * share * (before * tried + length * each) * (2 if trial.halves else 1)
    return seconds if trial.seconds_asked is None else min(seconds, trial.seconds_asked)


def _rays_and_voxels(geometry: Geometry) -> float:
    rows, across, along = Grid.matching(geometry).shape
    return float(geometry.n_views * rows * across * along)
