"""Unexplained structure in the residual: none for noise, rings or a true volume; a filled crack is located."""

from __future__ import annotations

import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.voxels.matter_checks import UNEXPLAINED_LIMIT, Unexplained, unexplained, unexplained_memory
from recon.voxels.projector import Projector

F32 = NDArray[np.float32]
VIEWS = Geometry.parallel(np.linspace(0, math.pi, 60, endpoint=False), (8, 64))
GRID = Grid.matching(VIEWS)
_, Y, X = np.meshgrid(*GRID.coordinates(), indexing="ij")
TOOTH = np.where(np.hypot(X, Y) < 26, np.float32(0.04), np.float32(0))
CRACK = (abs(X - 6.5) < 1) & (abs(Y) < 12)
TRUTH = np.where(CRACK, np.float32(0), TOOTH)


def _views(rng: np.random.Generator, sigma: float = 0.03) -> F32:
    return Projector(VIEWS, GRID).forward(TRUTH) + rng.normal(0, sigma, (60, 8, 64)).astype(np.float32)


def _unexplained(volume: Volume, views: Views, rng: np.random.Generator) -> Unexplained | None:
    return unexplained(volume, views, rng).alone(volume, views.geometry)


def test_a_filled_crack_is_seen_where_it_is(rng: np.random.Generator) -> None:
    found = _unexplained(Volume(TOOTH, GRID), Views(_views(rng), VIEWS), rng)
    assert found is not None and found.share > 2 * UNEXPLAINED_LIMIT
    strong = found.significance < -4  # the volume has too much there
    assert (
        strong[CRACK].mean() > 0.5
        and strong[np.hypot(X - 6.5, np.maximum(abs(Y) - 12, 0)) > 6].mean() < UNEXPLAINED_LIMIT
    )


@pytest.mark.parametrize("rings", [0.0, 0.1])
def test_the_truth_leaves_noise_and_rings(rng: np.random.Generator, rings: float) -> None:
    offsets = np.where(rng.random((8, 64)) < 0.05, rings, 0).astype(np.float32)
    found = _unexplained(Volume(TRUTH, GRID), Views(_views(rng) + offsets, VIEWS), rng)
    assert found is not None and found.share < UNEXPLAINED_LIMIT / 3


@pytest.mark.parametrize("turns", [2, 1])
def test_a_filled_crack_is_seen_by_views_that_step_up_and_down(rng: np.random.Generator, turns: int) -> None:
    shifts = np.zeros((60, 2))
    shifts[:, 1] = 9 * np.cos(turns * 2 * math.pi * np.arange(60) / 60 + 0.3)
    moved = replace(VIEWS, shifts=shifts)
    grid = Grid.matching(moved)
    assert grid.shape[0] != VIEWS.detector_shape[0]  # no slice a row: the case looked at
    truth = np.repeat(TRUTH[:1], grid.shape[0], axis=0)
    tall = replace(moved, detector_shape=(30, 64), axis_row=moved.axis_row + 11)  # all rays that the rows' see
    box = replace(grid, shape=(60, *grid.shape[1:]))
    whole = Projector(tall, box).forward(np.repeat(TRUTH[:1], 60, axis=0))
    views = np.ascontiguousarray(whole[:, 11:19]) + rng.normal(0, 0.03, (60, 8, 64)).astype(np.float32)
    filled = np.where(np.hypot(X, Y) < 26, np.float32(0.04), np.float32(0))[0]
    closed = _unexplained(Volume(np.repeat(filled[None], len(truth), axis=0), grid), Views(views, moved), rng)
    true = _unexplained(Volume(truth, grid), Views(views, moved), rng)
    assert closed is not None and true is not None
    assert closed.share > 2 * UNEXPLAINED_LIMIT > UNEXPLAINED_LIMIT > true.share


def test_it_is_in_units_of_the_noise(rng: np.random.Generator) -> None:
    found = _unexplained(Volume(TRUTH, GRID), Views(_views(rng), VIEWS), rng)
    assert found is not None
    inside = np.broadcast_to(np.hypot(X, Y) < 26, TRUTH.shape)
    assert found.significance[inside].std() == pytest.approx(1, abs=0.15)


def test_what_it_is_not_made_for(rng: np.random.Generator) -> None:
    volume, few = Volume(TRUTH, GRID), VIEWS.select(np.arange(10))
    data = _views(rng)
    assert _unexplained(volume, Views(data[:10], few), rng) is None
    assert _unexplained(Volume(np.zeros_like(TRUTH), GRID), Views(data, VIEWS), rng) is None
    cone = Geometry.cone(VIEWS.angles, (8, 64), 1.0, 500.0, 700.0)
    assert _unexplained(volume, Views(data, cone), rng) is None


@pytest.mark.parametrize(
    ("views", "rows", "columns"), [(60, 200, 48), (360, 64, 96), (600, 32, 64), (40, 64, 64), (91, 16, 256)]
)
def test_the_stated_memory_is_that_of_the_peak(views: int, rows: int, columns: int, rng: np.random.Generator) -> None:
    geometry = Geometry.parallel(np.linspace(0, math.pi, views, endpoint=False), (rows, columns))
    grid = Grid.matching(geometry)
    _, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    cylinder = Volume((np.hypot(x, y) < 0.4 * columns).astype(np.float32), grid)
    noise = rng.normal(0, 0.5, (views, rows, columns)).astype(np.float32)
    measured = Views(Projector(geometry, grid).forward(cylinder.data) + noise, geometry)
    assert _unexplained(cylinder, measured, rng) is not None  # everything is compiled
    tracemalloc.start()
    _unexplained(cylinder, measured, rng)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < unexplained_memory(geometry) < 1.6 * peak
