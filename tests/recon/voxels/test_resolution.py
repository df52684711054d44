"""Resolution: how much blurrier voxels are than projections; both are compared at one resolution."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry
from recon.base.ray_width import RayWidth
from recon.base.volume import Grid
from recon.voxels.projector import Projector
from recon.voxels.residuals import unseen_residuals
from recon.voxels.resolution import ViewResolution, at_voxel_resolution, smoothed
from recon.voxels.voxel_problem import largest_eigenvalue
from tests.recon.helpers import assert_transpose

SIDE, WIDTH = 192, 24.0


def _wave(grid: Grid, u: F64, f: float) -> F32:
    """Voxels' means of cos 2πf (u·x), in a wide Gaussian, which is flat within a voxel."""
    z, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    means = math.prod(float(np.sinc(f * n * edge)) for n, edge in zip(u, grid.spacing[::-1], strict=True))
    wave = np.cos(2 * np.pi * f * (x * u[0] + y * u[1] + z * u[2]))
    return (means * wave * np.exp(-(x**2 + y**2) / (2 * WIDTH**2))).astype(np.float32)


def _response(geometry: Geometry, grid: Grid, f: float, matched: bool) -> float:
    """What a view keeps of the wave along its columns, beside the mean of its pixels' exact line integrals."""
    found = Projector(geometry, grid, matched).forward(_wave(grid, geometry.axes(0)[0], f))[0, 0]
    u = (np.arange(found.size) - geometry.axis_col) * geometry.pixel_pitch
    exact = np.sqrt(2 * np.pi) * WIDTH * np.exp(-(u**2) / (2 * WIDTH**2)) * np.cos(2 * np.pi * f * u)
    exact *= np.sinc(f * geometry.pixel_pitch) * np.exp(-2 * (np.pi * geometry.width.blur * f) ** 2)
    return float(found @ exact / (exact @ exact))


@pytest.mark.parametrize("voxel", [1.0, 0.8, 1.4])
@pytest.mark.parametrize("degrees", [0.0, 3.0, 20.0, 45.0, 70.0, 90.0])
def test_a_plane_wave_loses_what_the_transfer_says(degrees: float, voxel: float) -> None:
    if voxel != 1 and degrees in (0, 45, 90):
        pytest.skip("neighbouring rays interpolate in step with each other and with the wave")
    geometry, side = Geometry.parallel([math.radians(degrees)], (1, SIDE)), round(SIDE / voxel)
    grid = Grid((1, side, side), voxel, slice_pitch=1.0)
    for f in (0.05, 0.125, 0.25):
        expected = ViewResolution.of(geometry, grid).transfer(0, np.array([f]))[0, 0]
        assert _response(geometry, grid, f, True) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("off", [0.5, 0.3])
def test_a_view_along_an_axis_keeps_what_two_voxels_do(off: float) -> None:
    geometry = replace(Geometry.parallel([0.0], (1, SIDE)), axis_col=(SIDE - 1) / 2 + off)
    grid = Grid((1, SIDE, SIDE))
    resolution = ViewResolution.of(geometry, grid)
    assert not resolution.smoothed.any()
    for f in (0.05, 0.125, 0.25, 0.375):
        expected = resolution.transfer(0, np.array([f]))[0, 0]
        assert _response(geometry, grid, f, True) == pytest.approx(expected, abs=0.01)


def test_a_wide_blur_of_the_detector_is_spread_in_passes() -> None:
    geometry = Geometry.parallel([math.radians(20.0)], (1, SIDE)).seen_with(RayWidth(pixel=1, blur=1.0))
    grid = Grid((1, SIDE, SIDE))
    for f in (0.05, 0.125, 0.2):
        expected = ViewResolution.of(geometry, grid).transfer(0, np.array([f]))[0, 0]
        assert min(_response(geometry, grid, f, True), 1) == pytest.approx(expected, abs=0.02)


