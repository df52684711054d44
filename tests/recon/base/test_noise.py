"""Noise of a scan: white noise, blurred noise, texture, scans with few rows."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from recon.base.arrays import median_deviation
from recon.base.geometry import Geometry
from recon.base.noise import noise_beside_structure, noise_level
from recon.base.volume import Grid
from recon.voxels.projector import Projector

F32 = NDArray[np.float32]
VIEWS = Geometry.parallel(np.linspace(0, np.pi, 24, endpoint=False), (40, 96))


@pytest.fixture(scope="module")
def textured() -> F32:
    """Line integrals up to about 2 of a cylinder full of grains of about three voxels."""
    rng = np.random.default_rng(3)
    grid = Grid.matching(VIEWS)
    _, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    grains = gaussian_filter(rng.normal(size=grid.shape), 1.2) > 0
    return Projector(VIEWS, grid).plain.forward(
        np.where(np.hypot(x, y) < 40, 0.01 + 0.03 * grains, 0).astype(np.float32)
    )


def _noise(views: F32, sigma: float, blur: float = 0.0) -> F32:
    noise = np.random.default_rng(1).normal(size=views.shape)
    if blur:
        noise = gaussian_filter(noise, (0, blur, blur))
    return (noise * (sigma / noise.std())).astype(np.float32)


@given(sigma=st.floats(1e-4, 10), seed=st.integers(0, 5))
def test_white_noise_on_smooth_views(sigma: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    smooth = sigma * 100 * np.sqrt(1 - 0.9 * np.linspace(-1, 1, 200) ** 2)
    views = (smooth + rng.normal(0, sigma, (4, 40, 200))).astype(np.float32)
    assert noise_level(views) == pytest.approx(sigma, rel=0.06)


@pytest.mark.parametrize("sigma", [0.05, 0.1, 0.2])
def test_white_noise_on_texture(textured: F32, sigma: float) -> None:
    assert noise_level(textured + _noise(textured, sigma)) == pytest.approx(sigma, rel=0.33)


@pytest.mark.parametrize("blur", [0.4, 0.5, 0.7])
def test_noise_that_was_blurred(textured: F32, blur: float) -> None:
    blurred = textured + _noise(textured, 0.1, blur)
    assert noise_level(blurred) == pytest.approx(0.1, rel=0.5)


def test_photon_noise_is_that_of_a_typical_pixel(textured: F32) -> None:
    photons = 2000
    counts = np.random.default_rng(2).poisson(photons * np.exp(-textured))
    sigma = np.median(np.exp(textured / 2)) / np.sqrt(photons)
    assert noise_level(-np.log(counts / photons).astype(np.float32)) == pytest.approx(sigma, rel=0.15)


def test_rings_do_not_count(textured: F32) -> None:
    rings = np.random.default_rng(4).normal(0, 0.2, textured.shape[1:]).astype(np.float32)
    noisy = textured + _noise(textured, 0.05)
    assert noise_level(noisy + rings) == pytest.approx(noise_level(noisy), rel=0.1)


def test_a_scan_of_two_rows_is_judged_along_its_columns(rng: np.random.Generator) -> None:
    views = rng.normal(0, 0.3, (30, 2, 400)).astype(np.float32)
    assert noise_level(views) == pytest.approx(0.3, rel=0.1)
    assert noise_level(views[:, :, :4]) == 0.0


def test_pixels_that_do_not_count_are_nan(rng: np.random.Generator) -> None:
    views = rng.normal(0, 0.3, (20, 40, 60)).astype(np.float32)
    views[:, 10:12, 5:9] = np.nan
    assert noise_level(views) == pytest.approx(0.3, rel=0.1)
    assert median_deviation(views) == pytest.approx(0.3, rel=0.05)
    assert median_deviation(np.full((1, 1, 3), np.nan, np.float32)) == 0.0


@pytest.mark.parametrize("lost", [[4], [2, 4], [1, 3, 5, 7]])
def test_few_rows_of_which_some_do_not_count_are_judged_along_their_columns(
    lost: list[int], rng: np.random.Generator
) -> None:
    images = rng.normal(0, 0.01, (26, 8, 44)).astype(np.float32)
    images[:, lost] = np.nan
    assert noise_level(images) == pytest.approx(0.01, rel=0.15)
    assert noise_level(images.swapaxes(1, 2)) == pytest.approx(0.01, rel=0.15)


@pytest.fixture(scope="module")
def wires() -> F32:
    """Thin bright wires in all directions, of a voxel's width [z, y, x]."""
    rng = np.random.default_rng(5)
    place = np.stack(np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in (24, 64, 64)), indexing="ij"))
    volume = np.zeros(place.shape[1:], np.float32)
    for _ in range(60):
        along = rng.normal(size=3)
        off = place - np.array([0, *rng.uniform(-20, 20, 2)])[:, None, None, None]
        t = np.tensordot(along / np.linalg.norm(along), off, 1)
        volume[(off**2).sum(0) - t**2 < 0.4] = 0.1
    return np.where(np.hypot(place[1], place[2]) < 26, volume, 0).astype(np.float32)


@pytest.mark.parametrize("sigma", [0.02, 0.03])
@pytest.mark.parametrize(
    "views",
    [
        Geometry.cone(np.arange(50) * np.pi / 25, (24, 64), 2.0, 256.0, 512.0),
        Geometry.parallel(np.deg2rad(np.arange(-88, 93, 4)), (24, 64), shifts=[(0.3, 0.0)] * 46),
        Geometry.parallel(np.roll(np.arange(48), 5) * np.pi / 24, (24, 64), axis_col=30.2),
    ],
)
def test_thin_wires_are_no_noise(wires: F32, views: Geometry, sigma: float) -> None:
    """`noise_level` takes them for noise, up to twice too much."""
    clean = Projector(views, Grid(wires.shape)).forward(wires)
    lines = np.ascontiguousarray((clean + _noise(clean, sigma)).transpose(0, 2, 1))
    assert noise_beside_structure(lines, views) == pytest.approx(sigma, rel=0.15)
    assert noise_level(lines) > 1.3 * sigma
    lines[:, 3, 7] = np.nan  # a row that does not count
    assert noise_beside_structure(lines, views) == pytest.approx(sigma, rel=0.15)


def test_uneven_views_have_the_noise_level(wires: F32) -> None:
    """Angles at random, or few, tell nothing beside structure; even ones tell the same of white noise."""
    for angles in (np.random.default_rng(2).uniform(0, 2 * np.pi, 50), np.arange(9) * np.pi / 9):
        views = Geometry.parallel(angles, (24, 64))
        lines = np.ascontiguousarray(Projector(views, Grid(wires.shape)).forward(wires).transpose(0, 2, 1))
        assert noise_beside_structure(lines, views) == noise_level(lines)
    even = Geometry.parallel(np.arange(48) * np.pi / 24, (24, 64))
    white = _noise(np.zeros((48, 64, 24), np.float32), 0.2)
    assert noise_beside_structure(white, even) == pytest.approx(noise_level(white), rel=0.05)
