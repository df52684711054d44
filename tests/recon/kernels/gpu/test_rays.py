"""Exact rays of a cone: the Triton kernels against the reference, and cut off where the CPU's are."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from recon.base.kernel import RayModel, Truncation
from tests.recon.conftest import Make
from tests.recon.helpers import as_leaves, in_double
from tests.recon.kernels import reference
from tests.recon.kernels.gpu.on_gpu import (
    DEVICE,
    EXACT,
    SHAPE,
    UNIT,
    WHOLE,
    assert_gradients,
    cone,
    project_raw,
    raw_of,
)
from tests.recon.kernels.reference import project


def test_exact_rays_and_gradients_equal_the_reference(random_gaussians: Make) -> None:
    geometry, g = cone(), random_gaussians(18, 9.0)
    double = in_double(g)
    errors = reference.affine_error(double.means, double.scales, double.quaternions, geometry, 0)
    halfway = float(errors.sort().values[len(errors) // 2 - 1 : len(errors) // 2 + 1].mean())  # no Gaussian's own error
    for worst in (0.0, halfway):
        raw, double = raw_of(g, DEVICE), in_double(g)
        found = project_raw(*raw, UNIT, geometry, *WHOLE, RayModel(exact_above=worst))[0]
        physical = (double.means, double.scales, double.quaternions, double.densities)
        expected = reference.project_view(physical, geometry, 0, exact=errors > worst)
        assert float((found.detach().cpu() - expected.detach()).abs().max()) < 5e-6 * float(expected.detach().max())
        weights = torch.from_numpy(np.random.default_rng(3).normal(size=expected.shape))
        (found * weights.float().to(DEVICE)).sum().backward()
        (expected * weights).sum().backward()
        assert_gradients(raw, double)


@pytest.mark.parametrize("cut", [1.5, 3.0])
def test_exact_rays_end_where_the_cpus_end(cut: float, random_gaussians: Make) -> None:
    # To the pixel; and forward and backward agree on where.
    g, geometry = random_gaussians(12, 9.0), cone()
    raw, ours = raw_of(g, DEVICE), as_leaves(g)
    found = project_raw(*raw, g.density_unit, geometry, 1e-4, cut, EXACT)[0]
    faint = 1e-4 / (g.density_unit * geometry.sample_pitch * SHAPE[1])
    expected = project(ours, geometry, truncation=Truncation(cut, faint), model=EXACT)[0]
    np.testing.assert_allclose(found.detach().cpu(), expected.detach(), atol=1e-5 * float(expected.detach().max()))
    y = torch.from_numpy(np.random.default_rng(4).normal(size=SHAPE).astype(np.float32))
    (found * y.to(DEVICE)).sum().backward()
    (expected * y).sum().backward()
    assert_gradients(raw, ours, 1e-4)
    assert raw[3].grad is not None
    back = raw[3].grad.cpu().double() / (g.density_unit * torch.sigmoid(g.raw_densities.double()))
    left, right = float((found.detach().cpu() * y).double().sum()), float((g.densities.double() * back).sum())
    assert left == pytest.approx(right, rel=2e-5)
