"""Projections that show something outside the volume: a particle is located; noise and misfits are not reported."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from recon.base.geometry import Geometry
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.voxels.odd_views import LIMIT, OddView, odd_views, odd_views_memory
from recon.voxels.projector import Projector

F32 = NDArray[np.float32]
ROWS, COLS, SIGMA = 24, 64, 0.02
TURN = np.linspace(0, math.pi, 60, endpoint=False)
GOLDEN = (np.arange(60) * math.pi * (math.sqrt(5) - 1) / 2) % math.pi
ROW, COL = np.meshgrid(np.arange(ROWS), np.arange(COLS), indexing="ij")


def _sample(geometry: Geometry) -> tuple[Volume, F32]:
    """Two balls in a cylinder, and its line integrals."""
    grid = Grid.matching(geometry)
    z, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    data = 0.02 * (np.hypot(x, y) < 28) + 0.05 * (z**2 + (y - 10) ** 2 + (x - 5) ** 2 < 25)
    volume = Volume(data.astype(np.float32), grid)
    return volume, Projector(geometry, grid).forward(volume.data)


def _found(volume: Volume, views: Views) -> tuple[OddView, ...]:
    return odd_views(volume.grid, views).alone(volume, views.geometry)


def _speck(row: float, col: float, height: float) -> F32:
    return (height * np.exp(-((ROW - row) ** 2 + (COL - col) ** 2) / 8)).astype(np.float32)


@pytest.fixture(params=[TURN, GOLDEN], ids=["sequential", "golden"])
def geometry(request: pytest.FixtureRequest) -> Geometry:
    return Geometry.parallel(request.param, (ROWS, COLS))


def test_noise_light_and_a_place_that_never_fits_are_not_odd(geometry: Geometry, rng: np.random.Generator) -> None:
    volume, clean = _sample(geometry)
    light = rng.normal(0, 0.05, (60, 1, 1))
    misfit = _speck(8, 20, 0.3) * rng.normal(1, 0.2, (60, 1, 1))
    views = clean + light + misfit + rng.normal(0, SIGMA, clean.shape)
    assert _found(volume, Views(views.astype(np.float32), geometry)) == ()


@pytest.mark.parametrize("height", [0.2, -0.2])
def test_a_speck_in_two_views_is_named_with_its_place(
    geometry: Geometry, rng: np.random.Generator, height: float
) -> None:
    volume, clean = _sample(geometry)
    views = clean + rng.normal(0, SIGMA, clean.shape).astype(np.float32)
    views[30:32] += _speck(15, 40, height)
    found = _found(volume, Views(views, geometry))
    assert [odd.view for odd in found] == [30, 31]
    for odd in found:
        assert math.copysign(1, odd.score) == math.copysign(1, height) and abs(odd.score) > LIMIT
        assert odd.rows[0] <= 15 < odd.rows[1] <= 21 and odd.cols[0] <= 40 < odd.cols[1] <= 46


@pytest.mark.parametrize("rows", [1, ROWS])
def test_a_face_along_the_rays_is_not_odd_though_few_views_see_it_sharp(rows: int, rng: np.random.Generator) -> None:
    geometry = Geometry.parallel(TURN, (rows, COLS))
    grid = Grid.matching(geometry)
    _, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    along, across = x * math.cos(TURN[30]) + y * math.sin(TURN[30]), y * math.cos(TURN[30]) - x * math.sin(TURN[30])
    plate = (0.05 * ((np.abs(along - 3) < 4) & (np.abs(across) < 20))).astype(np.float32)
    views = Projector(geometry, grid).forward(plate) + rng.normal(0, SIGMA, (60, rows, COLS)).astype(np.float32)
    smooth = Volume(gaussian_filter(plate, (0, 0.5, 0.5)), grid)
    assert _found(smooth, Views(views.astype(np.float32), geometry)) == ()


def test_rays_that_were_not_measured_show_nothing(geometry: Geometry, rng: np.random.Generator) -> None:
    volume, clean = _sample(geometry)
    views = clean + rng.normal(0, SIGMA, clean.shape).astype(np.float32)
    views[30, 10:20, 35:45] += 1
    weights = np.ones_like(views)
    weights[30, 10:20, 35:45] = 0
    assert _found(volume, Views(views, geometry, weights)) == ()
    assert [odd.view for odd in _found(volume, Views(views, geometry))] == [30]


def test_views_without_noise_are_not_compared_finer_than_a_fit_ends(geometry: Geometry) -> None:
    data = gaussian_filter(_sample(geometry)[0].data, 4)  # whose finest detail counts as noise
    volume = Volume(data, Grid.matching(geometry))
    views = Projector(geometry, volume.grid).forward(data)
    views[20] += _speck(15, 40, 0.004 * float(views.max()))
    assert _found(volume, Views(views, geometry)) == ()
    views[30] += _speck(15, 40, 0.2)
    assert [odd.view for odd in _found(volume, Views(views, geometry))] == [30]


def test_few_views_say_nothing() -> None:
    geometry = Geometry.parallel(TURN[:24], (ROWS, COLS))
    volume, clean = _sample(geometry)
    clean[10] += _speck(15, 40, 1.0)
    assert _found(volume, Views(clean, geometry)) == ()


def test_rows_that_fill_no_cell_count_for_nothing(rng: np.random.Generator) -> None:
    geometry = Geometry.parallel(TURN, (17, 256))  # cells of 2 x 2, bands of 16 rows: one row is left over
    volume = Volume(np.full((17, 256, 256), 1e-4, np.float32), Grid.matching(geometry))
    views = Projector(geometry, volume.grid).forward(volume.data)
    views += rng.normal(0, SIGMA, views.shape).astype(np.float32)
    assert _found(volume, Views(views, geometry)) == ()


@pytest.mark.parametrize(
    ("views", "rows", "columns", "cone"),
    [
        (60, 200, 48, False),
        (360, 64, 96, False),
        (400, 32, 64, False),
        (30, 40, 512, False),
        (60, 3, 300, False),
        (40, 96, 96, True),
        (200, 64, 64, True),
        (91, 16, 256, True),
    ],
)
def test_the_stated_memory_is_that_of_the_peak(
    views: int, rows: int, columns: int, cone: bool, rng: np.random.Generator
) -> None:
    angles, shape = np.linspace(0, math.pi, views, endpoint=False), (rows, columns)
    geometry = Geometry.cone(2 * angles, shape, 1.0, 500.0, 700.0) if cone else Geometry.parallel(angles, shape)
    grid = Grid.matching(geometry)
    _, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    cylinder = Volume(0.01 * (np.hypot(x, y) < 0.3 * columns).astype(np.float32), grid)
    noise = rng.normal(0, SIGMA, (views, rows, columns)).astype(np.float32)
    measured = Views(Projector(geometry, grid).forward(cylinder.data) + noise, geometry)
    _found(cylinder, measured)  # everything is compiled
    tracemalloc.start()
    _found(cylinder, measured)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < odd_views_memory(geometry) < 1.6 * peak
