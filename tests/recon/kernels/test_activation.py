"""Activations and their backward pass against torch."""

from __future__ import annotations

import numpy as np
import torch

from recon.kernels.activation import activate, activation_backward
from recon.kernels.adam_cpu import adam
from recon.kernels.reference import rotation_matrices


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
