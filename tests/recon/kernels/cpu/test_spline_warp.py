"""Volumes displaced by cubic splines: compared with SciPy; the slopes with differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from recon.base.arrays import F32
from recon.kernels.cpu.spline_warp import coefficients, pull


@pytest.fixture(params=[(11, 9, 7), (12, 10, 1), (8, 8, 2)], ids=str)
def volume(request: pytest.FixtureRequest, rng: np.random.Generator) -> F32:
    return rng.standard_normal(request.param).astype(np.float32)


def pulled(volume: F32, u: F32, first: tuple[int, int, int] = (0, 0, 0)) -> tuple[F32, F32]:
    out, slopes = np.empty(u.shape[1:], np.float32), np.empty_like(u)
    pull(coefficients(volume), u, first, out, slopes)
    return out, slopes


def test_values_are_those_of_scipy_and_beyond_the_edge_those_of_the_edge(volume: F32, rng: np.random.Generator) -> None:
    u = (2 * rng.standard_normal((3, *volume.shape))).astype(np.float32)
    limits = np.array(volume.shape).reshape(3, 1, 1, 1) - 1.0
    places = np.clip(np.indices(volume.shape) + u, 0, limits)
    expected = map_coordinates(volume.astype(float), places, order=3, mode="mirror")
    np.testing.assert_allclose(pulled(volume, u)[0], expected, atol=5e-5)


def test_without_a_displacement_the_volume_stays_and_a_box_is_cut(volume: F32) -> None:
    still = np.zeros((3, *volume.shape), np.float32)
    np.testing.assert_allclose(pulled(volume, still)[0], volume, atol=2e-5)
    inner = np.zeros((3, 3, 4, 1), np.float32)
    np.testing.assert_allclose(pulled(volume, inner, (2, 3, 0))[0], volume[2:5, 3:7, :1], atol=2e-5)


def test_slopes_are_the_derivatives_by_the_displacement(volume: F32, rng: np.random.Generator) -> None:
    u = rng.uniform(0.1, 0.4, (3, *volume.shape)).astype(np.float32)
    u[:, -1], u[:, :, -1], u[..., -1] = 0, 0, 0  # places at the upper edge have one-sided slopes
    slopes, step = pulled(volume, u)[1], 2e-3
    inner = (slice(0, -1), slice(0, -1), slice(0, max(1, volume.shape[2] - 1)))
    for axis in range(3):
        if volume.shape[axis] == 1:
            np.testing.assert_array_equal(slopes[axis], 0)
            continue
        more, less = u.copy(), u.copy()
        more[axis] += step
        less[axis] -= step
        by_differences = (pulled(volume, more)[0] - pulled(volume, less)[0]) / (2 * step)
        np.testing.assert_allclose(slopes[axis][inner], by_differences[inner], atol=1e-2)
