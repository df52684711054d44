"""Gaussians: activations, copies and checkpoints."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.splatting.gaussians import Gaussians, inverse_softplus, needles
from tests.recon.conftest import Make

VIEWS = Geometry.parallel([0.0, 1.0], (8, 8), pixel_pitch=0.2)  # half a pixel is 0.1 mm


def test_mass_is_shared_among_thin_long_and_round_ones() -> None:
    widths = np.array([[0.3, 0.3, 0.3], [0.05, 1.0, 0.06], [0.09, 0.4, 0.2], [0.2, 3.0, 0.2]])
    mass = np.array([4.0, 1.0, 2.0, 3.0])  # round, needle, thin, long but resolved
    model = Gaussians.from_physical(np.zeros((4, 3)), widths, mass / widths.prod(axis=1))
    found = needles(model, VIEWS)
    assert found.thin == pytest.approx(0.3, abs=1e-5)
    assert found.share == pytest.approx(0.1, abs=1e-5)
    assert found.aspect == pytest.approx(0.4 / 0.09, rel=1e-4)


def test_physical_values_come_back() -> None:
    g = Gaussians.from_physical(np.zeros((2, 3)), [[0.1, 1.0, 10.0], [2.0, 2.0, 2.0]], [1e-4, 5.0], density_unit=0.5)
    np.testing.assert_allclose(g.scales.numpy(), [[0.1, 1.0, 10.0], [2.0, 2.0, 2.0]], rtol=1e-6)
    np.testing.assert_allclose(g.densities.numpy(), [1e-4, 5.0], rtol=1e-5)


@given(st.floats(1e-6, 1e3))
def test_inverse_softplus_is_the_inverse(value: float) -> None:
    assert np.logaddexp(0, inverse_softplus(np.asarray(value))) == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize("kernel", Kernel)
def test_some_of_them_keep_unit_and_kernel(random_gaussians: Make, kernel: Kernel) -> None:
    g = random_gaussians(kernel=kernel)
    some = g.select(torch.tensor([2, 0]))
    assert torch.equal(some.means, g.means[[2, 0]]) and (some.density_unit, some.kernel) == (g.density_unit, kernel)


@pytest.mark.parametrize(("scales", "densities"), [([0.0], [1.0]), ([1.0], [-1.0]), ([np.nan], [1.0])])
def test_impossible_values_are_refused(scales: list[float], densities: list[float]) -> None:
    with pytest.raises(ValueError, match="positive and finite"):
        Gaussians.from_physical(np.zeros((1, 3)), scales, densities)


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="quaternions"):
        Gaussians(torch.zeros(2, 3), torch.zeros(2, 3), torch.zeros(2, 3), torch.zeros(2))
