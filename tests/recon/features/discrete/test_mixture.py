"""Mixture of discrete levels: posterior mean compared with float64 integrals, gradient, levels, region."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.base.decisions import MaterialPrior
from recon.features.discrete.mixture import (
    APART,
    DOUBT,
    NOISE,
    SPREAD,
    MaterialPull,
    are_apart,
    drawn_apart,
    fitted_levels,
    gap_of,
    probabilities,
    table_of,
    thin_parts,
    undecided_share,
)
from recon.kernels.cpu.materials import BLUR, posterior_mean
from tests.recon.features.discrete.reference import posterior_by_integrals, shares_of_neighbours

F32 = NDArray[np.float32]
TWO = MaterialPrior((0.2, 1.0), (0.6, 0.4), 0.25, 0.02)
THREE = MaterialPrior((0.0, 0.3, 1.0), (0.5, 0.3, 0.2), 1.0, 0.02)


def blocks(shape: tuple[int, int, int], levels: tuple[float, ...], seed: int = 0) -> F32:
    """Blocks of the levels, with noise of a tenth."""
    rng = np.random.default_rng(seed)
    few = rng.integers(0, len(levels), [-(-n // 4) for n in shape])
    large = np.kron(few, np.ones((4, 4, 4), int))[: shape[0], : shape[1], : shape[2]]
    return (np.array(levels)[large] + rng.normal(0, 0.1, shape)).astype(np.float32)


@pytest.mark.parametrize("materials", [TWO, THREE])
@pytest.mark.parametrize("shape", [(9, 11, 5), (7, 4, 1)])
def test_the_posterior_mean_is_that_of_integrals_over_the_true_density(
    materials: MaterialPrior, shape: tuple[int, int, int]
) -> None:
    x, table, levels = blocks(shape, materials.levels), table_of(materials), np.array(materials.levels)
    z, p = np.empty_like(x), np.empty((levels.size, *shape), np.float32)
    posterior_mean(x, table, z, p)
    at = (x.ravel().astype(float) - table.first) * table.scale
    shares = np.stack([np.interp(at, np.arange(len(table.shares)), table.shares[:, m]) for m in range(levels.size)])
    f = shares_of_neighbours(shares.reshape(-1, *shape), BLUR)
    noise, spread = NOISE * gap_of(materials), SPREAD * gap_of(materials)
    for i in np.random.default_rng(1).permutation(x.size)[:40]:
        voxel = np.unravel_index(i, shape)
        mean, own = posterior_by_integrals(
            float(x[voxel]), f[(slice(None), *voxel)], levels, noise, spread, (table.least, table.most)
        )
        assert z[voxel] == pytest.approx(mean, abs=2e-4)
        np.testing.assert_allclose(p[(slice(None), *voxel)], own, atol=5e-4)


def test_the_pull_is_the_gradient_of_a_penalty() -> None:
    """y - E[t | y] = φ'(y) of φ = -σ² log p(y) for probabilities that stay: Tweedie's formula."""
    noise, spread = NOISE * gap_of(TWO), SPREAD * gap_of(TWO)
    f, levels, partial = np.array([0.7, 0.3]), np.array(TWO.levels), (0.5, 0.9)
    between = partial[0] + (partial[1] - partial[0]) * min(4 * f[0] * f[1], 1)

    def penalty(y: float) -> float:
        own = max(1 - between, 0.05) * f + 0.01
        width = math.hypot(noise, spread)
        normal = np.exp(-0.5 * ((y - levels) / width) ** 2) / (math.sqrt(2 * math.pi) * width)
        return -(noise**2) * math.log(float((own * normal).sum()) + between / float(np.diff(levels)[0]))

    for y in np.linspace(-0.1, 1.3, 29):
        slope = (penalty(y + 1e-5) - penalty(y - 1e-5)) / 2e-5
        assert y - posterior_by_integrals(y, f, levels, noise, spread, partial)[0] == pytest.approx(slope, abs=1e-6)


def pull_of(x: F32) -> MaterialPull:
    return MaterialPull(TWO, np.ones(x.shape, bool), np.zeros(x.shape, np.int8))


def test_levels_are_fixed_points_and_noise_near_them_shrinks() -> None:
    x = np.full((12, 12, 12), 0.2, np.float32)
    x[6:] = 1.0
    pull = pull_of(x)
    np.testing.assert_allclose(pull.target(x), x, atol=2e-3)
    noisy = x + np.random.default_rng(0).normal(0, 0.05, x.shape).astype(np.float32)
    assert np.std(pull.target(noisy) - x) < 0.75 * np.std(noisy - x)


def test_levels_are_drawn_apart_about_the_middle_between_the_outer_ones() -> None:
    apart = drawn_apart(THREE)
    np.testing.assert_allclose(apart.levels, (0.5 - APART / 2, 0.5 - 0.2 * APART, 0.5 + APART / 2))
    assert apart._replace(levels=THREE.levels) == THREE


def test_levels_that_follow_a_volume_stay_where_two_of_them_would_meet() -> None:
    """All voxels are of one density but a few of another: three levels have nothing to follow."""
    x = np.zeros((12, 12, 12), np.float32)
    x[6:] = 0.07
    pull = replace(pull_of(x), materials=THREE, follows=True)
    assert not are_apart(fitted_levels(x, 3)[0])
    assert pull.materials_in(x) == THREE and np.isfinite(pull.target(x)).all()


def test_a_voxel_half_way_between_two_materials_stays() -> None:
    x = np.full((12, 12, 12), 0.2, np.float32)
    x[6:], x[5] = 1.0, 0.6
    assert np.abs(pull_of(x).target(x)[5] - 0.6).max() < 0.02


def test_voxels_that_are_not_to_be_pulled_keep_their_bits() -> None:
    x = blocks((8, 8, 8), TWO.levels)
    where = x > 0.5
    z = replace(pull_of(x), where=where).target(x)
    np.testing.assert_array_equal(z[~where], x[~where])
    assert (z[where] != x[where]).any()


@pytest.mark.parametrize("sign", [1, -1])
def test_a_thin_crack_or_bridge_is_not_filled_but_may_deepen(sign: int) -> None:
    """One plane, from near its sides to near the other material: it is pulled to the latter alone."""
    x = np.full((12, 12, 12), 1.0 if sign > 0 else 0.2, np.float32)
    x[6] -= sign * np.linspace(0.2, 0.72, 12, dtype=np.float32)
    thin = thin_parts(x, TWO)
    np.testing.assert_array_equal(np.unique(np.delete(thin, 6, 0)), [0])
    assert (thin[6] == sign).mean() > 0.9
    free, kept = (MaterialPull(TWO, np.ones(x.shape, bool), part).target(x)[6] - x[6] for part in (0 * thin, thin))
    assert (sign * free).max() > 0.02 and (sign * kept)[thin[6] == sign].max() <= 0
    np.testing.assert_array_equal(kept[sign * free < 0], free[sign * free < 0])


def test_probabilities_leave_the_rest_to_partial_voxels() -> None:
    x = np.full((12, 12, 12), 0.2, np.float32)
    x[6:], x[5] = 1.0, 0.6
    p = probabilities(x, TWO)
    assert p.min() >= 0 and p.sum(0).max() <= 1
    assert p[0, 1].min() > 0.5 and p[1, 10].min() > 0.5 and p[:, 5].sum(0).max() < 0.1


def test_the_share_of_wrong_voxels_is_told() -> None:
    """Of any density alike, with normal errors."""
    rng = np.random.default_rng(0)
    truth = rng.uniform(-0.5, 1.7, 200_000)
    seen = truth + rng.normal(0, DOUBT * 0.8, truth.size)
    wrong = float(((truth > 0.6) != (seen > 0.6)).mean())
    assert undecided_share(seen.astype(np.float32), TWO) == pytest.approx(wrong, rel=0.05)


@pytest.mark.parametrize("levels", [(0.2, 1.0), (0.15, 0.5, 1.0)])
def test_levels_are_found_among_partial_voxels(levels: tuple[float, ...]) -> None:
    rng = np.random.default_rng(0)
    pure = rng.choice(levels, 30_000, p=np.full(len(levels), 1 / len(levels)))
    partial = rng.uniform(levels[0], levels[-1], 4000)
    values = np.concatenate((pure, partial)) + rng.normal(0, 0.05, 34_000)
    found, weights = fitted_levels(values.astype(np.float32), len(levels))
    np.testing.assert_allclose(found, levels, atol=0.01)
    assert weights.sum() == pytest.approx(1) and weights.min() > 0.25


def test_air_around_a_sample_draws_no_level_down() -> None:
    rng = np.random.default_rng(0)
    matter = rng.choice((0.25, 1.0), 30_000) + rng.normal(0, 0.05, 30_000)
    values = np.concatenate((matter, np.abs(rng.normal(0, 1e-3, 10_000)))).astype(np.float32)
    np.testing.assert_allclose(fitted_levels(values, 2)[0], (0.25, 1.0), atol=0.01)
