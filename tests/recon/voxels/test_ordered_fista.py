"""Ordered subsets of FISTA: equal slices stay equal, and the step is safe for every subset."""

from __future__ import annotations

import numpy as np

from recon.base.decisions import GoesOn
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.ordered_fista import Subsets, ordered_fista
from recon.voxels.priors import TvWeight, tv_prox
from recon.voxels.projector import Projector
from recon.voxels.voxel_problem import VoxelProblem

VIEWS = Geometry.parallel(np.linspace(0, np.pi, 48, endpoint=False), (4, 48), pixel_pitch=1.0)
_Y, _X, _ = np.indices((48, 48, 4)) - 23.5
DISC = (np.hypot(_X, _Y) < 12).astype(np.float32)


def test_equal_rows_stay_equal_slices() -> None:
    """A heavy weight, three dual steps and momentum do not amplify differences between slices that rounding made."""
    views = Geometry.parallel(VIEWS.angles[::2], (9, 48), pixel_pitch=1.0)
    projector = Projector(views, Grid.matching(views))
    data = projector.forward_lines(np.repeat(DISC[:, :, :1], 9, axis=2))
    problem = VoxelProblem(projector, data, None, True, np.random.default_rng(1), GoesOn())
    start = np.full((48, 48, 9), 0.1, np.float32)
    volume = ordered_fista(problem, start, TvWeight(500.0), Subsets.of(problem, 2), sweeps=30, prox=tv_prox(problem, 3))
    assert np.ptp(volume, axis=2).max() < 1e-3


def test_the_step_is_safe_for_the_subset_that_weighs_most() -> None:
    """1 / step is at least the largest eigenvalue of AᵀWA of each subset, by a dense matrix in float64."""
    views = Geometry.parallel(np.linspace(0, np.pi, 24, endpoint=False), (1, 9))
    projector = Projector(views, Grid.matching(views))
    data = projector.forward_lines(np.ones((9, 9, 1), np.float32))
    for weight in (None, np.random.default_rng(0).uniform(0.1, 3, data.shape).astype(np.float32)):
        made = Subsets.of(VoxelProblem(projector, data, weight, True, np.random.default_rng(1), GoesOn()), 2)
        units = np.eye(81, dtype=np.float32).reshape(81, 9, 9, 1)
        for some, part in zip(made.views, made.projectors, strict=True):
            a = np.stack([part.forward_lines(unit).ravel() for unit in units], 1).astype(np.float64)
            w = np.ones(len(a)) if weight is None else weight[some].ravel().astype(np.float64)
            largest = np.linalg.eigvalsh(a.T @ (w[:, None] * a))[-1]
            heaviest = weight is None or weight[some].sum() == max(weight[v].sum() for v in made.views)
            assert not heaviest or largest * (1 - 1e-5) <= 1 / made.step < 1.2 * largest
