"""The hash grid holds a linear function exactly, and shares entries where a level has more corners."""

from __future__ import annotations

import numpy as np
import torch

from splatline_neural.networks import HashGrid


def test_a_dense_level_holds_a_linear_function_exactly(rng: np.random.Generator) -> None:
    """Corner (i, j, k) of 17 lies at (i - 1/2) / 15 of the box: 16 cubes, half of one beyond each side."""
    points = np.concatenate((rng.random((500, 3)), [[0, 0, 0], [1, 1, 1], [0.5, 0.5, 0.5]])).astype(np.float32)
    grid = HashGrid(levels=1, log2_table=13)
    z, y, x = np.meshgrid(*[(np.arange(17) - 0.5) / 15] * 3, indexing="ij")
    table = np.stack((x + 2 * y - z, z), -1).reshape(-1, 2).astype(np.float32)
    grid.table.data = torch.from_numpy(table)
    found = grid(torch.from_numpy(points)).detach().numpy()
    np.testing.assert_allclose(found[:, 0], points @ [1, 2, -1], atol=3e-6)
    np.testing.assert_allclose(found[:, 1], points[:, 2], atol=3e-6)


def test_a_fine_level_shares_entries() -> None:
    grid = HashGrid(levels=2, log2_table=13)
    assert grid.sides.tolist() == [17, 33] and np.diff(grid.firsts).tolist() == [17**3, 2**13]
    torch.nn.init.uniform_(grid.table, generator=torch.Generator().manual_seed(0))
    points = torch.rand(100, 5, 3, generator=torch.Generator().manual_seed(1))
    (grid(points) ** 2).sum().backward()
    assert grid.table.grad is not None and (grid.table.grad[17**3 :] != 0).sum() > 2000
