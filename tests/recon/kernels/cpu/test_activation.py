"""Activations and their backward pass against torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from recon.kernels.cpu.activation import activate, activation_backward
from tests.recon.kernels.reference import rotation_matrices


def test_activation_and_gradients_equal_torch(rng: np.random.Generator) -> None:
    n, unit = 30, 0.3
    log_scales, quaternions = (rng.normal(size=(n, k)).astype(np.float32) for k in (3, 4))
    raw = (10 * rng.normal(size=n)).astype(np.float32)
    scales, rotations, densities = np.empty((n, 3), np.float32), np.empty((n, 9), np.float32), np.empty(n, np.float32)
    activate(log_scales, quaternions, raw, unit, scales, rotations, densities)
    q, r = (torch.from_numpy(a.astype(np.float64)).requires_grad_() for a in (quaternions, raw))
    turned, dense = rotation_matrices(q), unit * torch.nn.functional.softplus(r)
    np.testing.assert_allclose(scales, np.exp(log_scales), rtol=1e-5)
    np.testing.assert_allclose(rotations, turned.detach().reshape(n, 9).numpy(), atol=1e-6)
    np.testing.assert_allclose(densities, dense.detach().numpy(), rtol=1e-5)

    d_rotations, d_densities = rng.normal(size=(n, 9)).astype(np.float32), rng.normal(size=n).astype(np.float32)
    d_q, d_r = np.empty_like(quaternions), np.empty_like(raw)
    activation_backward(quaternions, raw, unit, d_rotations, d_densities, d_q, d_r)
    (
        (turned.reshape(n, 9) * torch.from_numpy(d_rotations)).sum() + (dense * torch.from_numpy(d_densities)).sum()
    ).backward()
    assert q.grad is not None and r.grad is not None
    np.testing.assert_allclose(d_q, q.grad.numpy(), atol=2e-5 * float(q.grad.abs().max()))
    np.testing.assert_allclose(d_r, r.grad.numpy(), rtol=1e-4, atol=1e-7)


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


def test_a_quaternion_without_direction_is_the_identity_and_feels_nothing() -> None:
    for length in (0.0, 1e-30, 1e-13):
        quaternion = np.full((1, 4), length / 2, np.float32)
        _, rotations, _ = _activated(np.zeros((1, 3)), quaternion, np.zeros(1))
        np.testing.assert_array_equal(rotations[0], np.eye(3).ravel())
        d_quaternions, d_raw = np.empty((1, 4), np.float32), np.empty(1, np.float32)
        g = np.ones((1, 9), np.float32)
        activation_backward(quaternion, np.zeros(1, np.float32), 1.0, g, g[0, :1].copy(), d_quaternions, d_raw)
        assert not d_quaternions.any()


@pytest.mark.parametrize("length", [1e-11, 1e-3, 1e12, 1e30, 1e38])
def test_a_quaternion_of_any_length_has_its_direction(length: float) -> None:
    # The square of 1e30 is no float32: a naive length is infinite, and the rotation silently none.
    quaternion = (np.array([[0.1, -0.7, 0.5, 0.5]]) * length).astype(np.float32)
    _, rotations, _ = _activated(np.zeros((1, 3)), quaternion, np.zeros(1))
    leaf = torch.from_numpy(quaternion.astype(np.float64)).requires_grad_()
    turned = rotation_matrices(leaf).reshape(1, 9)
    np.testing.assert_allclose(rotations, turned.detach().numpy(), atol=4e-7)
    g = np.random.default_rng(0).normal(size=(1, 9)).astype(np.float32)
    d_quaternion, d_raw = np.empty((1, 4), np.float32), np.empty(1, np.float32)
    activation_backward(quaternion, np.zeros(1, np.float32), 1.0, g, g[0, :1].copy(), d_quaternion, d_raw)
    (turned * torch.from_numpy(g)).sum().backward()
    assert leaf.grad is not None
    expected = leaf.grad.numpy()
    np.testing.assert_allclose(d_quaternion, expected, atol=3e-6 * np.abs(expected).max() + 1e-37)
