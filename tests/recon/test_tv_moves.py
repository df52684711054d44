"""Total variation moves centres as finite differences predict; the published gradient is too small."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.kernel import Truncation
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.splatting import optimise as fit
from recon.splatting.gaussians import Gaussians
from recon.splatting.settings import FitSettings
from tests.recon.helpers import in_double
from tests.recon.kernels.reference import on_grid as voxelize
from tests.recon.kernels.reference import project, total_variation

VOXEL = 2 / 256  # of the published field, -1 to 1 in 256 voxels
VIEWS = Geometry.parallel([0.2, 1.1, 2.3], (20, 24), pixel_pitch=VOXEL)
GRID = Grid.matching(VIEWS)
# So much smoothness that nothing else counts, on a box that is the whole grid.
SETTINGS = FitSettings(
    tv_weight=1e7, tv_size=64, ssim_weight=0.0, policy=None, smallest=1e-3, truncation=Truncation(9.0, 1e-12)
)


def _blobs() -> Gaussians:
    rng = np.random.default_rng(7)
    means, scales = rng.uniform(-6, 6, (10, 3)) * VOXEL, rng.uniform(1.2, 2.5, (10, 3)) * VOXEL
    return Gaussians.from_physical(
        means, scales, rng.uniform(20, 60, 10), rng.normal(size=(10, 4)), density_unit=1 / (12 * VOXEL)
    )


def _gradient(settings: FitSettings) -> tuple[fit.FitState, NDArray[np.float64]]:
    """(state, the gradient on means [n, 3] that a step of the fit takes): Adam's first moments are a tenth of it."""
    start = _blobs()
    data = project(start, VIEWS).numpy()
    problem = fit.problem_of(Views(data, VIEWS), GRID, start.density_unit, settings)
    state = fit.init(start, 0)
    before = {name: values.copy() for name, values in state.parameters.items()}
    fit.step(state, problem, settings, 0.0, view=0)
    found = state.first["means"].astype(np.float64) / 0.1 / settings.tv_weight
    state.parameters = before
    return state, found


def _along_voxels(state: fit.FitState) -> NDArray[np.float64]:
    """Central differences [n, 3] of the reference's total variation, per voxel by which a centre moves; float64."""
    double = in_double(fit.gaussians_of(state))
    half_field = 12 * VOXEL

    def smoothness(means: torch.Tensor) -> float:
        moved = replace(double, means=means)
        return float(total_variation(voxelize(moved, GRID) * half_field))

    out, h = np.empty((double.n, 3)), 1e-5
    with torch.no_grad():
        for at in np.ndindex(out.shape):
            step = torch.zeros_like(double.means)
            step[at] = h * VOXEL
            out[at] = (smoothness(double.means + step) - smoothness(double.means - step)) / (2 * h)
    return out


def test_the_pull_on_centres_is_the_slope_and_the_published_one_smaller_by_the_voxel_squared() -> None:
    state, ours = _gradient(SETTINGS)
    a_voxel = _along_voxels(state)
    # A centre x lies at u = x / Δ voxels, so that ∂/∂x = (1 / Δ) ∂/∂u.
    np.testing.assert_allclose(ours, a_voxel / VOXEL, atol=2e-4 * np.abs(ours).max())
    published = a_voxel * VOXEL  # multiplied where it should be divided
    ratio = np.linalg.norm(published) / np.linalg.norm(ours)
    assert ratio == pytest.approx(VOXEL**2, rel=1e-3)
    assert 1 / ratio == pytest.approx(16384, rel=1e-3)


def test_centres_stay_where_total_variation_may_not_move_them() -> None:
    (_, moves), (_, still) = (_gradient(replace(SETTINGS, tv_moves=m)) for m in (True, False))
    assert np.abs(still).max() < 1e-4 * np.abs(moves).max()  # what is left is of the projection
