"""FDK compared with closed forms: chords of balls, squared magnification, absolute values in 1/mm."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.kernels.cpu import joseph
from recon.voxels import direct as direct_module
from recon.voxels.direct import fdk
from recon.voxels.fbp import fbp
from tests.messages import refused
from tests.recon.bodies import Bodies
from tests.slow_cases import others_slow


def ball_views(geometry: Geometry, radius: float, centre: tuple[float, float, float]) -> NDArray[np.float32]:
    """Line integrals of a ball of attenuation 1 at (x, y, z)."""
    return Bodies(np.array([centre]), np.eye(3)[None] / radius, np.ones(1)).views(geometry)


def circle(n: int) -> NDArray[np.float64]:
    return np.arange(n) * 2 * np.pi / n


def inside(grid: Grid, radius: float, centre: tuple[float, float, float]) -> NDArray[np.bool_]:
    z, y, x = grid.coordinates()
    return (x - centre[0]) ** 2 + (y[:, None] - centre[1]) ** 2 + (z[:, None, None] - centre[2]) ** 2 < radius**2


@pytest.mark.parametrize("arc", others_slow([210, 250, 320]))
def test_a_short_scan_shows_the_ball_as_a_full_turn_does(arc: float, rng: np.random.Generator) -> None:
    angles = rng.permutation(np.deg2rad(np.linspace(0, arc, 160) + 40))
    short = Geometry.cone(angles, (17, 48), 1.0, 80.0, 160.0)
    whole = Geometry.cone(circle(240), (17, 48), 1.0, 80.0, 160.0)
    grid, centre = Grid((3, 48, 48), 0.5), (3.0, -2.0, 0.0)
    found, expected = (fdk(ball_views(views, 5.0, centre), views, grid, "hann") for views in (short, whole))
    ball = inside(grid, 4.0, centre)
    assert found[ball].mean() == pytest.approx(1, abs=0.01)
    np.testing.assert_allclose(found[1], expected[1], atol=0.05)


@pytest.mark.parametrize("window", ["ram-lak", "shepp-logan", "hann"])
def test_a_ball_in_the_middle_has_its_attenuation(window: str) -> None:
    geometry = Geometry.cone(circle(90), (64, 64), 0.1, 10.0, 20.0)
    grid = Grid((9, 64, 64), 0.05)
    views = np.repeat(ball_views(geometry.select([0]), 1.0, (0, 0, 0)), 90, axis=0)  # it looks the same from all sides
    volume = fdk(views, geometry, grid, window)  # type: ignore[arg-type]
    core = volume[inside(grid, 0.8, (0, 0, 0))]
    assert core.mean() == pytest.approx(1.0, abs=0.003)
    assert np.abs(core - 1).max() < 0.03
    assert abs(volume[~inside(grid, 1.15, (0, 0, 0)) & inside(grid, 1.5, (0, 0, 0))].mean()) < 0.01


def test_a_ball_anywhere_with_offsets_shifts_and_random_angles(rng: np.random.Generator) -> None:
    """Off the axis, off the middle plane, the axis off the detector's middle; 400 views in random order and turn."""
    angles = rng.permutation(circle(120)) + 2 * np.pi * rng.integers(-2, 3, 120)
    shifts = rng.uniform(-3, 3, (120, 2))
    geometry = Geometry.cone(angles, (70, 90), 0.1, 12.0, 20.0, axis_col=41.3, axis_row=30.8, shifts=shifts)
    centre = (0.6, -0.5, 0.35)
    grid = Grid((30, 34, 36), 0.05, (0.3, -0.45, 0.55))
    volume = fdk(ball_views(geometry, 0.7, centre), geometry, grid)
    core = volume[inside(grid, 0.5, centre)]
    assert core.mean() == pytest.approx(1.0, abs=0.01)
    # The outline is where it belongs: half of the ball's value, in the mean over its surface.
    z, y, x = grid.coordinates()
    weight = np.where(inside(grid, 0.85, centre), volume, 0)
    found = [(weight * c).sum() / weight.sum() for c in (x, y[:, None], z[:, None, None])]
    np.testing.assert_allclose(found, centre, atol=0.01)


