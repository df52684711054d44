"""Adam compared with its published steps; bounds; and the sum of gradient lengths."""

from __future__ import annotations

import numpy as np
import pytest

from recon.kernels.cpu.adam import adam_all, add_lengths


def test_each_array_takes_the_published_steps_within_its_bounds(rng: np.random.Generator) -> None:
    # Kingma & Ba 2015, algorithm 1, in float64; torch's would load its compiler, for two seconds. The arrays: larger
    # than one task, not a multiple of sixteen, and one of nothing; four as in a fit, as numba compiles for each number.
    shapes, rates = [(1501, 3), (1501, 4), (7,), (0, 3)], (0.01, 0.02, 0.03, 0.04)
    mine = [rng.normal(size=shape).astype(np.float32) for shape in shapes]
    first, second = ([np.zeros_like(a) for a in mine] for _ in range(2))
    expected, mean, power = ([a.astype(np.float64) for a in arrays] for arrays in (mine, first, second))
    for step in range(1, 6):
        gradients = [rng.normal(size=shape).astype(np.float32) for shape in shapes]
        adam_all(mine, gradients, first, second, rates, step, (None, (-0.5, 0.25), None, None))
        for k, g in enumerate(gradients):
            mean[k], power[k] = 0.9 * mean[k] + 0.1 * g, 0.999 * power[k] + 0.001 * g.astype(np.float64) ** 2
            root = np.sqrt(power[k] / (1 - 0.999**step)) + 1e-15
            expected[k] -= rates[k] * mean[k] / (1 - 0.9**step) / root
        np.clip(expected[1], -0.5, 0.25, out=expected[1])
    for found, wanted in zip((*mine, *first, *second), (*expected, *mean, *power), strict=True):
        np.testing.assert_allclose(found, wanted, atol=2e-6)
    assert mine[1].min() == -0.5 and mine[1].max() == 0.25


def _four(*arrays: np.ndarray) -> list[list[np.ndarray]]:
    """Parameter, gradient and moments, each four times over, as `adam_all` takes them."""
    return [[array.copy() if array.flags.c_contiguous else array for _ in range(4)] for array in arrays]


def test_no_gradient_at_all_moves_nothing() -> None:
    # 0 / (0 + eps): eps keeps it from being 0 / 0.
    value, zero = np.ones((3, 2), np.float32), np.zeros((3, 2), np.float32)
    values, gradients, first, second = _four(value, zero, zero, zero)
    adam_all(values, gradients, first, second, (0.1,) * 4, 1)
    np.testing.assert_array_equal(values, [value] * 4)


def test_what_would_be_updated_as_a_copy_is_refused() -> None:
    whole = np.zeros((4, 6), np.float32)
    for bad in (whole[:, ::2], whole[:, :2]):
        with pytest.raises(ValueError, match="C-contiguous"):
            zeros = np.zeros(bad.shape, np.float32)
            values, gradients, first, second = _four(bad, zeros, zeros, zeros)
            adam_all(values, gradients, first, second, (0.1,) * 4, 1)
    with pytest.raises(ValueError, match="have the same shape"):
        values, gradients, first, second = _four(whole, *[np.zeros((6, 4), np.float32)] * 3)
        adam_all(values, gradients, first, second, (0.1,) * 4, 1)


def test_lengths_add_up(rng: np.random.Generator) -> None:
    vectors, sums = rng.normal(size=(40, 2)).astype(np.float32), np.ones(40, np.float32)
    for _ in range(2):
        add_lengths(vectors, 3.0, sums)
    np.testing.assert_allclose(sums, 1 + 6 * np.hypot(*vectors.T.astype(np.float64)), rtol=1e-6)
