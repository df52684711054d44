"""Stray mass: density in regions that projections show to be empty, in a ball with and without a blob."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import recon
from recon.base.geometry import Geometry
from recon.base.view_data import Views
from recon.voxels.matter_checks import STRAY_LIMIT, seen_empty, stray_mass
from tests.recon.voxels.test_projector import ellipsoid_shadow, smooth_ball

AXES, CENTRE = np.array([0.4, 0.3, 0.25]), np.array([0.08, -0.1, 0.06])
GRID = recon.Grid((28, 32, 32), 0.04)
BLOB = slice(12, 15), slice(3, 6), slice(24, 27)


def views(count: int, cone: bool) -> Geometry:
    angles = np.linspace(0, 2 * np.pi if cone else np.pi, count, endpoint=False)
    if cone:
        return Geometry.cone(angles, (32, 38), 0.06, 8.0, 12.0)
    return Geometry.parallel(angles, (32, 38), pixel_pitch=0.04)


def scan(geometry: Geometry, rng: np.random.Generator, noise: float = 0.003) -> np.ndarray:
    data = ellipsoid_shadow(geometry, AXES, CENTRE)
    return (data + rng.normal(0, noise, data.shape)).astype(np.float32)


@pytest.mark.parametrize("cone", [False, True])
@pytest.mark.parametrize("count", [5, 10])
def test_a_blob_where_views_show_nothing_is_all_that_is_stray(count: int, cone: bool, rng: np.random.Generator) -> None:
    geometry, truth = views(count, cone), smooth_ball(GRID, AXES, CENTRE)
    data = scan(geometry, rng)
    clean = stray_mass(recon.Volume(truth, GRID), Views(data, geometry))
    assert seen_empty(Views(data, geometry), GRID)[0].mean() > 0.4 and clean is not None and clean.share == 0
    spoiled = truth.copy()
    spoiled[BLOB] += 0.5
    found = stray_mass(recon.Volume(spoiled, GRID), Views(data, geometry))
    assert found is not None
    blob = 0.5 * 27 / spoiled.sum()
    assert 0.3 * blob < found.share < 1.001 * blob  # few of its voxels are past the ball in fewer than two views
    assert found.map[BLOB[1:]].any()
    found.map[BLOB[1:]] = 0
    assert not found.map.any()


@pytest.mark.parametrize("cone", [False, True])
def test_no_voxel_of_matter_is_shown_to_be_empty(cone: bool, rng: np.random.Generator) -> None:
    geometry, truth = views(20, cone), smooth_ball(GRID, AXES, CENTRE)
    for noise in (0.0, 0.003, 0.03):
        empty, _ = seen_empty(Views(scan(geometry, rng, noise), geometry), GRID)
        assert not empty[truth > 0.5].any()
        assert empty.mean() > 0.4


def test_rays_that_were_not_measured_show_nothing(rng: np.random.Generator) -> None:
    geometry = views(5, False)
    weights = np.ones((5, 32, 38), np.float32)
    weights[:, :, 24:] = 0
    data = scan(geometry, rng)
    empty, _ = seen_empty(Views(data, geometry, weights), GRID)
    assert 0 < empty.sum() < seen_empty(Views(data, geometry), GRID)[0].sum()
    assert stray_mass(recon.Volume(np.zeros(GRID.shape, np.float32), GRID), Views(data, geometry)) is None


@pytest.mark.parametrize("count", [5, 10])
def test_few_views_leave_less_in_the_air_of_a_fit_than_of_fbp(count: int, rng: np.random.Generator) -> None:
    geometry = views(count, False)
    data = scan(geometry, rng, 0.02)
    shares = []
    for method in (recon.Fbp(), recon.R2(steps=60, gaussians=300, finish=4)):
        found = stray_mass(recon.reconstruct(data, geometry, method, grid=GRID).volume, Views(data, geometry))
        assert found is not None
        shares.append(found.share)
    assert shares[0] > STRAY_LIMIT > 0.02 > shares[1]


@pytest.mark.parametrize("axis", [0.0, 5.0])
def test_the_level_of_air_is_where_every_view_sees_none(axis: float, rng: np.random.Generator) -> None:
    """Beyond the field of all views FBP means nothing; matter that fills most of it is no air."""
    wide = Geometry.parallel(np.linspace(0, np.pi, 30, endpoint=False), (32, 38), pixel_pitch=0.04)
    geometry = replace(wide, axis_col=wide.axis_col + axis)
    grid = recon.Grid.matching(geometry)
    truth = smooth_ball(grid, AXES, CENTRE)
    level = truth - 0.02
    _, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    for angle in geometry.angles:
        col = geometry.axis_col + (x * np.cos(angle) + y * np.sin(angle)) / 0.04
        level[(col < -1.5) | (col > 38.5)] = 7.0
    found = stray_mass(recon.Volume(level, grid), Views(scan(geometry, rng), geometry))
    assert found is not None and found.air.sum() > 1000
    mean, spread = found.level(recon.Volume(level, grid))
    assert mean == pytest.approx(-0.02, abs=1e-3) and spread < 2e-3
