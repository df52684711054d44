"""The scores of test reconstructions, and the part of a cone scan on which they are made."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import recon
from recon.voxels.field_edges import middle_of_cone
from recon.voxels.projector import Projector

F32 = NDArray[np.float32]


def test_no_ray_of_the_middle_rows_leaves_their_box() -> None:
    """A sample that fills it throws the same line integrals there as one that goes on above and below."""
    views = recon.Geometry.cone(np.linspace(0, 2 * np.pi, 24, endpoint=False), (80, 64), 1.0, 150.0, 300.0)
    grid = recon.Grid.matching(views)

    def column(box: recon.Grid) -> F32:
        _, y, x = np.meshgrid(*box.coordinates(), indexing="ij")
        return np.exp(-(x**2 + y**2) / (2 * 5**2)).astype(np.float32)

    data = Projector(views, grid).forward(column(grid))
    middle = middle_of_cone(views, grid, data, 32)
    assert middle is not None
    rows, part, box = middle
    assert box.shape[0] * box.spacing[0] < 0.7 * grid.shape[0] * grid.spacing[0]
    found = Projector(part, box).forward(column(box))
    np.testing.assert_allclose(found, data[:, rows], atol=0.005 * data.max())
