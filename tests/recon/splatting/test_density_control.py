"""Clone, split and prune: what they conserve, and their errors."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from recon.base.volume import Grid
from recon.splatting.gaussians import Gaussians
from recon.splatting.settings import Change, DensityPolicy, control
from tests.recon.conftest import Make
from tests.recon.kernels.reference import covariances, rotation_matrices

FIELD = 20.0
BOX = Grid((20, 20, 20)).edges


def _control(g: Gaussians, statistic: np.ndarray, policy: DensityPolicy, limit: int = 1000) -> Change:
    rotations = rotation_matrices(g.quaternions).reshape(-1, 9).numpy()
    return control(
        (g.means.numpy(), g.log_scales.numpy(), rotations, g.raw_densities.numpy()), statistic.astype(np.float32),
        policy, FIELD, limit, BOX, np.random.default_rng(1),
    )  # fmt: skip


def _masses(log_scales: np.ndarray, raw: np.ndarray) -> np.ndarray:
    return np.logaddexp(0, raw.astype(np.float64)) * np.exp(log_scales.astype(np.float64).sum(1))


@given(seed=st.integers(0, 1000))
def test_growing_conserves_mass_and_centre_of_mass(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 25
    g = Gaussians.from_physical(
        rng.uniform(-5, 5, (n, 3)), rng.uniform(0.3, 2, (n, 3)), rng.uniform(0.1, 2, n), rng.normal(size=(n, 4))
    )
    change = _control(g, rng.uniform(0, 1e-4, n), DensityPolicy())
    before, after = _masses(g.log_scales.numpy(), g.raw_densities.numpy()), _masses(change.log_scales, change.raw)
    assert change.parents.size > 0 and after.size == n + change.parents.size
    assert after.sum() == pytest.approx(before.sum(), rel=1e-5)
    np.testing.assert_allclose(after @ change.means, before @ g.means.numpy(), rtol=1e-4, atol=1e-3)


def test_a_split_keeps_the_covariance(random_gaussians: Make) -> None:
    # Mixture of two: covariance of the parts plus that of their centres.
    g = random_gaussians(1)
    change = _control(g, np.ones(1), DensityPolicy())
    assert change.means.shape == (2, 3)
    centre = change.means.mean(0)
    parts = covariances(torch.from_numpy(np.exp(change.log_scales)), g.quaternions.repeat(2, 1)).numpy().mean(0)
    spread = np.einsum("ni,nj->ij", change.means - centre, change.means - centre) / 2
    np.testing.assert_allclose(parts + spread, covariances(g.scales, g.quaternions)[0].numpy(), rtol=1e-4, atol=1e-5)


def test_pruning_takes_the_faint_and_the_lost() -> None:
    g = Gaussians.from_physical([[0, 0, 0], [1, 0, 0], [30, 0, 0]], [1.0] * 3, [1.0, 1e-6, 1.0], density_unit=1.0)
    change = _control(g, np.zeros(3), DensityPolicy())
    assert change.keep.tolist() == [0]
    assert change.parents.size == 0


@given(seed=st.integers(0, 1000), wide=st.floats(0.05, 5))
def test_removed_gaussians_hardly_reach_into_the_box_and_others_stay(seed: int, wide: float) -> None:
    rng = np.random.default_rng(seed)
    n = 40
    g = Gaussians.from_physical(
        rng.uniform(-16, 16, (n, 3)), rng.uniform(0.2, 1, (n, 3)) * wide, np.ones(n), rng.normal(size=(n, 4))
    )
    kept = _control(g, np.zeros(n), DensityPolicy()).keep
    outside = np.linalg.norm(np.maximum(np.abs(g.means.numpy()) - 10, 0), axis=1)  # mm from the box of ±10 mm
    longest = g.scales.numpy().max(axis=1)
    gone = np.setdiff1d(np.arange(n), kept)
    # At three standard deviations a Gaussian has fallen to exp(-4.5) of its peak.
    assert (np.exp(-0.5 * (outside / longest)[gone] ** 2) <= math.exp(-4.5) * (1 + 1e-5)).all()
    assert np.isin(np.flatnonzero(outside < 2.999 * longest), kept).all()


def test_matter_at_the_border_is_seen_after_a_round_as_before() -> None:
    # A voxel of the box beside the border lies in the tail of a Gaussian whose centre is half a σ outside.
    g = Gaussians.from_physical([[10.5, 0, 0], [10.5, 4, 0]], [1.0, 0.1], [1.0, 1.0], density_unit=1.0)
    change = _control(g, np.zeros(2), DensityPolicy())
    assert change.keep.tolist() == [0]  # the other one, of 0.1 mm, is five σ away from the box
    np.testing.assert_array_equal(change.means, g.means.numpy()[:1])
    np.testing.assert_array_equal(change.raw, g.raw_densities.numpy()[:1])


def test_the_box_may_lie_anywhere() -> None:
    g = Gaussians.from_physical([[12.0, 0, 0], [-7.0, 0, 0], [0, 3.0, 0], [0, 0, -4.0]], [0.3] * 4, [1.0] * 4)
    box = Grid((6, 10, 20), centre=(-1.5, 0.0, 4.0)).edges  # x -6..14, y -5..5, z -4.5..1.5
    rotations = rotation_matrices(g.quaternions).reshape(-1, 9).numpy()
    change = control(
        (g.means.numpy(), g.log_scales.numpy(), rotations, g.raw_densities.numpy()), np.zeros(4, np.float32),
        DensityPolicy(), FIELD, 10, box, np.random.default_rng(1),
    )  # fmt: skip
    assert change.keep.tolist() == [0, 2, 3]


def test_the_limit_keeps_the_most_wanted(random_gaussians: Make) -> None:
    g = random_gaussians(20)
    statistic = np.arange(20) * 1e-4 + 1e-4
    change = _control(g, statistic, DensityPolicy(), limit=23)
    assert change.parents.tolist() == [17, 18, 19]
    assert change.means.shape[0] == 23


@given(seed=st.integers(0, 1000), faint=st.integers(0, 12))
def test_at_the_limit_pruning_and_splitting_relocate_at_a_constant_number(seed: int, faint: int) -> None:
    rng = np.random.default_rng(seed)
    n = 30
    density = rng.uniform(0.1, 2, n)
    dim = rng.permutation(n)[:faint]
    density[dim] = 1e-6
    statistic = rng.uniform(1e-4, 2e-4, n)
    g = Gaussians.from_physical(
        rng.uniform(-5, 5, (n, 3)), rng.uniform(0.3, 2, (n, 3)), density, rng.normal(size=(n, 4)), density_unit=1.0
    )
    change = _control(g, statistic, DensityPolicy(), limit=n)
    # The room of those that went, and no more, is taken by copies of those most wanted among the rest.
    assert change.raw.size == n and change.parents.size == faint
    left = np.setdiff1d(np.arange(n), dim)
    assert change.keep.tolist() == left.tolist()
    most = left[np.argsort(-statistic[left].astype(np.float32), kind="stable")[:faint]]
    assert change.parents.tolist() == sorted(most.tolist())
    before, after = _masses(g.log_scales.numpy(), g.raw_densities.numpy()), _masses(change.log_scales, change.raw)
    assert after.sum() == pytest.approx(before[left].sum(), rel=1e-5)
    assert after.sum() == pytest.approx(before.sum(), rel=1e-3)  # what went was next to nothing
    np.testing.assert_allclose(after @ change.means, before[left] @ g.means.numpy()[left], rtol=1e-4, atol=1e-3)
