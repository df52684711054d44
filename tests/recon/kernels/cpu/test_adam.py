"""Adam against torch's, its bounds, and the record of pulls."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from recon.kernels.cpu.adam import adam, adam_all, add_lengths


def test_adam_equals_torch(rng: np.random.Generator) -> None:
    start = rng.normal(size=(50, 3)).astype(np.float32)
    mine, first, second = start.copy(), np.zeros_like(start), np.zeros_like(start)
    other = torch.from_numpy(start.copy()).requires_grad_()
    optimiser = torch.optim.Adam([other], lr=0.01, eps=1e-15)
    for step in range(1, 6):
        gradient = rng.normal(size=start.shape).astype(np.float32)
        adam(mine, gradient, first, second, 0.01, step)
        other.grad = torch.from_numpy(gradient.copy())
        optimiser.step()
    np.testing.assert_allclose(mine, other.detach().numpy(), atol=2e-6)


def test_all_arrays_at_once_are_each_by_itself_within_its_bounds(rng: np.random.Generator) -> None:
    # Larger than one task, not a multiple of sixteen, and one of nothing.
    shapes = [(1501, 3), (1501, 4), (7,), (0, 3)]
    together = [[rng.normal(size=s).astype(np.float32) for s in shapes] for _ in range(2)]
    moments = [[np.zeros(s, np.float32) for s in shapes] for _ in range(2)]
    alone = [[a.copy() for a in arrays] for arrays in (*together, *moments)]
    rates, bounds = (0.1, 0.2, 0.3, 0.4), (None, (-0.5, 0.25), None, None)
    for step in (1, 2):
        adam_all(*together, *moments, rates, step, bounds)
        for k, rate in enumerate(rates):
            adam(*(arrays[k] for arrays in alone), rate, step)
        np.clip(alone[0][1], -0.5, 0.25, out=alone[0][1])
    for found, expected in zip((*together, *moments), alone, strict=True):
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7)
    assert together[0][1].min() == -0.5 and together[0][1].max() == 0.25


def test_no_gradient_at_all_moves_nothing() -> None:
    # 0 / (0 + eps): eps keeps it from being 0 / 0.
    value, zero = np.ones((3, 2), np.float32), np.zeros((3, 2), np.float32)
    adam(value, zero, zero.copy(), zero.copy(), 0.1, 1)
    np.testing.assert_array_equal(value, 1)


def test_what_would_be_updated_as_a_copy_is_refused() -> None:
    whole = np.zeros((4, 6), np.float32)
    for bad in (whole[:, ::2], whole[:, :2]):
        with pytest.raises(ValueError, match="C-contiguous"):
            adam(bad, *(np.zeros(bad.shape, np.float32) for _ in range(3)), 0.1, 1)
    with pytest.raises(ValueError, match="of one shape"):
        adam(whole, *(np.zeros((6, 4), np.float32) for _ in range(3)), 0.1, 1)


def test_lengths_add_up(rng: np.random.Generator) -> None:
    vectors, sums = rng.normal(size=(40, 2)).astype(np.float32), np.ones(40, np.float32)
    for _ in range(2):
        add_lengths(vectors, 3.0, sums)
    np.testing.assert_allclose(sums, 1 + 6 * np.hypot(*vectors.T.astype(np.float64)), rtol=1e-6)
