"""Windows and slopes of volumes: those of scipy and numpy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import correlate1d

from recon.kernels.cpu.slopes import slopes_at, windowed

SHAPES = [(1, 1, 1), (2, 3, 5), (9, 20, 7), (1, 18, 40)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("taps", [1, 3, 9])
def test_the_window_runs_along_each_axis(shape: tuple[int, int, int], taps: int, rng: np.random.Generator) -> None:
    x, window = rng.random(shape, dtype=np.float32), rng.random(taps, dtype=np.float32)
    out = np.empty_like(x)
    windowed(x, window, out)
    expected = x.astype(np.float64)
    for axis in range(3):
        expected = correlate1d(expected, window, axis, mode="nearest")
    np.testing.assert_allclose(out, expected, rtol=1e-5)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_slope_is_the_length_of_the_gradient(shape: tuple[int, int, int], rng: np.random.Generator) -> None:
    x = rng.random(shape, dtype=np.float32)
    voxels = rng.permutation(x.size)[: max(1, x.size // 2)]
    found = np.empty(voxels.size, np.float32)
    slopes_at(x, voxels, found)
    around = np.pad(x, 1, mode="edge")
    gradient = np.stack([np.gradient(around, axis=axis)[1:-1, 1:-1, 1:-1] for axis in range(3)])
    np.testing.assert_allclose(found, np.linalg.norm(gradient, axis=0).ravel()[voxels], rtol=1e-5, atol=1e-7)
