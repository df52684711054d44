"""Rays with a width, on voxels: rotation during the exposure, and rows read one after another."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import recon
from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.ray_width import RayWidth
from recon.base.slabs import bands_of
from recon.base.volume import Grid
from recon.kernels.cpu.spread import spread
from recon.splatting.gaussians import Gaussians
from recon.splatting.splat import project, voxelize
from recon.voxels.fbp import fbp
from recon.voxels.projector import Projector, views_of_exposure
from tests.recon.helpers import assert_transpose, data_residual
from tests.recon.voxels.balls import ball_views
from tests.slow_cases import others_slow

ANGLES = np.arange(9) * 0.37
PARALLEL = Geometry.parallel(ANGLES, (40, 36), pixel_pitch=0.05)
SHIFTED = Geometry.parallel(ANGLES, (40, 36), pixel_pitch=0.05, shifts=np.tile((0.3, -0.7), (9, 1)))
CONE = Geometry.cone(ANGLES, (40, 36), 0.08, 40.0, 60.0)
WIDTH = RayWidth(pixel=1, blur=0.7, arc=0.2)
CASES = {
    "pixel": PARALLEL.seen_with(RayWidth(pixel=1)),
    "wide blur": PARALLEL.seen_with(RayWidth(blur=1.6)),
    "turning": PARALLEL.seen_with(RayWidth(arc=0.2)),
    "skewed": PARALLEL.seen_with(RayWidth(), 2e-3),
    "all, between rows": SHIFTED.seen_with(WIDTH, -2e-3),
    "cone": CONE.seen_with(WIDTH),
}


@pytest.mark.parametrize("name", CASES)
def test_the_transpose_is_exact(name: str, rng: np.random.Generator) -> None:
    assert_transpose(Projector(CASES[name], Grid((38, 30, 33), 0.055)), rng, rel=1e-6)


def test_a_spread_has_its_variances_and_keeps_the_sum(rng: np.random.Generator) -> None:
    point = np.zeros((2, 31, 29), np.float32)
    point[:, 15, 14] = 1
    across = np.array([0.3, 2.0])
    found = spread(point, across, np.full(2, 1.1)).astype(np.float64)
    np.testing.assert_allclose(found.sum((1, 2)), 1, rtol=1e-5)
    col, row = np.arange(31) - 15, np.arange(29) - 14
    np.testing.assert_allclose((found * col[:, None] ** 2).sum((1, 2)), across, rtol=1e-4)
    np.testing.assert_allclose((found * row**2).sum((1, 2)), 1.1, rtol=1e-4)
    assert found.min() >= 0
    edge = rng.random((2, 5, 1), dtype=np.float32)  # nothing is lost at the edges, and one row has no neighbours
    np.testing.assert_allclose(spread(edge, across, np.full(2, 1.1)).sum((1, 2)), edge.sum((1, 2)), rtol=1e-5)


@pytest.mark.parametrize("beam", [PARALLEL, CONE], ids=["parallel", "cone"])
def test_an_exposure_is_the_mean_of_its_moments(beam: Geometry, rng: np.random.Generator) -> None:
    turning, grid = beam.seen_with(RayWidth(arc=0.2)), Grid((8, 30, 33), 0.055)
    volume = rng.random(grid.shape, dtype=np.float32)
    seen = views_of_exposure(turning)
    assert len(seen) == math.ceil(0.2 * beam.reach / beam.sample_pitch)  # a step of at most a pixel at the rim
    assert np.mean([one.angles - beam.angles for one in seen]) == pytest.approx(0)
    expected = np.mean([Projector(one.seen_with(RayWidth()), grid).plain.forward(volume) for one in seen], axis=0)
    np.testing.assert_allclose(Projector(turning, grid).plain.forward(volume), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("skew", [2e-3, -2e-3])
def test_each_row_sees_its_own_angle(skew: float, rng: np.random.Generator) -> None:
    grid = Grid((40, 30, 33), 0.05)
    volume = rng.random(grid.shape, dtype=np.float32)
    found = Projector(PARALLEL.seen_with(RayWidth(), skew), grid).plain.forward(volume)
    bands = bands_of(PARALLEL.seen_with(RayWidth(), skew), grid)
    assert [row for band, _ in bands for row in range(40)[band]] == list(range(40)) and len(bands) == 6
    for band, views in bands:
        for row in range(40)[band]:
            off = np.abs(views.angles - (ANGLES + row * skew)).max() * views.reach / views.pixel_pitch
            assert off < 0.13 and views.skew == 0
        row = (band.start + band.stop) // 2
        np.testing.assert_allclose(found[:, row], Projector(views, grid).plain.forward(volume)[:, row], rtol=1e-4)
        still = Projector(PARALLEL, grid).plain.forward(volume)[:, row]
        assert np.abs(found[:, row] - still).max() > 0.01


def test_rows_and_bins_of_skewed_views_keep_the_angles_of_their_rows() -> None:
    views = PARALLEL.seen_with(WIDTH, 2e-3)
    np.testing.assert_allclose(views.rows(10, 20).angles, ANGLES + 10 * 2e-3)
    binned = views.binned(4)
    np.testing.assert_allclose(binned.angles + 3 * binned.skew, ANGLES + 13.5 * 2e-3)  # rows 12 to 15
    assert (binned.width.pixel, binned.width.blur, binned.width.arc) == (1, 0.7 / 4, 0.2)
    again = views.at(ANGLES[:3])
    assert (again.width, again.skew) == (WIDTH, 2e-3)


def test_gaussians_and_voxels_see_the_same_skew() -> None:
    views = Geometry.parallel(ANGLES, (40, 36), pixel_pitch=0.05).seen_with(RayWidth(), 5e-3)
    centres = np.array([(0.4, 0.2, -0.8), (-0.5, 0.1, 0.8)])
    g = Gaussians.from_physical(centres, np.full((2, 3), 0.12), [1.0, 1.0])
    grid = Grid.matching(views)
    voxels = Projector(views, grid).forward(voxelize(g, grid).numpy())
    still = project(g, replace(views, skew=0.0)).numpy()
    gaussians = project(g, views).numpy()
    assert np.linalg.norm(gaussians - voxels) < 0.1 * np.linalg.norm(still - voxels)


@pytest.mark.parametrize("method", others_slow(["fbp", "fista-tv", "r2"]))
def test_methods_take_a_skew_out(method: str) -> None:
    """A rod beside the axis, seen by rows of their own angles, stands upright again."""
    views = Geometry.parallel(np.arange(48) * np.pi / 48, (24, 32)).seen_with(RayWidth(), 0.01)
    grid = Grid.matching(views)
    _, y, x = grid.coordinates()
    rod = np.exp(-((x[None, :] - 9) ** 2 + (y[:, None] - 1) ** 2) / 4).astype(np.float32)
    truth = np.repeat(rod[None], 24, 0)
    data = np.stack(
        [Projector(replace(views.at_row(row), skew=0.0), grid).forward(truth)[:, row] for row in range(24)], axis=1
    )
    methods: list[recon.Method] = [recon.Fbp(), recon.FistaTv(iterations=5), recon.R2(steps=60, finish=2)]
    (chosen,) = (each for each in methods if each.name == method)

    def slant(geometry: Geometry) -> float:
        volume = np.maximum(recon.reconstruct(data, geometry, chosen).volume.data, 0)[[2, 21]]
        y_of = (volume * y[:, None]).sum((1, 2)) / volume.sum((1, 2))
        return float(abs(y_of[1] - y_of[0]))

    assert slant(replace(views, skew=0.0)) > 1.5
    assert slant(views) < 0.15


def test_fbp_without_skew_keeps_its_bits(rng: np.random.Generator) -> None:
    data = rng.random((9, 40, 36), dtype=np.float32)
    np.testing.assert_array_equal(fbp(data, PARALLEL), fbp(data, PARALLEL.seen_with(WIDTH)))


def test_what_has_no_meaning_is_refused() -> None:
    with pytest.raises(ValueError, match=">= 0"):
        RayWidth(blur=-1)
    with pytest.raises(ValueError, match="finite, and 0 for a cone beam"):
        CONE.seen_with(RayWidth(), 1e-3)


def _unexplained(method: recon.FistaTv | recon.R2, data: F32, views: Geometry, unseen: F32, others: Geometry) -> float:
    """What the volume leaves of sharp views that it has not seen, as a share of them."""
    volume = recon.reconstruct(data, views, method, grid=Grid.matching(others)).volume
    return data_residual(volume, unseen, others)


@pytest.mark.slow
@pytest.mark.parametrize("method", [recon.FistaTv(iterations=60, tv_weight=1e-4), recon.R2(steps=200, finish=8)])
def test_the_model_of_a_fly_scan_gives_what_a_still_one_gives(method: recon.FistaTv | recon.R2) -> None:
    """Balls that turn while each view is exposed, by 2.6 px at the edge of the field: within half a decibel."""
    shape, n = (8, 72), 30
    step = np.pi / n
    angles, arc = np.arange(float(n)) * step, 0.7 * step
    moving = np.mean([ball_views(angles + turn, shape) for turn in ((np.arange(12) + 0.5) / 12 - 0.5) * arc], axis=0)
    views, others = (Geometry.parallel(a, shape) for a in (angles, angles + step / 2))
    unseen = ball_views(others.angles, shape)
    still = _unexplained(method, ball_views(angles, shape), views, unseen, others)
    without = _unexplained(method, moving, views, unseen, others)
    modelled = _unexplained(method, moving, views.seen_with(RayWidth(arc=arc)), unseen, others)
    assert modelled < 10 ** (0.5 / 20) * still
    assert modelled < 0.9 * without
