"""Activations and their backward pass compared with torch."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.kernels.cpu.activation import activate, activation_backward


def _activated(log_scales: np.ndarray, quaternions: np.ndarray, raw: np.ndarray) -> tuple[np.ndarray, ...]:
    n = len(raw)
    filled = tuple(np.full(shape, np.nan, np.float32) for shape in ((n, 3), (n, 9), (n,)))
    activate(*(np.ascontiguousarray(a, np.float32) for a in (log_scales, quaternions, raw)), 1.0, *filled)
    return filled


@pytest.mark.parametrize("n", [1, 5, 16, 1023, 1025])
def test_every_row_is_filled_to_float32_over_the_whole_range(n: int) -> None:
    raw = np.linspace(-80, 80, n).astype(np.float32) if n > 1 else np.zeros(1, np.float32)
    logs = np.stack((raw, -raw, raw / 9), 1)
    scales, rotations, densities = _activated(logs, np.ones((n, 4)), raw)
    # The digits that the argument itself has: a step of float32 in x is a relative one of 1.2e-7 |x| in e^x.
    limit = 4e-7 + 1.5e-7 * np.abs(raw.astype(np.float64))
    assert (np.abs(scales[:, 0] / np.exp(raw.astype(np.float64)) - 1) < limit).all()
    softplus = np.logaddexp(0, raw.astype(np.float64))
    assert (np.abs(densities / softplus - 1) < limit).all()
    np.testing.assert_allclose(rotations, np.tile([0, 0, 1, 1, 0, 0, 0, 1, 0], (n, 1)), atol=2e-7)

    d_quaternions, d_raw = np.full((n, 4), np.nan, np.float32), np.full(n, np.nan, np.float32)
    ones = np.ones((n, 9), np.float32)
    activation_backward(np.ones((n, 4), np.float32), raw, 1.0, ones, ones[:, 0].copy(), d_quaternions, d_raw)
    sigmoid = np.exp(np.minimum(raw, 0).astype(np.float64)) / (1 + np.exp(-np.abs(raw.astype(np.float64))))
    assert (np.abs(d_raw / sigmoid - 1) < limit).all()
    assert np.isfinite(d_quaternions).all()


@given(st.lists(st.floats(-(2.0**100), 2.0**100, width=32), min_size=8, max_size=8))
def test_any_finite_parameters_give_finite_ones_and_gradients(values: list[float]) -> None:
    logs, quaternions, raw = np.array([values[:3]]), np.array([values[3:7]]), np.array(values[7:])
    scales, rotations, densities = _activated(logs, quaternions, raw)
    assert np.isfinite(scales).all() and (scales > 0).all()
    turned = rotations.reshape(3, 3).astype(np.float64)
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-5)
    assert np.isfinite(densities).all() and (densities >= 0).all()
    d_quaternions, d_raw = np.empty((1, 4), np.float32), np.empty(1, np.float32)
    g = np.ones((1, 9), np.float32)
    activation_backward(
        quaternions.astype(np.float32), raw.astype(np.float32), 1.0, g, np.ones(1, np.float32), d_quaternions, d_raw
    )
    assert np.isfinite(d_quaternions).all() and np.isfinite(d_raw).all()
