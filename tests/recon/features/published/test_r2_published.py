"""The published R²-Gaussian: its settings, its start, and how it splits and clones Gaussians."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import recon
from recon.assess.metrics import psnr
from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.base.volume import Grid, Volume
from recon.features.published.r2_published import R2Published, published_fit
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import neighbour_distance, sample_as_published
from recon.splatting.settings import Change, DensityPolicy, control, in_steps
from recon.voxels.projector import Projector
from recon.voxels.voxel_problem import density_unit
from tests.recon.conftest import Make
from tests.recon.kernels.reference import rotation_matrices

FIELD = 20.0


def _change(g: Gaussians, large: float) -> Change:
    rotations = rotation_matrices(g.quaternions).reshape(-1, 9).numpy()
    policy = DensityPolicy(large=large, rule="published")
    return control(
        (g.means.numpy(), g.log_scales.numpy(), rotations, g.raw_densities.numpy()), np.ones(g.n, np.float32),
        policy, FIELD, 10 * g.n, Grid((20, 20, 20)).edges, np.random.default_rng(1),
    )  # fmt: skip


def _densities(change: Change) -> np.ndarray:
    return np.logaddexp(0, change.raw.astype(np.float64))


def test_a_clone_is_two_equal_gaussians_of_half_the_density(random_gaussians: Make) -> None:
    g = random_gaussians(5)
    change = _change(g, large=1e6)
    np.testing.assert_array_equal(change.means, np.concatenate((g.means.numpy(),) * 2))
    np.testing.assert_array_equal(change.log_scales, np.concatenate((g.log_scales.numpy(),) * 2))
    np.testing.assert_allclose(_densities(change), np.tile(g.densities.numpy() / g.density_unit / 2, 2), rtol=1e-5)


def test_a_split_draws_two_narrower_ones_from_the_gaussian(random_gaussians: Make) -> None:
    g = random_gaussians(1)
    many = g.select(torch.zeros(4000, dtype=torch.int64))
    change = _change(many, large=1e-6)
    np.testing.assert_allclose(np.exp(change.log_scales), np.tile(g.scales.numpy() / 1.6, (8000, 1)), rtol=1e-5)
    np.testing.assert_allclose(_densities(change), float(g.densities[0]) / g.density_unit / 2, rtol=1e-5)
    turned = rotation_matrices(g.quaternions)[0].numpy()
    own = (change.means - g.means.numpy()) @ turned / g.scales.numpy()
    np.testing.assert_allclose(own.mean(0), 0.0, atol=0.06)
    np.testing.assert_allclose(np.cov(own.T), np.eye(3), atol=0.08)


def test_the_rule_is_one_of_two() -> None:
    with pytest.raises(ValueError, match=r"rule .*legal: mass, published"):
        DensityPolicy(rule="other")  # type: ignore[arg-type]


def test_the_start_is_even_over_matter_at_0_15_of_its_density(rng: np.random.Generator) -> None:
    grid = Grid((16, 24, 24), 0.5)
    values = np.zeros(grid.shape, np.float32)
    values[4:12, 6:12, 6:18], values[4:12, 12:18, 6:18] = 1.0, 0.2
    volume = Volume(values, grid)
    placed = sample_as_published(volume, 600, rng, field_radius=6.0)
    assert placed.density_unit == density_unit(values) and placed.n == 600
    np.testing.assert_allclose(np.unique(placed.densities.numpy().round(5)), [0.03, 0.15], rtol=1e-3)
    assert (placed.densities.numpy() > 0.1).mean() == pytest.approx(0.5, abs=0.05)  # half of the voxels
    np.testing.assert_allclose(
        placed.scales.numpy()[:, 0], neighbour_distance(placed.means.double().numpy()), rtol=1e-5
    )
    all_of_it = sample_as_published(volume, 10**6, rng, field_radius=6.0)
    assert all_of_it.n == np.count_nonzero(values)


def test_the_settings_are_those_of_the_paper_and_its_code() -> None:
    method, fit = recon.R2Published(), published_fit()
    assert method.fit == fit
    assert (method.steps, method.gaussians, method.finish, method.start) == (30_000, 50_000, 0, "published")
    assert (fit.loss, fit.ssim_weight, fit.tv_weight, fit.tv_size, fit.views_per_step) == ("l1", 0.25, 0.05, 32, 1)
    assert (fit.kernel, fit.rates, fit.pace, fit.decay) == (Kernel.GAUSSIAN, (2e-4, 5e-3, 1e-3, 1e-2), 1.0, 0.1)
    assert in_steps(fit, 10_000) == fit
    policy = fit.policy
    assert policy is not None
    assert (policy.start * 30_000, policy.stop * 30_000, policy.every) == (500.0, 15_000.0, 100)
    assert (policy.threshold, policy.large, policy.prune_below, policy.growth) == (5e-5, 0.1, 1e-5, 10.0)


def test_it_comes_near_a_known_volume() -> None:
    angles = np.linspace(0, np.pi, 24, endpoint=False)
    geometry = Geometry.parallel(angles, (12, 32))
    grid = Grid.matching(geometry)
    z, y, x = grid.coordinates()
    inside = (x[None, None] / 10) ** 2 + (y[None, :, None] / 8) ** 2 + (z[:, None, None] / 4) ** 2 < 1
    truth = 0.1 * inside.astype(np.float32)
    data = Projector(geometry, grid).forward(truth)
    found = recon.reconstruct(data, geometry, R2Published(steps=300, gaussians=500))
    short = recon.reconstruct(data, geometry, R2Published(steps=3, gaussians=500))
    assert psnr(found.volume.data, truth) > psnr(short.volume.data, truth) + 0.5
    assert found.settings["start"] == "published" and found.gaussians.kernel is Kernel.GAUSSIAN
