"""What a scan will take is measured on parts of it: the parts are real ones, of any beam, and the times add up."""

from __future__ import annotations

import numpy as np
import pytest

from recon import machine_speed as module
from recon.base.geometry import Geometry
from recon.base.volume import Grid, Volume
from recon.machine_speed import measured_speeds
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import default_count, first_volume
from recon.splatting.settings import FitSettings
from recon.splatting.splat import project

SHAPE = (24, 60)
TURN = np.linspace(0, 2 * np.pi, 40, endpoint=False)
BEAMS = {
    "parallel": Geometry.parallel(TURN / 2, SHAPE, pixel_pitch=0.1),
    "cone": Geometry.cone(TURN, SHAPE, 1.0, 30.0, 300.0),
    "short scan of a cone": Geometry.cone(TURN * 0.45, SHAPE, 1.0, 30.0, 300.0),
    "leaning": Geometry.parallel(TURN / 2, SHAPE, pixel_pitch=0.1, tilt=0.1),
}


class Counting:
    """A clock that only work moves on."""

    time = 0.0

    def __call__(self) -> float:
        return self.time


def _views(geometry: Geometry) -> np.ndarray:
    rng = np.random.default_rng(0)
    blobs = Gaussians.from_physical(rng.uniform(-1.2, 1.2, (20, 3)), np.full(20, 0.4), np.full(20, 0.3))
    return project(blobs, geometry).numpy()


@pytest.mark.parametrize("beam", BEAMS)
def test_every_beam_is_measured_by_its_own_pixels_at_the_axis(beam: str, monkeypatch: pytest.MonkeyPatch) -> None:
    geometry = BEAMS[beam]
    assert geometry.sample_pitch == pytest.approx(0.1)
    spread: list[Gaussians] = []
    plain = module._step
    monkeypatch.setattr(module, "_step", lambda *said: spread.append(said[3]) or plain(*said))
    grid, ticks = Grid.matching(geometry), iter(range(100_000))
    speeds = measured_speeds(_views(geometry), geometry, grid, lambda: float(next(ticks)))
    # As many Gaussians as a fit would start from, within the field, and not wider than a few of its pixels.
    assert spread[0].n == default_count(geometry, 0.1) == 2000
    assert np.abs(spread[0].means.numpy()[:, :2]).max() <= 0.1 * 60 / 2 * 1.5
    assert 0.05 <= float(spread[0].scales.max()) < 0.5
    assert spread[0].kernel is FitSettings().kernel
    assert min(speeds.fbp, speeds.start, speeds.step, speeds.fill) > 0


@pytest.mark.parametrize("beam", ["parallel", "cone", "short scan of a cone"])
def test_a_slab_of_some_views_is_scaled_to_the_whole(beam: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a first volume that takes a second a voxel and view, the prediction is voxels times views."""
    geometry, clock = BEAMS[beam], Counting()

    def first(projections: np.ndarray, views: Geometry, grid: Grid) -> Volume:
        clock.time += np.prod(grid.shape) * views.n_views
        return first_volume(projections, views, grid)

    monkeypatch.setattr(module, "first_volume", first)
    grid = Grid.matching(geometry)
    speeds = measured_speeds(_views(geometry), geometry, grid, clock)
    assert speeds.fbp == pytest.approx(np.prod(grid.shape) * geometry.n_views)


@pytest.mark.parametrize("beam", ["cone", "parallel"])
@pytest.mark.parametrize("order", [np.arange(40), np.random.default_rng(1).permutation(40)])
def test_some_views_stand_all_around_in_any_order(beam: str, order: np.ndarray) -> None:
    geometry = BEAMS[beam].select(order)
    some = module._around(geometry, 10)
    turn = 2 * np.pi if geometry.is_cone else np.pi
    assert some.size == 10 and (np.diff(some) > 0).all()
    places = np.sort(np.mod(geometry.angles[some], turn))
    np.testing.assert_allclose(np.diff(places, append=places[0] + turn), turn / 10)
    assert module._around(geometry, 99).tolist() == list(range(40))


def test_shifted_views_are_measured_on_all_that_they_see() -> None:
    # Moved by as much as the detector is high or nearly as wide, with an axis that makes up for it: the same scan.
    plain, ticks = BEAMS["parallel"], iter(range(100_000))
    shifts = np.tile([50.0, 24.0], (40, 1))
    moved = Geometry.parallel(TURN / 2, SHAPE, pixel_pitch=0.1, axis_col=29.5 - 50, axis_row=11.5 - 24, shifts=shifts)
    grid = Grid.matching(plain)
    assert Grid.for_fit(moved, grid) == Grid.for_fit(plain, grid)
    speeds = measured_speeds(_views(plain), moved, grid, lambda: float(next(ticks)))
    assert min(speeds.fbp, speeds.start, speeds.step, speeds.fill) > 0


def test_views_of_nothing_are_refused() -> None:
    geometry = BEAMS["cone"]
    with pytest.raises(ValueError, match="no matter"):
        measured_speeds(np.zeros((40, *SHAPE), np.float32), geometry, Grid.matching(geometry), lambda: 0.0)
