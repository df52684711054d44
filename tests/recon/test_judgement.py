"""Judgement of a volume: what its figures mean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.judgement import Aspect, TimeLeft, contrast, judge
from recon.voxels import residuals
from recon.voxels.projector import project
from recon.voxels.resolution import ViewResolution, at_voxel_resolution


def _views(volume: Volume) -> Views:
    rows, _, cols = volume.grid.shape
    geometry = Geometry.parallel(np.linspace(0, 3, 20), (rows, cols))
    return Views(project(volume, geometry), geometry)


def _views_and_as_seen(of: Views, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Sixteen of the twenty views, which are compared, and these at the resolution of voxels."""
    some = np.unique(np.linspace(0, 19, 16).round().astype(int))
    views = of.data[some].swapaxes(1, 2)
    return views, at_voxel_resolution(views, ViewResolution.of(of.geometry.select(some), grid))


def _ball(shape: tuple[int, int, int] = (12, 24, 24)) -> Volume:
    grid = Grid(shape, 1.0)
    z, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    return Volume((z**2 + y**2 + x**2 < 25).astype(np.float32), grid)


def test_a_perfect_volume(rng: np.random.Generator) -> None:
    truth = _ball()
    noisy = Volume(truth.data + rng.normal(0, 0.01, truth.data.shape).astype(np.float32), truth.grid)
    views_of = _views(truth)
    both = Views(np.concatenate(2 * [views_of.data]), views_of.geometry.followed_by(views_of.geometry))
    values = judge(noisy, replace(both, used=np.arange(40) < 20), truth).figures
    assert set(values) == {"psnr", "ssim3d", "nrmse", "residual", "residual_held_out"}
    assert values["psnr"] == pytest.approx(40, abs=0.2)  # noise of 1 % of the peak
    assert values["residual"] < 0.05
    views, seen = _views_and_as_seen(views_of, truth.grid)
    alone = np.linalg.norm(seen - views) / np.linalg.norm(views)  # its own projection, as views of that sharpness
    assert judge(truth, views_of, truth).figures["residual"] == pytest.approx(alone, rel=1e-5)


def test_without_a_truth_the_background_tells(rng: np.random.Generator) -> None:
    ball = _ball()
    noisy = Volume(ball.data + rng.normal(0, 0.01, ball.data.shape).astype(np.float32), ball.grid)
    assert set(judge(noisy, _views(ball)).figures) == {"residual"}
    values = contrast(noisy, {"noisy": noisy}, 0)["noisy"]
    assert set(values) == {"snr", "cnr"}
    assert values["snr"] == pytest.approx(40, abs=1.5)  # 20 log10(1 / 0.01)
    assert values["cnr"] == pytest.approx(40, abs=1.5)


def test_bands_of_rows_stand_for_a_large_detector(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    """What is measured in four bands of sixteen of 200 rows, each slice alike, is what all rows give."""
    ball = _ball((200, 24, 24))
    flat = Volume(
        np.repeat(ball.data[100:101], 200, axis=0) * rng.normal(1, 0.1, (24, 24)).astype(np.float32), ball.grid
    )
    views = _views(flat)
    wrong = Volume(flat.data * np.linspace(0.8, 1.0, 24, dtype=np.float32), ball.grid)
    whole = judge(wrong, views).figures["residual"]
    monkeypatch.setattr(residuals, "RAYS", 4 * 16 * 24)
    banded, _ = residuals.residual(wrong.grid, views, 3).alone(wrong, views.geometry)
    assert banded.rays.tolist() == [4 * 16 * 24] * 3
    assert judge(wrong, views).figures["residual"] == pytest.approx(whole, rel=1e-5)


def test_looks_for_which_there_is_no_time_are_named() -> None:
    ball, clock = _ball(), iter(range(9))
    views = _views(ball)
    hurried = TimeLeft(lambda: float(next(clock)), lambda seconds: seconds < 0.1)
    found = judge(ball, views, aspects=Aspect.RESIDUAL | Aspect.STRAY | Aspect.FIT, time=hurried)
    assert found.skipped == (
        "the check for mass where projections show no material",
        "the check for projections that do not fit the volume",
    )
    assert found.stray is None and found.seconds_of_views == pytest.approx(20 / 16 / 2)
    assert judge(ball, views, aspects=Aspect.STRAY).skipped == ()
