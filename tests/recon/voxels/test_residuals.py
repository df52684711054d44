"""Residuals of a volume for each projection."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.voxels.projector import project
from recon.voxels.residuals import SquaresLeft, residuals_of, squares_left, unseen_residuals
from recon.voxels.resolution import ViewResolution


def test_residuals_leave_out_rays_and_views_that_do_not_count() -> None:
    views, model = np.ones((3, 4, 2), np.float32), np.full((3, 4, 2), 3.0, np.float32)
    views[0, 0], views[1] = np.nan, np.nan
    for geometry in (
        Geometry.parallel(np.zeros(3), (2, 4), pixel_pitch=1.0),
        Geometry.cone(np.zeros(3), (2, 4), sod=10.0, sdd=20.0, pixel_pitch=1.0),
    ):
        resolution = ViewResolution.of(geometry, Grid.matching(geometry))
        np.testing.assert_allclose(unseen_residuals(model, views, None, resolution), [2.0, 2.0], rtol=1e-6)
        assert np.isinf(unseen_residuals(model, views, np.zeros_like(views), resolution)).all()


def test_weights_scale_what_is_left_and_leave_out_rays(rng: np.random.Generator) -> None:
    geometry = Geometry.parallel(np.linspace(0, np.pi, 5, endpoint=False), (3, 20))
    grid = Grid.matching(geometry)
    volume = Volume(rng.random(grid.shape, np.float32), grid)
    data = project(volume, geometry) + rng.normal(0, 1, (5, 3, 20)).astype(np.float32)
    half = np.ones_like(data)
    half[:, :, 10:] = 0
    plain, weighed = (residuals_of(volume, Views(data, geometry, weights)) for weights in (half, 4 * half))
    np.testing.assert_allclose(weighed, 2 * plain, rtol=1e-6)
    alone = Views(np.where(half > 0, data, np.float32(np.nan)), geometry)
    np.testing.assert_allclose(residuals_of(volume, alone), plain, rtol=1e-6)


def test_the_residual_of_all_views_is_the_root_of_the_ratio_of_their_sums() -> None:
    views = np.full((2, 4, 2), 2.0, np.float32)
    views[1] = 4.0
    even = ViewResolution.of(Geometry.parallel(np.zeros(2), (2, 4)), Grid((2, 4, 4)))
    found = squares_left(np.full_like(views, 3.0), views, None, even)
    np.testing.assert_allclose(found.squares, 8.0)
    np.testing.assert_allclose(found.own, [32.0, 128.0])
    assert found.rays.tolist() == [8, 8] and found.residual == pytest.approx(np.sqrt(16 / 160))
    with pytest.raises(ValueError, match="all projections are zero"):
        _ = SquaresLeft(found.squares, np.zeros(2), found.rays).residual
