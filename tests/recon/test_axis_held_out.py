"""The axis from held-out projections: cones and nearly parallel beams, far start values, noise, and noise alone."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.axis_held_out import axis_by_views
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.prep.align import AxisError
from recon.voxels.projector import Projector
from tests.messages import refused
from tests.recon.bodies import Bodies
from tests.slow_cases import others_slow

VIEWS, ROWS, COLS, SOD, SDD = 36, 6, 64, 60.0, 90.0
BALLS = np.array([[9.0, -4.0, 1.0, 5.0], [-7.0, 6.0, -2.0, 4.0], [-2.0, -10.0, 0.0, 3.0]])  # x, y, z, radius in mm
ANGLES = 2 * np.pi * np.arange(VIEWS) / VIEWS


def _views(axis_col: float, sod: float, sdd: float) -> NDArray[np.float32]:
    """Balls of density 1."""
    balls = Bodies(BALLS[:, :3], np.eye(3) / BALLS[:, 3, None, None], np.ones(3))
    return balls.views(Geometry.cone(ANGLES, (ROWS, COLS), 1.0, sod, sdd, axis_col=axis_col))


@pytest.mark.parametrize(
    ("sod", "sdd", "start", "noise"),
    others_slow([(SOD, SDD, 24.0, 0.3), (1e5, 1e5, 31.5, 0.3), (SOD, SDD, 24.0, 0.0)]),  # 1e5: nearly parallel
)
def test_the_axis_is_found_to_a_tenth_of_a_column(sod: float, sdd: float, start: float, noise: float) -> None:
    views = _views(29.2, sod, sdd) + np.random.default_rng(1).normal(0, noise, (VIEWS, ROWS, COLS)).astype(np.float32)
    found = axis_by_views(views, Geometry.cone(ANGLES, (ROWS, COLS), 1.0, sod, sdd, axis_col=start))
    assert found.value == pytest.approx(29.2, abs=0.1) and found.confident and found.method == "views held out"
    assert abs(found.candidates[found.curve.argmin()] - 29.2) <= 1


@pytest.mark.slow
def test_the_axis_of_a_sample_wider_than_the_field() -> None:
    """Foam in 86 columns, seen in 80 of them. The field alone has no room for the rest, and each axis looks alike."""
    rng, rows, n = np.random.default_rng(1), 12, 96
    y, x = np.mgrid[:n, :n] - (n - 1) / 2
    cells = np.kron(rng.random((rows // 4, n // 4, n // 4)) > 0.6, np.ones((4, 4, 4)))
    foam = (0.01 * cells * (np.hypot(x, y) < 43)).astype(np.float32)
    whole = Geometry.cone(2 * np.pi * np.arange(48) / 48, (rows, 2 * n), 1.0, 2.5 * n, 5.0 * n, axis_col=n + 1.8)
    views = Projector(whole, Grid(foam.shape, 1.0)).forward(foam)[..., 56:-56]
    views += rng.normal(0, 0.01, views.shape).astype(np.float32)
    found = axis_by_views(views, replace(whole, detector_shape=views.shape[1:], axis_col=39.5))
    assert found.value == pytest.approx(41.8, abs=0.2) and found.confident


@pytest.mark.slow
@pytest.mark.parametrize("dark", [64, 72])
def test_the_axis_where_part_of_the_detector_has_no_beam(dark: int) -> None:
    """To half a column: the dark part counts as not measured; its pixels hold a wall."""
    n = 96
    y, x = np.mgrid[:n, :n] - (n - 1) / 2
    disc = np.where(np.hypot(x, y) < 34, 0.02, 0) + np.where(np.hypot(x - 10, y - 6) < 6, 0.02, 0)
    disc[(np.abs(0.9 * x + 0.3 * y + 8) < 1) & (np.abs(y) < 18)] = 0
    geometry = Geometry.parallel(np.pi * np.arange(60) / 60, (6, n), axis_col=48.6)
    volume = np.repeat(disc[None], 6, 0).astype(np.float32)
    views = Projector(geometry, Grid(volume.shape, 1.0)).forward(volume)
    views += np.random.default_rng(0).normal(0, 0.01, views.shape).astype(np.float32)
    views[..., dark:] = 5.0
    lit = np.broadcast_to(np.arange(n) < dark, (6, n))
    found = axis_by_views(views, replace(geometry, axis_col=47.5), lit=lit)
    assert found.value == pytest.approx(48.6, abs=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("sides", [1, 2])
def test_the_axis_where_posts_pass_in_front_of_the_sample(sides: int) -> None:
    """Their pixels are filled with what draws the axis away; they count as not measured."""
    n, angles = 96, np.pi * np.arange(90) / 90
    balls = Bodies(1.5 * BALLS[:, :3], np.eye(3) / (1.5 * BALLS[:, 3, None, None]), np.ones(3))
    views = balls.views(geometry := Geometry.parallel(angles, (6, n), axis_col=46.2))
    lit = np.ones(views.shape, np.bool_)
    for side in range(sides):
        middle = 46.2 + 50 * np.cos(angles + 0.3 + np.pi * side)
        lit &= (np.abs(np.arange(n) - middle[:, None]) > 9)[:, None]
    views[~lit] = 2.0
    found = axis_by_views(views, replace(geometry, axis_col=47.5), lit=lit)
    assert found.value == pytest.approx(46.2, abs=0.15) and found.confident


@pytest.mark.slow
def test_an_axis_beyond_the_search_is_an_error_and_noise_shows_none() -> None:
    with pytest.raises(AxisError, match=r"12 columns.*best with column"):
        axis_by_views(_views(29.2, SOD, SDD), Geometry.cone(ANGLES, (ROWS, COLS), 1.0, SOD, SDD, axis_col=50.0))
    noise = np.random.default_rng(0).normal(0, 1, (VIEWS, ROWS, COLS)).astype(np.float32)
    with suppress(AxisError):  # the minimum of noise may lie at an edge
        assert not axis_by_views(noise, Geometry.cone(ANGLES, (ROWS, COLS), 1.0, SOD, SDD)).confident


def test_few_views_are_refused() -> None:
    with refused(ValueError):
        axis_by_views(np.ones((11, ROWS, COLS), np.float32), Geometry.cone(ANGLES[:11], (ROWS, COLS), 1.0, SOD, SDD))


def test_views_without_matter_are_refused() -> None:
    """Where all of them are, or those that are held out."""
    views = _views(29.2, SOD, SDD)
    for empty in (range(VIEWS), range(1, VIEWS, 3)):
        some = views.copy()
        some[list(empty)] = 0
        with refused((AxisError, ValueError)):
            axis_by_views(some, Geometry.cone(ANGLES, (ROWS, COLS), 1.0, SOD, SDD, axis_col=29.2))
