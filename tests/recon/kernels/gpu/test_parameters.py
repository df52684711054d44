"""Activations and Adam: the Triton kernels against torch and the CPU's."""

from __future__ import annotations

import importlib

import numpy as np
import torch

from recon.splatting.backend import Cpu
from tests.recon.kernels import reference
from tests.recon.kernels.gpu.on_gpu import DEVICE, UNIT

engine = importlib.import_module("recon.kernels.gpu.engine")
parameters = importlib.import_module("recon.kernels.gpu.parameters")


def test_activations_and_gradients_equal_torch(rng: np.random.Generator) -> None:
    n = 21
    quaternions = rng.normal(size=(n, 4)).astype(np.float32)
    quaternions[:3] = [[0, 0, 0, 0], [1e-20, 0, 0, 0], [3e-7, 4e-7, 0, 0]]
    log_scales, raw = rng.normal(size=(n, 3)).astype(np.float32), (10 * rng.normal(size=n)).astype(np.float32)
    raw[:3] = [-80, -20, 80]
    q, r = (torch.from_numpy(a.astype(np.float64)).requires_grad_() for a in (quaternions, raw))
    turned, dense = reference.rotation_matrices(q).reshape(n, 9), UNIT * torch.nn.functional.softplus(r)
    on_device = [torch.from_numpy(a).to(DEVICE) for a in (log_scales, quaternions, raw)]
    scales, rotations, densities = parameters.activate(*on_device, UNIT)
    np.testing.assert_allclose(scales.cpu(), np.exp(log_scales), rtol=1e-5)
    np.testing.assert_allclose(densities.cpu(), dense.detach(), rtol=1e-5)
    np.testing.assert_allclose(rotations.cpu()[2:], turned.detach()[2:], atol=2e-6)
    np.testing.assert_array_equal(rotations.cpu()[:2], np.tile(np.eye(3, dtype=np.float32).ravel(), (2, 1)))

    g_rotations, g_densities = rng.normal(size=(n, 9)).astype(np.float32), rng.normal(size=n).astype(np.float32)
    d_q, d_r = parameters.activation_backward(
        *on_device[1:], UNIT, torch.from_numpy(g_rotations).to(DEVICE), torch.from_numpy(g_densities).to(DEVICE)
    )
    ((turned * torch.from_numpy(g_rotations)).sum() + (dense * torch.from_numpy(g_densities)).sum()).backward()
    assert q.grad is not None and r.grad is not None
    assert not d_q.cpu()[:2].any()
    np.testing.assert_allclose(d_q.cpu()[2], q.grad[2], rtol=1e-4)
    np.testing.assert_allclose(d_q.cpu()[3:], q.grad[3:], atol=2e-5 * float(q.grad[3:].abs().max()))
    np.testing.assert_allclose(d_r.cpu(), r.grad, rtol=1e-4, atol=1e-12)


def test_adam_and_its_bounds_equal_the_cpus(rng: np.random.Generator) -> None:
    shapes, rates = ((700, 3), (5, 3), (5, 4), (1,)), (0.01, 0.02, 0.003, 0.1)
    bounds = (None, (-0.5, 0.4), None, (0.1, 2.0))
    ours, theirs = Cpu(), engine.Gpu("cuda")
    start = [rng.normal(size=shape).astype(np.float32) for shape in shapes]
    sets = [[[b.array(p) for p in start], *([b.array(0 * p) for p in start] for _ in range(2))] for b in (ours, theirs)]
    for step in range(1, 4):
        slopes = [rng.normal(size=shape).astype(np.float32) for shape in shapes]
        for backend, (p, first, second) in zip((ours, theirs), sets, strict=True):
            backend.adam(p, [backend.array(slope) for slope in slopes], first, second, rates, step, bounds)
    held = theirs.numpy(sets[1][0][1])
    assert held.min() == np.float32(-0.5) and held.max() == np.float32(0.4)
    for mine, others in zip(*sets, strict=True):
        for a, b in zip(mine, others, strict=True):
            np.testing.assert_allclose(theirs.numpy(b), a, atol=2e-6)