def test_the_excess_of_a_voxel_follows_from_the_geometry() -> None:
    angles = np.deg2rad([10.0, 30.0, 80.0])
    nearer = np.maximum(np.cos(angles) ** 2, np.sin(angles) ** 2)
    parallel = Geometry.parallel(angles, (8, 64), pixel_pitch=0.05)
    grid = Grid.matching(parallel)
    np.testing.assert_allclose(
        ViewResolution.of(parallel, grid).excess, np.stack((nearer / 6, 0 * nearer), 1), atol=1e-3
    )
    cone = Geometry.cone(angles, (8, 64), 0.1, 40.0, 80.0)
    np.testing.assert_allclose(
        ViewResolution.of(cone, Grid.matching(cone)).excess, np.stack((nearer / 6, 0 * nearer + 1 / 6), 1), rtol=1e-6
    )
    coarse = ViewResolution.of(cone, Grid((8, 32, 32), 0.1)).excess
    np.testing.assert_allclose(coarse[:, 0], (4 / 12 + 4 * nearer / 6) - 1 / 12)
    fine = ViewResolution.of(cone, Grid((8, 128, 128), 0.025)).excess
    assert (fine < 0).all()
    blurred = parallel.seen_with(RayWidth(pixel=1, blur=0.3))
    np.testing.assert_allclose(
        ViewResolution.of(blurred, grid).excess, ViewResolution.of(parallel, grid).excess - 0.3**2, atol=1e-9
    )
    wide = ViewResolution.of(parallel.binned(2), Grid.matching(parallel.binned(2))).excess
    np.testing.assert_allclose(wide, ViewResolution.of(parallel, grid).excess[:, :], atol=5e-3)  # in its own pixels


def test_a_source_that_stands_apart_sees_voxels_of_its_own_size() -> None:
    cone = Geometry.cone(np.zeros(2), (8, 64), 0.1, 40.0, 80.0)
    nearer = cone.about([(0.0, 0.0, 0.0), (0.0, 10.0, 0.0)])  # the second source is 50 mm from the box's middle
    excess = ViewResolution.of(nearer, Grid((8, 64, 64), 0.05)).excess[:, 0] + 1 / 12
    assert excess[1] / excess[0] == pytest.approx((40 / 30) ** 2)


def test_rays_along_an_axis_do_not_interpolate_where_they_meet_voxels() -> None:
    views = Geometry.parallel([0.0, np.pi / 2, 0.3], (4, 64))
    on, between = (
        ViewResolution.of(replace(views, axis_col=31.5 + off), Grid.matching(views)).excess for off in (0, 0.5)
    )
    np.testing.assert_allclose(on[:2, 0], 0, atol=5e-3)
    np.testing.assert_allclose(between[:2, 0], 1 / 4, atol=5e-3)
    assert on[2, 0] == pytest.approx(between[2, 0], abs=5e-3)


GEOMETRIES = {
    "parallel": Geometry.parallel(np.arange(12) * np.pi / 12, (6, 24)),
    "one view": Geometry.parallel([0.4], (6, 24)),
    "a few degrees": Geometry.parallel(np.arange(12) * 0.01, (6, 24)),
    "shifted": Geometry.parallel(np.arange(7) * 0.4, (6, 24), shifts=np.tile((0.2, 0.4), (7, 1))),
    "cone": Geometry.cone(np.arange(12) * np.pi / 6, (24, 24), 2.0, 60.0, 120.0),
    "tilted": Geometry.parallel(np.arange(12) * np.pi / 6, (24, 24), tilt=0.4),
    "rolled by a quarter turn": Geometry.parallel(np.arange(12) * np.pi / 12, (24, 6), roll=np.pi / 2),
}


@pytest.mark.parametrize("name", GEOMETRIES)
@pytest.mark.parametrize("voxel", [0.9, 1.4])
@pytest.mark.parametrize("others", [1.0, 0.01])
def test_the_step_knows_that_the_model_is_sharpened(
    name: str, voxel: float, others: float, rng: np.random.Generator
) -> None:
    projector = Projector(GEOMETRIES[name], Grid((6, 24, 24), voxel))
    views, rows, cols = projector.projection_shape
    weight = np.full((views, cols, rows), others, np.float32)  # of all views but the first
    weight[0] = 1
    x = rng.normal(size=(24, 24, 6)).astype(np.float32)
    norm = 0.0
    for _ in range(60):
        x = projector.adjoint_lines(weight * projector.forward_lines(x))
        norm = float(np.linalg.norm(x))
        x /= norm
    assert norm <= 1.001 * largest_eigenvalue(projector, weight)


