"""Both back-projectors compared with a plain sum, and with each other for detail of every size."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

import recon.voxels.fbp as module
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.back_project import columns_of, gridding_pays, ray_by_ray
from recon.voxels.fbp import Filter, fbp, fbp_block, plan_fbp

F32 = NDArray[np.float32]


def both_ways(
    monkeypatch: pytest.MonkeyPatch, views: F32, geometry: Geometry, filter: Filter, grid: Grid | None = None
) -> tuple[F32, F32]:
    """The volume ray by ray, and by gridding."""
    volumes = []
    for gridded in (False, True):
        monkeypatch.setattr(module, "gridding_pays", lambda *_, gridded=gridded: gridded)
        volumes.append(fbp(views, geometry, grid, filter))
    return volumes[0], volumes[1]


def resolution_pattern(geometry: Geometry, rng: np.random.Generator) -> F32:
    """Line integrals of a disc with holes of 1 to 20 pixels, bars of 1 to 6, a crack of 1, and noise."""
    angles, cols = geometry.angles, geometry.detector_shape[1]
    u = (np.arange(4 * cols) + 0.5) / 4 - 0.5 - geometry.axis_col
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
    total = np.zeros((angles.size, u.size))
    for x, y, radius, density in [(0, 0, 0.4 * cols, 1), *((30 - 8 * n, 4 * n - 20, n, -1) for n in (1, 3, 5, 8, 10))]:
        total += 2 * density * np.sqrt(np.maximum(radius**2 - (u - x * c - y * s) ** 2, 0))
    bars = [(-60 + 15 * width + 2 * n * width, 40, width, 20, 0.0) for width in (1, 2, 4, 6) for n in range(2)]
    for x, y, width, length, turned in [*bars, (10, -50, 1, 70, 0.7)]:
        a, b = (
            np.abs(half * trig(angles - turned))[:, None] for half, trig in ((width / 2, np.cos), (length / 2, np.sin))
        )
        outer, inner = a + b, np.abs(a - b)
        part = np.clip((outer - np.abs(u - x * c - y * s)) / np.maximum(outer - inner, 1e-9), 0, 1)
        total -= part * width * length / (2 * np.maximum(a, b))
    data = total.reshape(angles.size, cols, 4).mean(2) / cols
    return (data + rng.normal(0, 2e-3, data.shape)).astype(np.float32)[:, None].repeat(2, 1) * np.array(
        [[1], [0.5]], np.float32
    )


def in_all_views(volume: F32, geometry: Geometry, grid: Grid) -> F32:
    """Voxels that all views see, and not by their outermost column."""
    _, y, x = (axis / geometry.pixel_pitch for axis in grid.coordinates())
    cols, axis = geometry.detector_shape[1], geometry.axis_col
    return volume[:, np.hypot(x, y[:, None]) < min(axis, cols - 1 - axis) - 1]


def test_ray_by_ray_is_the_plain_sum(rng: np.random.Generator) -> None:
    views, cols = 7, 20
    columns = columns_of(views, cols)
    columns[:, 1:-1, :3] = rng.normal(size=(views, cols, 3))
    columns[:, 0], columns[:, -1] = columns[:, 1], columns[:, -2]
    angles, axis = rng.uniform(0, 7, views), rng.uniform(8, 12, views)
    x, y = np.arange(19.0) - 9, np.arange(9.0) - 4.2
    out = np.empty((3, 9, 19), np.float32)
    ray_by_ray(angles, axis, x, y, columns, out)
    t = x * np.cos(angles)[:, None, None] + y[:, None] * np.sin(angles)[:, None, None] + axis[:, None, None]
    seen = (t >= -0.5) & (t <= cols - 0.5)
    for z in range(3):
        each = [np.interp(t[v], np.arange(cols), columns[v, 1:-1, z]) * seen[v] for v in range(views)]
        np.testing.assert_allclose(out[z], np.sum(each, axis=0), atol=2e-5)


@pytest.mark.parametrize(("filter", "most"), [("hann", 1e-3), ("ram-lak", 1e-3)])
def test_gridding_is_the_same_volume(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator, filter: Filter, most: float
) -> None:
    geometry = Geometry.parallel(rng.permutation(400) * np.pi / 400, (2, 256), pixel_pitch=0.02, axis_col=124.3)
    views = resolution_pattern(geometry, rng)
    rays, gridded = both_ways(monkeypatch, views, geometry, filter)
    difference = in_all_views(np.abs(gridded - rays), geometry, Grid.matching(geometry))
    assert difference.max() < most * rays.max()
    assert np.sqrt(np.mean(difference**2)) < most / 5 * rays.max()


def test_gridding_in_a_box_of_smaller_voxels_with_moved_views(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    shifts = np.stack((rng.uniform(-2, 2, 300), np.zeros(300)), 1)
    geometry = Geometry.parallel(np.arange(300) * np.pi / 300, (2, 200), pixel_pitch=0.1, axis_col=95.0, shifts=shifts)
    views = resolution_pattern(geometry, rng)
    grid = Grid((2, 121, 90), 0.06, (0.0, 1.3, -2.2))
    rays, gridded = both_ways(monkeypatch, views, geometry, "hann", grid)
    assert np.abs(gridded - rays).max() < 1e-3 * rays.max()


def test_gridding_of_a_full_turn_about_an_axis_at_the_edge(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    geometry = Geometry.parallel(np.arange(500) * 2 * np.pi / 500, (2, 160), axis_col=30.0)
    views = resolution_pattern(geometry, rng)
    grid = Grid((2, 180, 180))
    rays, gridded = both_ways(monkeypatch, views, geometry, "hann", grid)
    assert np.abs(gridded - rays).max() < 1e-3 * rays.max()


@pytest.mark.parametrize("gridded", [False, True])
def test_a_single_block_equals_its_part_of_the_volume_to_the_bit(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator, gridded: bool
) -> None:
    """From the rows that it needs alone, for views that were moved up and down as well."""
    monkeypatch.setattr(module, "gridding_pays", lambda *_: gridded)
    shifts = np.stack((np.zeros(30), rng.uniform(-3, 3, 30)), 1)
    geometry = Geometry.parallel(np.arange(30) * np.pi / 30, (40, 64), shifts=shifts)
    views = rng.random((30, 40, 64), dtype=np.float32)
    grid = Grid.matching(geometry)
    whole, plan = fbp(views, geometry, grid), plan_fbp(geometry, grid)
    assert [part.stop for part in plan.blocks] == [16, 32, 40]
    for part in plan.blocks:
        first, end = plan.rows_of(part)
        out = np.empty((part.stop - part.start, 64, 64), np.float32)
        fbp_block(plan, views[:, first:end].copy(), first, part, out)
        np.testing.assert_array_equal(out, whole[part])


def test_gridding_pays_where_there_is_much_to_do() -> None:
    def pays(views: int, cols: int, slices: int = 64) -> bool:
        return gridding_pays(
            views, cols, (cols, cols), slices, lambda n: np.linspace(0, 0.5, n // 2 + 1, dtype=np.float32)
        )

    assert pays(900, 2048) and pays(1800, 1024, 16)
    assert not pays(90, 64) and not pays(10, 2048)
