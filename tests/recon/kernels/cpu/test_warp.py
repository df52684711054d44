"""Displaced volumes: compared with SciPy's interpolation; the transpose; the slope of a trilinear function."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from recon.base.arrays import F32
from recon.kernels.cpu.warp import pull, push, slopes

SHAPE = (21, 9, 12)


@pytest.fixture
def moved(rng: np.random.Generator) -> tuple[F32, F32, F32]:
    """A volume, another one, and displacements of which some lead far beyond."""
    x, y = (rng.standard_normal(SHAPE).astype(np.float32) for _ in range(2))
    return x, y, (4 * rng.standard_normal((3, *SHAPE))).astype(np.float32)


def test_values_are_those_of_trilinear_interpolation_with_zeros_outside(moved: tuple[F32, F32, F32]) -> None:
    x, _, u = moved
    out = np.empty_like(x)
    pull(x, u, out)
    wide = np.pad(x, 2)
    places = np.indices(SHAPE) + u + 2
    limits = np.array(wide.shape).reshape(3, 1, 1, 1) - 1.0
    np.testing.assert_allclose(out, map_coordinates(wide, np.clip(places, 0, limits), order=1), atol=2e-5)


def test_push_is_the_transpose_of_pull_to_the_same_bits_with_one_thread(moved: tuple[F32, F32, F32]) -> None:
    x, y, u = moved
    forward, back, alone = (np.empty_like(x) for _ in range(3))
    pull(x, u, forward)
    push(y, u, back)
    assert np.vdot(forward.astype(float), y) == pytest.approx(np.vdot(x.astype(float), back), rel=1e-5)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    push(y, u, alone)
    numba.set_num_threads(threads)
    assert np.array_equal(alone, back)


def test_slopes_are_the_derivatives_within_a_cell(moved: tuple[F32, F32, F32], rng: np.random.Generator) -> None:
    """Along one axis the function is linear between voxels: differences within a cell are exact."""
    x, _, _ = moved
    u = (rng.integers(-2, 3, (3, *SHAPE)) + rng.uniform(0.2, 0.8, (3, *SHAPE))).astype(np.float32)
    out, low, high = np.empty_like(u), np.empty_like(x), np.empty_like(x)
    slopes(x, u, out)
    for axis in range(3):
        step = np.zeros((3, 1, 1, 1), np.float32)
        step[axis] = 0.125
        pull(x, u - step, low)
        pull(x, u + step, high)
        np.testing.assert_allclose(out[axis], (high - low) / 0.25, atol=1e-4)
