"""The density of Gaussians at points: against the voxel reference and differences; points brought onto a level."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from recon.base.kernel import Kernel
from recon.base.volume import Grid
from recon.features import surfaces as module
from recon.features.surfaces import density_at, on_level
from recon.splatting.gaussians import Gaussians
from tests.recon.kernels import reference


def some(kernel: Kernel, n: int = 30) -> Gaussians:
    rng = np.random.default_rng(1)
    return Gaussians.from_physical(
        rng.uniform(-1, 1, (n, 3)), rng.uniform(0.1, 0.5, (n, 3)), rng.uniform(0.5, 2, n), rng.normal(size=(n, 4)),
        kernel=kernel,
    )  # fmt: skip


@pytest.mark.parametrize("kernel", Kernel)
def test_density_is_that_of_the_reference_and_its_gradient_its_differences(
    kernel: Kernel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "TOGETHER", 7)
    monkeypatch.setattr(module, "PAIRS", 500)
    g, (z, y, x) = some(kernel), Grid((5, 6, 7), 0.3).coordinates()
    points = np.stack(np.broadcast_arrays(x[None, None], y[None, :, None], z[:, None, None]), -1).reshape(-1, 3)
    density, gradient = density_at(g, points)
    parameters = [t.double() for t in (g.means, g.scales, g.quaternions, g.densities)]
    axes = tuple(torch.from_numpy(axis) for axis in (z, y, x))
    expected = reference.voxelize(*parameters, axes, kernel).numpy().ravel()  # type: ignore[arg-type]
    np.testing.assert_allclose(density, expected, atol=2e-5 * expected.max())
    step = 1e-6
    for axis, shift in enumerate(step * np.eye(3)):
        slope = (density_at(g, points + shift)[0] - density_at(g, points - shift)[0]) / (2 * step)
        np.testing.assert_allclose(gradient[:, axis], slope, atol=1e-3 * np.abs(gradient).max())


@pytest.mark.parametrize("kernel", Kernel)
def test_points_come_onto_a_sphere_of_the_level(kernel: Kernel) -> None:
    """One round Gaussian of width 0.4 and density 2: σ = 1 is a sphere."""
    one = Gaussians.from_physical([[0.1, 0.2, -0.1]], [0.4], [2.0], kernel=kernel)
    half = np.sqrt(2 * np.log(2)) if not kernel.is_compact else kernel.radius * np.sqrt(1 - 0.5 ** (1 / 1.5))
    rng = np.random.default_rng(0)
    outward = rng.normal(size=(50, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    centre, radius = np.array([0.1, 0.2, -0.1]), 0.4 * half
    found = on_level(one, centre + (radius + rng.uniform(-0.04, 0.04, (50, 1))) * outward, 1.0, voxel=0.1)
    np.testing.assert_allclose(np.linalg.norm(found - centre, axis=1), radius, rtol=1e-5)


def test_a_point_far_from_the_level_stays() -> None:
    one = Gaussians.from_physical([[0.0, 0.0, 0.0]], [0.4], [2.0])
    far = np.array([[5.0, 0, 0]])
    np.testing.assert_array_equal(on_level(one, far, 1.0, voxel=0.1), far)
