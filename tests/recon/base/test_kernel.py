"""The constants of the kernels compared with integrals of their profiles; their names and exponents in files."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from recon.base.kernel import Kernel
from tests.recon.kernels.reference import density_profile, shadow_profile


def f(r: float, kernel: Kernel) -> float:
    return float(density_profile(torch.tensor(r * r, dtype=torch.float64), kernel))


def end(kernel: Kernel) -> float:
    return min(kernel.radius, 12.0)


@pytest.mark.parametrize("kernel", Kernel)
def test_its_second_moment_is_that_of_the_unit_gaussian(kernel: Kernel) -> None:
    # Of one axis, a third of r²: a covariance means the same with every kernel.
    mass = quad(lambda r: f(r, kernel) * r**2, 0, end(kernel))[0]
    assert quad(lambda r: f(r, kernel) * r**4, 0, end(kernel))[0] / (3 * mass) == pytest.approx(1, rel=1e-6)


@pytest.mark.parametrize("kernel", Kernel)
@pytest.mark.parametrize("distance", [0.0, 0.7, 1.9, 2.8, 3.5])
def test_its_shadow_is_its_line_integral(kernel: Kernel, distance: float) -> None:
    half = math.sqrt(max(end(kernel) ** 2 - distance**2, 0))
    expected = 2 * quad(lambda s: f(math.hypot(s, distance), kernel), 0, half)[0]
    found = kernel.length * float(shadow_profile(torch.tensor(distance**2, dtype=torch.float64), kernel))
    assert found == pytest.approx(expected, abs=1e-6)


def test_a_large_exponent_is_the_gaussian() -> None:
    # (1 - q / (2 m + 5))^m tends to exp(-q / 2), so that infinity stands for the Gaussian in a file.
    q, m = np.linspace(0, 9, 19), 1e6
    np.testing.assert_allclose((1 - q / (2 * m + 5)) ** m, np.exp(-q / 2), atol=1e-5)
    assert Kernel.GAUSSIAN.exponent == Kernel.GAUSSIAN.radius == math.inf


def test_names_and_exponents_lead_back() -> None:
    for kernel in Kernel:
        assert Kernel(str(kernel)) is kernel is Kernel.of_exponent(kernel.exponent)
    with pytest.raises(ValueError, match=r"compact:1.5, got 'box'"):
        Kernel("box")
    with pytest.raises(ValueError, match=r"exponent 2.5.*1.5 \(compact:1.5\)"):
        Kernel.of_exponent(2.5)