@pytest.mark.parametrize("axis_col", others_slow([14.0, 75.0]))
def test_a_detector_beside_the_axis_sees_twice_its_half(axis_col: float) -> None:
    """A wide field: balls on the axis and where one half of the turn alone sees them, and air between them."""
    geometry = Geometry.cone(circle(240), (24, 90), 0.1, 30.0, 40.0, axis_col=axis_col)
    grid, centre = Grid.matching(geometry), (3.2, -1.5, 0.0)
    assert grid.shape[2] == pytest.approx(2 * 75.5, abs=1)
    volume = fdk(ball_views(geometry, 0.7, centre) + ball_views(geometry, 0.6, (0, 0, 0)), geometry, grid)
    for radius, at in ((0.5, centre), (0.4, (0.0, 0.0, 0.0))):
        assert volume[inside(grid, radius, at)].mean() == pytest.approx(1.0, abs=0.015)
    assert abs(volume[inside(grid, 0.5, (-3.2, 1.5, 0.0))].mean()) < 0.01
    assert abs(volume[inside(grid, 0.5, (1.6, -0.75, 0.0))].mean()) < 0.02


def test_progress_counts_layers_up_to_all(monkeypatch: pytest.MonkeyPatch) -> None:
    views = Geometry.cone(np.linspace(0, 2 * np.pi, 12, endpoint=False), (8, 20), 0.05, 40.0, 60.0)
    monkeypatch.setattr(joseph, "CALL", 1)
    monkeypatch.setattr(direct_module, "SLAB_BYTES", 4 * 8 * 20 * 5)  # five views at a time
    told: list[tuple[int, int]] = []
    fdk(np.ones((12, 8, 20), np.float32), views, on_block=lambda n, of: told.append((n, of)))
    assert told == sorted(told) and len(told) > 20 and told[-1] == (20, 20)


def test_a_far_source_is_fbp() -> None:
    angles = circle(60)
    far = Geometry.cone(angles, (9, 40), 0.1, 1e5, 1e5)
    near = Geometry.parallel(angles, (9, 40), pixel_pitch=0.1)
    views = ball_views(far, 1.0, (0.3, 0.2, 0.05))
    grid = Grid((5, 30, 30), 0.1, (0.02, 0, 0))
    np.testing.assert_allclose(fdk(views, far, grid), fbp(views, near, grid), atol=2e-3)


@pytest.mark.parametrize("rows", [1, 6])
def test_a_slice_alone_is_that_of_a_stack(rows: int, rng: np.random.Generator) -> None:
    views = Geometry.cone(circle(20), (rows, 20), 1.0, 60.0, 90.0)
    data = rng.random((20, rows, 20), dtype=np.float32)
    stack = fdk(data, views, Grid((9, 20, 20), 0.7))
    for z in range(9):
        alone = fdk(data, views, Grid((1, 20, 20), 0.7, ((z - 4) * 0.7, 0.0, 0.0)))
        np.testing.assert_allclose(alone[0], stack[z], rtol=1e-5, atol=2e-5 * stack.max())
    assert stack[4].any() and not stack[[0, 8]].all()


def test_a_voxel_off_the_detector_gets_nothing() -> None:
    geometry = Geometry.cone(circle(30), (4, 40), 0.1, 10.0, 20.0)
    volume = fdk(ball_views(geometry, 1.0, (0, 0, 0)), geometry, Grid((21, 8, 8), 0.05))
    assert (volume[[0, -1]] == 0).all()
    assert (volume[10, 3:5, 3:5] > 0.9).all()


def test_misfits_are_named() -> None:
    views = np.ones((12, 4, 6), np.float32)
    geometry = Geometry.cone(circle(12), (4, 6), 0.1, 10.0, 20.0)
    with refused(ValueError):
        fdk(views, Geometry.parallel(circle(12), (4, 6)))
    with refused(ValueError):
        fdk(views, Geometry.cone(circle(12), (4, 6), 0.1, 10.0, 20.0, tilt=0.1))
    with refused(ValueError):
        fdk(views[:5], geometry)
    with refused(ValueError):
        fdk(views, geometry, Grid((2, 9, 9), 2.0))
    with refused(ValueError):
        fdk(views, geometry, filter="box")  # type: ignore[arg-type]
    for value in (np.nan, np.inf, np.finfo(np.float32).max):  # the last one is finite before the filter
        views[3, 1, 2] = value
        with refused(ValueError), np.errstate(over="ignore", invalid="ignore"):
            fdk(views, geometry)
