"""Voxels and what flows back from them: the Triton kernels against the reference."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from recon.base.volume import Grid
from tests.recon.conftest import Make
from tests.recon.helpers import in_double
from tests.recon.kernels import reference
from tests.recon.kernels.gpu.on_gpu import (
    DEVICE,
    UNIT,
    WHOLE,
    assert_gradients,
    raw_of,
    voxelize_raw,
)


@pytest.mark.parametrize("grid", [Grid((9, 12, 10), 0.6, (0.4, -0.8, 1.1)), Grid((5, 9, 8), 0.7, slice_pitch=1.3)])
def test_voxels_and_gradients_equal_the_reference(grid: Grid, random_gaussians: Make, rng: np.random.Generator) -> None:
    g = random_gaussians(16, 8.0)
    raw, double = raw_of(g, DEVICE), in_double(g)
    found = voxelize_raw(*raw, UNIT, grid, *WHOLE)
    z, y, x = (torch.from_numpy(axis) for axis in grid.coordinates())
    expected = reference.voxelize(double.means, double.scales, double.quaternions, double.densities, (z, y, x))
    assert float((found.cpu() - expected).detach().abs().max()) < 3e-6 * float(expected.detach().max())
    weights = torch.from_numpy(rng.normal(size=grid.shape))
    (found * weights.float().to(DEVICE)).sum().backward()
    (expected * weights).sum().backward()
    assert_gradients(raw, double)
