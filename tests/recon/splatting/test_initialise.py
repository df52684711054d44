"""From a volume to Gaussians: they are in the sample, match the scale of the data; wrong volumes are errors."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.splatting.initialise import (
    first_volume,
    mean_change,
    morton_order,
    place,
    sample_gaussians,
    scale_to_data,
)
from recon.splatting.splat import project
from recon.voxels.field_edges import edges_of
from recon.voxels.projector import Projector
from tests.messages import refused
from tests.recon.conftest import Make


def _ball(radius: float = 6.0) -> Volume:
    grid = Grid((20, 24, 24), 0.5, centre=(1.0, 0.0, 0.0))
    z, y, x = grid.coordinates()
    inside = (x[None, None] - 1) ** 2 + y[None, :, None] ** 2 + (z[:, None, None] - 1) ** 2 < (radius / 2) ** 2
    return Volume(inside.astype(np.float32), grid)


def test_gaussians_sit_in_the_matter(rng: np.random.Generator) -> None:
    placed = sample_gaussians(_ball(), 400, rng, field_radius=6.0, smooth=0.5)
    assert placed.n == 400
    away = np.linalg.norm(placed.means.numpy() - [1.0, 0.0, 1.0], axis=1)
    assert away.max() < 3.0 + 2 * 0.5
    np.testing.assert_allclose(placed.means.numpy().mean(0), [1.0, 0.0, 1.0], atol=0.3)


def test_more_sit_where_the_density_changes(rng: np.random.Generator) -> None:
    # Half of the weight is gradient: without it the shell would hold its share of the volume, 1 - (2/3)³ = 0.70.
    volume = _ball()
    placed = sample_gaussians(volume, 400, rng, field_radius=6.0, smooth=0.5)
    away = np.linalg.norm(placed.means.numpy() - [1.0, 0.0, 1.0], axis=1)
    assert (away > 2.0).mean() > 0.8


def test_nothing_is_placed_outside_the_field(rng: np.random.Generator) -> None:
    placed = sample_gaussians(_ball(), 400, rng, field_radius=2.0)
    assert np.hypot(*placed.means.numpy()[:, :2].T).max() < 2.0 + 0.5


def test_the_edge_near_an_axis_off_the_middle_does_not_count() -> None:
    views = Geometry.parallel(np.linspace(0, 2 * np.pi, 8, endpoint=False), (3, 24), axis_col=4.0)
    chords = 2 * np.sqrt(np.maximum(15.0**2 - (np.arange(24) - 4.0) ** 2, 0)).astype(np.float32)
    assert chords[0] > 0 and not edges_of(Views(np.broadcast_to(chords, (8, 3, 24)), views)).beyond(0.0)


def test_a_sample_wider_than_the_field_gets_gaussians_up_to_the_corners(rng: np.random.Generator) -> None:
    views = Geometry.parallel(np.linspace(0, np.pi, 24, endpoint=False), (4, 24))
    wide, narrow = Grid((4, 24, 24)), Grid((4, 12, 12))
    for grid, corners in ((wide, True), (narrow, False)):
        data = Projector(views, grid).forward(np.ones(grid.shape, np.float32))
        means = place(first_volume(data, views, wide), Views(data, views), 500, rng).means.numpy()
        assert bool((np.hypot(*means[:, :2].T) > 12.5).any()) == corners


def test_places_scatter_over_their_voxel_whatever_its_shape(rng: np.random.Generator) -> None:
    grid = Grid((9, 30, 30), 0.2, slice_pitch=1.5)
    volume = Volume(np.ones(grid.shape, np.float32), grid)
    means = sample_gaussians(volume, 3000, rng, field_radius=10.0, smooth=0).means.numpy()
    for found, centres, edge in zip(means.T, grid.coordinates()[::-1], grid.spacing[::-1], strict=True):
        off = np.abs(found[:, None] - centres).min(1)
        assert off.mean() == pytest.approx(edge / 4, rel=0.05)  # of what is uniform over one voxel


def test_fewer_voxels_give_fewer_gaussians(rng: np.random.Generator) -> None:
    assert sample_gaussians(_ball(2.0), 10**6, rng, field_radius=6.0, smooth=0).n < 40


@pytest.mark.parametrize("n", [1, 2, 3])
def test_very_few_gaussians_are_a_model_too(rng: np.random.Generator, n: int) -> None:
    placed = sample_gaussians(_ball(), n, rng, field_radius=6.0)
    assert placed.n == n and bool((placed.scales > 0).all()) and bool(placed.scales.isfinite().all())


@pytest.mark.parametrize("span", [np.pi / 5, np.pi / 2, np.pi])
def test_the_unit_is_a_density_of_the_sample_however_narrow_the_views(span: float) -> None:
    # A Gaussian of peak 1, sigma 3: its line integrals are sigma √(2π) times a Gaussian, from every side.
    views = Geometry.parallel(np.linspace(0, span, 30, endpoint=False), (16, 40))
    u, v = np.arange(40) - 19.5, np.arange(16) - 7.5
    shadow = 3 * np.sqrt(2 * np.pi) * np.exp(-(u[None] ** 2 + v[:, None] ** 2) / 18)
    data = np.broadcast_to(shadow, (30, 16, 40)).astype(np.float32)
    first = first_volume(data, views, Grid.matching(views))
    placed = place(first, Views(data, views), 500, np.random.default_rng(0))
    assert 0.3 < placed.density_unit < 2


@pytest.mark.parametrize("count", [0, -5])
def test_no_gaussians_are_refused(count: int, rng: np.random.Generator) -> None:
    views = Geometry.parallel([0.0, 1.0], (4, 6))
    with refused(ValueError):
        place(_ball(), Views(np.ones((2, 4, 6), np.float32), views), count, rng)


def test_an_empty_volume_is_refused(rng: np.random.Generator) -> None:
    with refused(ValueError):
        sample_gaussians(Volume(np.zeros((4, 4, 4), np.float32), Grid((4, 4, 4))), 10, rng, field_radius=5)


@pytest.mark.parametrize("factor", [0.01, 1.0, 250.0])
def test_the_density_scale_is_the_least_squares_factor(random_gaussians: Make, factor: float) -> None:
    g = random_gaussians()
    views = Geometry.parallel(np.linspace(0, 3, 7), (20, 24), pixel_pitch=0.6)
    data = np.float32(factor) * project(g, views).numpy()
    np.testing.assert_allclose(scale_to_data(g, data, views).densities, factor * g.densities, rtol=1e-3)


def test_negative_data_are_refused(random_gaussians: Make) -> None:
    g = random_gaussians()
    views = Geometry.parallel([0.0, 1.0], (20, 24), pixel_pitch=0.6)
    with refused(ValueError):
        scale_to_data(g, -project(g, views).numpy(), views)


def test_morton_order_is_a_permutation_that_keeps_neighbours(rng: np.random.Generator) -> None:
    means = rng.uniform(0, 16, (2000, 3)).astype(np.float32)
    order = morton_order(means, 1.0)
    assert sorted(order.tolist()) == list(range(2000))
    walk = np.linalg.norm(np.diff(means[order], axis=0), axis=1).mean()
    assert walk < 0.35 * np.linalg.norm(np.diff(means, axis=0), axis=1).mean()


def test_the_change_of_matter_is_its_variation_over_its_voxels() -> None:
    """By numpy, for a tube along the axis; a full cylinder of the same radius changes less."""
    geometry = Geometry.parallel(np.linspace(0, np.pi, 90, endpoint=False), (6, 40))
    grid = Grid.matching(geometry)
    y, x = np.indices((40, 40)) - 19.5
    data, found = [], []
    for inner in (8, 0):
        tube = 0.3 * ((np.hypot(x, y) <= 12) & (np.hypot(x, y) >= inner))
        data.append(Projector(geometry, grid).forward(np.tile(tube.astype(np.float32), (6, 1, 1))))
        found.append(mean_change(data[-1], geometry, grid))
    volume = np.maximum(first_volume(data[0], geometry, grid).data, 0)
    unit = np.percentile(volume[volume > 0], 99.5)
    forward = [np.diff(volume, axis=axis, append=np.take(volume, [-1], axis)) for axis in range(3)]
    expected = np.sqrt(np.square(forward).sum(axis=0)).sum() / np.count_nonzero(volume > 0.05 * unit) / unit
    assert found[0] == pytest.approx(expected, rel=1e-3)
    assert found[1] < found[0]
    assert mean_change(data[0], geometry, grid, first_volume(data[0], geometry, grid)) == pytest.approx(
        found[0], rel=1e-6
    )
    assert mean_change(7 * data[0], geometry, grid) == pytest.approx(found[0], rel=1e-3)
    assert mean_change(0 * data[0], geometry, grid) == 0
