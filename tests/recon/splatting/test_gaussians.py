"""Gaussians: activations, copies and checkpoints."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from recon.base.kernel import Kernel
from recon.splatting.gaussians import Gaussians, inverse_softplus
from tests.recon.conftest import Make


def test_physical_values_come_back() -> None:
    g = Gaussians.from_physical(np.zeros((2, 3)), [[0.1, 1, 10], [2, 2, 2]], [1e-4, 5.0], density_unit=0.5)
    np.testing.assert_allclose(g.scales.numpy(), [[0.1, 1, 10], [2, 2, 2]], rtol=1e-6)
    np.testing.assert_allclose(g.densities.numpy(), [1e-4, 5.0], rtol=1e-5)


@given(st.floats(1e-6, 1e3))
def test_inverse_softplus_is_the_inverse(value: float) -> None:
    assert np.logaddexp(0, inverse_softplus(np.asarray(value))) == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize("kernel", Kernel)
def test_a_checkpoint_restores_every_bit(random_gaussians: Make, kernel: Kernel) -> None:
    g = random_gaussians(kernel=kernel)
    back = Gaussians.from_arrays(g.arrays())
    for name in ("means", "log_scales", "quaternions", "raw_densities"):
        assert torch.equal(getattr(g, name), getattr(back, name))
    assert (g.density_unit, g.kernel) == (back.density_unit, back.kernel)
    assert g.select(torch.tensor([2, 0])).kernel is kernel
    older = {name: values for name, values in g.arrays().items() if name != "kernel_exponent"}
    assert Gaussians.from_arrays(older).kernel is Kernel.GAUSSIAN


def test_an_incomplete_checkpoint_is_refused(random_gaussians: Make) -> None:
    arrays = random_gaussians().arrays()
    del arrays["quaternions"]
    with pytest.raises(ValueError, match="quaternions"):
        Gaussians.from_arrays(arrays)


@pytest.mark.parametrize(("scales", "densities"), [([0.0], [1.0]), ([1.0], [-1.0]), ([np.nan], [1.0])])
def test_impossible_values_are_refused(scales: list[float], densities: list[float]) -> None:
    with pytest.raises(ValueError, match="positive and finite"):
        Gaussians.from_physical(np.zeros((1, 3)), scales, densities)


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="quaternions"):
        Gaussians(torch.zeros(2, 3), torch.zeros(2, 3), torch.zeros(2, 3), torch.zeros(2))
