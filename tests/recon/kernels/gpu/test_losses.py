"""Losses and Adam: the Triton kernels compared with the reference and the CPU kernels."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
import torch

from recon.kernels.cpu.losses import L1, L2, POISSON, DataTerm
from tests.recon.kernels.gpu.on_gpu import DEVICE
from tests.recon.kernels.reference import projection_loss
from tests.recon.kernels.reference import total_variation as reference_total_variation

engine = importlib.import_module("recon.kernels.gpu.engine")


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("term", [DataTerm(L1, 1.0, 1.0), DataTerm(L2, 0.3, 1.0), DataTerm(POISSON, 0.2, 1.7)])
def test_projection_loss_and_gradient_equal_the_reference(
    weighted: bool, term: DataTerm, rng: np.random.Generator
) -> None:
    target = rng.random((19, 33)).astype(np.float32)
    image = (target + 0.2 * rng.normal(size=target.shape)).astype(np.float32)
    image[3, 4] = target[3, 4]
    weights = np.maximum(rng.uniform(-0.5, 2.0, target.shape), 0).astype(np.float32) if weighted else None
    backend = engine.Gpu("cuda")
    loss = backend.projection_loss(target.shape, 0.25, term)
    x, y = backend.array(image), backend.array(target)
    w = None if weights is None else backend.array(weights)
    value, gradient = loss(x, y, loss.target_maps(y, w), w)
    exact, *others = (None if a is None else torch.from_numpy(a.astype(np.float64)) for a in (image, target, weights))
    assert exact is not None and others[0] is not None
    exact.requires_grad_()
    expected = projection_loss(exact, others[0], 0.25, others[1], term)
    expected.backward()
    assert float(value) == pytest.approx(expected.item(), rel=1e-5)
    assert exact.grad is not None
    np.testing.assert_allclose(gradient.cpu(), exact.grad, atol=2e-5 * float(exact.grad.abs().max()))
    if weights is not None:
        assert not gradient.cpu().numpy()[weights == 0].any()


@pytest.mark.parametrize("shape", [(5, 6, 11), (1, 4, 4), (1, 1, 3), (1, 1, 1)])
def test_total_variation_and_gradient_equal_the_reference(
    rng: np.random.Generator, shape: tuple[int, int, int]
) -> None:
    volume = torch.from_numpy(rng.normal(size=shape).astype(np.float32))
    value, gradient = engine.total_variation(volume.to(DEVICE), 0.3)
    if volume.numel() == 1:
        assert float(value) == 0 and not gradient.any()
        return
    x = volume.double().requires_grad_()
    expected = 0.3 * reference_total_variation(x)
    expected.backward()
    assert float(value) == pytest.approx(expected.item(), rel=1e-6)
    assert x.grad is not None
    np.testing.assert_allclose(gradient.cpu(), x.grad, atol=1e-7)