@pytest.mark.parametrize("name", GEOMETRIES)
def test_the_matched_transpose_is_exact(name: str, rng: np.random.Generator) -> None:
    assert_transpose(Projector(GEOMETRIES[name], Grid((6, 24, 24), 1.4)), rng, rel=1e-6)


def test_the_bits_of_a_row_do_not_depend_on_the_slab(rng: np.random.Generator) -> None:
    views = Geometry.parallel(np.arange(9) * 0.3, (12, 40))
    volume = rng.random((12, 40, 40), dtype=np.float32)
    part = views.rows(5, 9)
    whole = Projector(views, Grid.matching(views)).forward(volume)[:, 5:9]
    np.testing.assert_array_equal(whole, Projector(part, Grid.matching(part)).forward(volume[5:9]))


def test_views_held_out_prefer_the_truth_to_a_sharper_volume(rng: np.random.Generator) -> None:
    """Structure of less than a voxel, seen by fine rays; the truth is the mean of 4 x 4 fine voxels."""
    fine = gaussian_filter(rng.normal(size=(1, 256, 256)), (0, 1.5, 1.5)).astype(np.float32)
    y, x = np.indices((256, 256)) - 127.5
    fine *= np.hypot(y, x) < 110
    rays = Geometry.parallel(np.arange(12) * np.pi / 12 + 0.1, (1, 512), pixel_pitch=0.125)
    views = Projector(rays, Grid(fine.shape, 0.25, slice_pitch=0.125), False).forward(fine)
    views = views.reshape(12, 1, 64, 8).mean(3).swapaxes(1, 2)
    geometry = Geometry.parallel(rays.angles, (1, 64))
    grid = Grid.matching(geometry)
    truth = fine.reshape(1, 64, 4, 64, 4).mean((2, 4))
    projector = Projector(geometry, grid)
    shares, spectrum = np.linspace(0.6, 1.6, 21), np.fft.fft2(truth[0])
    f = np.hypot(np.fft.fftfreq(64)[:, None], np.fft.fftfreq(64))
    left = []
    for share in shares:
        other = np.fft.ifft2(spectrum * (1 + (share - 1) * (f > 0.15) * (f < 0.3))).real.astype(np.float32)[None]
        model = projector.forward(other).swapaxes(1, 2)
        left.append([
            unseen_residuals(model, views, None, projector.resolution).mean(),
            np.sqrt(np.mean(np.square(model - views), axis=(1, 2))).mean(),
        ])  # fmt: skip
    at_voxels, plain = shares[np.argmin(left, axis=0)]
    assert at_voxels == pytest.approx(1, abs=0.051) and plain > at_voxels


def test_rays_that_do_not_count_have_no_part(rng: np.random.Generator) -> None:
    geometry = Geometry.cone(np.arange(3) * 0.5, (20, 24), 2.0, 60.0, 120.0)
    resolution = ViewResolution.of(geometry, Grid((14, 17, 17), 1.4))
    views, counts = np.ones((3, 24, 20), np.float32), rng.random((3, 24, 20)) > 0.1
    views[~counts] = 1e6
    for found in (at_voxel_resolution(views, resolution, counts), smoothed(views, resolution, counts)):
        np.testing.assert_allclose(found[counts], 1, rtol=1e-5)
    plain = at_voxel_resolution(np.ones_like(views), resolution)
    np.testing.assert_allclose(plain, 1, rtol=1e-6)


def test_views_are_smoothed_only_where_voxels_are_coarse(rng: np.random.Generator) -> None:
    geometry = Geometry.cone(np.arange(3) * 0.5, (20, 24), 2.0, 60.0, 120.0)
    views = rng.random((3, 24, 20), dtype=np.float32)
    assert smoothed(views, ViewResolution.of(geometry, Grid((20, 24, 24), 1.0))) is views
    resolution = ViewResolution.of(geometry, Grid((14, 17, 17), 1.4))
    assert np.ptp(smoothed(views, resolution)) < np.ptp(views)
    both = resolution.sharpened + resolution.smoothed
    np.testing.assert_allclose(both, resolution.excess)
