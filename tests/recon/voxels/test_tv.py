"""The proximal step of TV compared with its optimality condition and closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.volume import Grid
from recon.kernels.cpu.tv import total_variation as total_variation_cpu
from recon.voxels.voxel_problem import TotalVariationProx, difference_weights
from tests.recon.voxels.tv_reference import total_variation, transposed_differences

CUBES = (1.0, 1.0, 1.0)


@pytest.mark.parametrize("nonnegative", [False, True])
def test_the_gap_to_the_dual_closes(nonnegative: bool, rng: np.random.Generator) -> None:
    """½|y - x|² + t TV(y) is the minimum: the dual problem has the same value, from a field that bounds it below."""
    x = (rng.normal(size=(9, 10, 11)) + 0.3).astype(np.float32)
    threshold, weights = 0.2, (1.0, 1.0, 0.6)
    prox = TotalVariationProx(x.shape, weights, nonnegative, steps=400)
    y = x.copy()
    prox(y, threshold)
    wide = x.astype(np.float64)
    value = 0.5 * ((y - wide) ** 2).sum() + threshold * total_variation(y.astype(np.float64), weights)
    # max over |p| <= 1 of min over y of ½|y - x|² + t <Dᵀp, y>: its value at y(p) = P(x - t Dᵀp).
    shifted = wide - threshold * transposed_differences(np.stack(prox._dual).astype(np.float64), weights)
    best = np.maximum(shifted, 0) if nonnegative else shifted
    bound = 0.5 * ((best - wide) ** 2).sum() + (best * (wide - shifted)).sum()
    assert bound <= value * (1 + 1e-6)
    assert value - bound < 1e-3 * value


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_step_along_a_line_shrinks_by_the_closed_form(axis: int) -> None:
    """Two plateaus of n₁ and n₂ samples move towards each other by t / n₁ and t / n₂ (Condat 2013)."""
    line = np.r_[np.full(2, 1.0), np.full(4, 3.0)].astype(np.float32)
    x = np.moveaxis(line.reshape(6, 1, 1), 0, axis).copy()
    TotalVariationProx(x.shape, CUBES, True, steps=150)(x, 1.2)
    np.testing.assert_allclose(x.ravel(), np.r_[np.full(2, 1.0 + 1.2 / 2), np.full(4, 3.0 - 1.2 / 4)], atol=2e-3)


def test_a_large_threshold_leaves_the_mean() -> None:
    x = np.arange(6, dtype=np.float32).reshape(6, 1, 1)
    TotalVariationProx(x.shape, CUBES, False, steps=260)(x, 50.0)
    np.testing.assert_allclose(x.ravel(), 2.5, atol=1e-3)


def test_calls_go_on_where_the_last_one_ended(rng: np.random.Generator) -> None:
    x = rng.normal(size=(6, 7, 8)).astype(np.float32)
    once, often = x.copy(), x.copy()
    TotalVariationProx(x.shape, CUBES, True, steps=60)(once, 0.3)
    prox = TotalVariationProx(x.shape, CUBES, True, steps=10)
    for _ in range(6):
        often = x.copy()
        prox(often, 0.3)
    np.testing.assert_allclose(often, once, atol=1e-6)


def test_no_threshold_only_clips() -> None:
    x = np.array([-1.0, 2.0], np.float32).reshape(1, 1, 2)
    TotalVariationProx(x.shape, CUBES, True, steps=3)(x, 0.0)
    np.testing.assert_array_equal(x.ravel(), [0.0, 2.0])


def test_long_voxels_weigh_differences_by_their_length() -> None:
    assert difference_weights(Grid((2, 3, 4), 0.5, slice_pitch=2.0)) == (1.0, 1.0, 0.25)
    assert difference_weights(Grid((2, 3, 4), 0.5)) == (1.0, 1.0, 1.0)


def test_the_sum_of_changes_equals_the_reference(rng: np.random.Generator) -> None:
    x, weights = rng.normal(size=(7, 8, 9)).astype(np.float32), (1.0, 1.0, 0.6)
    assert total_variation_cpu(x, weights) == pytest.approx(total_variation(x.astype(np.float64), weights), rel=1e-5)
    assert total_variation_cpu(np.ones((1, 2, 1), np.float32), weights) == 0


def test_no_side_is_preferred(rng: np.random.Generator) -> None:
    """Four turns see four mirror images alike."""
    x = rng.random((5, 6, 7), dtype=np.float32)
    found = []
    for before in range(5):
        prox, y = TotalVariationProx(x.shape, CUBES, True, 3), x.copy()
        for _ in range(before):
            prox.turn()
        prox(y, 0.2)
        found.append(y)
    for y, axes in zip(found, ((), (0,), (1,), (0, 1), ()), strict=True):
        prox, image = TotalVariationProx(x.shape, CUBES, True, 3), np.flip(x, axes).copy()
        prox(image, 0.2)
        np.testing.assert_allclose(np.flip(image, axes), y, atol=1e-6)
    assert np.abs(found[0] - found[1]).max() > 1e-3


@pytest.mark.parametrize("turns", range(4))
def test_a_single_slice_is_one_of_two_equal_slices(turns: int, rng: np.random.Generator) -> None:
    x = rng.normal(size=(20, 33, 1)).astype(np.float32)
    found = []
    for slices in (1, 2):
        prox = TotalVariationProx((20, 33, slices), (1.0, 1.0, 0.7), True, steps=3)
        y = np.repeat(x, slices, axis=2)
        prox(y, 0.2)
        for _ in range(turns):
            prox.turn()
        prox(y, 0.2)
        found.append(y[:, :, 0])
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)
