"""What trials prefer, by their scores, and on which part of a scan they are made."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import recon
from recon.auto import part_of
from recon.base.method import DataUse, ReconProblem
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
    part, _ = part_of(ReconProblem(data, views, grid, DataUse(), 0, "cpu"))
    assert part is not None and part.grid.shape[0] * part.grid.spacing[0] < 0.7 * grid.shape[0] * grid.spacing[0]
    found = Projector(part.geometry, part.grid).forward(column(part.grid))
    np.testing.assert_allclose(found, part.projections, atol=0.005 * data.max())
