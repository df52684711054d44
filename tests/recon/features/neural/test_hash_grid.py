"""The hash grid of numba: against torch's own slopes, its transpose, and a linear function that it holds exactly."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from recon.features.neural.networks import HashGrid, gather_in_torch
from recon.kernels.cpu.hash_grid import gather, scatter

F32 = NDArray[np.float32]


@pytest.fixture(scope="module")
def grid() -> HashGrid:
    """Levels of 16 and 32 cubes; the finer one shares 2^12 entries among 33³ corners."""
    made = HashGrid(levels=2, log2_table=13)
    made.start(torch.Generator().manual_seed(0))
    assert made.sides.tolist() == [17, 33] and np.diff(made.firsts).tolist() == [17**3, 2**13]
    return made


@pytest.fixture(scope="module")
def points() -> F32:
    """Anywhere in the box, on its corners and on corners of cubes."""
    rng = np.random.default_rng(1)
    found = rng.random((500, 3), np.float32)
    found[0], found[1], found[2] = 0, 1, 0.5
    return found


def test_features_and_their_slopes_are_those_of_torch(grid: HashGrid, points: F32) -> None:
    given = torch.from_numpy(points).reshape(5, 100, 3)
    weights = torch.from_numpy(np.random.default_rng(2).normal(size=(5, 100, 4)).astype(np.float32))
    grid.table.grad = None
    ours = grid(given)
    (ours * weights).sum().backward()
    slopes = grid.table.grad
    theirs = gather_in_torch(given, grid.table, grid.sides, grid.firsts)
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-9)
    expected = torch.autograd.grad((theirs * weights).sum(), grid.table)[0]
    assert slopes is not None and expected.abs().max() > 1
    torch.testing.assert_close(slopes, expected, rtol=1e-4, atol=1e-5)


def test_scatter_is_the_transpose_of_gather(grid: HashGrid, points: F32, rng: np.random.Generator) -> None:
    table = rng.normal(size=tuple(grid.table.shape)).astype(np.float32)
    slopes = rng.normal(size=(len(points), 4)).astype(np.float32)
    found, back = np.empty_like(slopes), np.zeros_like(table)
    gather(points, table, grid.sides, grid.firsts, found)
    scatter(points, slopes, grid.sides, grid.firsts, back)
    assert np.vdot(found.astype(float), slopes) == pytest.approx(np.vdot(table.astype(float), back), rel=1e-5)


def test_a_dense_level_holds_a_linear_function_exactly(points: F32) -> None:
    """Corner (i, j, k) of 17 lies at (i - 1/2) / 15 of the box: 16 cubes, half of one beyond each side."""
    grid = HashGrid(levels=1, log2_table=13)
    z, y, x = np.meshgrid(*[(np.arange(17) - 0.5) / 15] * 3, indexing="ij")
    table = np.stack((x + 2 * y - z, z), -1).reshape(-1, 2).astype(np.float32)
    found = np.empty((len(points), 2), np.float32)
    gather(points, table, grid.sides, grid.firsts, found)
    np.testing.assert_allclose(found[:, 0], points @ [1, 2, -1], atol=3e-6)
    np.testing.assert_allclose(found[:, 1], points[:, 2], atol=3e-6)
