"""FBP along the rays of rolled and tilted projections, compared with ground truth, FBP and FDK."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.direct import direct, fdk, has_direct_method, posed_direct
from recon.voxels.fbp import fbp
from tests.messages import refused
from tests.recon.voxels.test_projector import ellipsoid_shadow, smooth_ball
from tests.slow_cases import others_slow

_AXES, _CENTRE = np.array([0.5, 0.35, 0.4]), np.array([0.12, -0.2, 0.1])
_GRID = Grid((40, 60, 60), 0.03)


def _views(cone: bool, n: int = 90) -> Geometry:
    angles = np.arange(n) * 2 * np.pi / n
    if cone:
        return Geometry.cone(angles, (60, 80), 0.045, 10.0, 15.0, axis_col=40.3)
    return Geometry.parallel(angles, (60, 80), pixel_pitch=0.03, axis_col=40.3)


def _error(volume: np.ndarray) -> float:
    """Relative root mean square against the true ellipsoid."""
    truth = smooth_ball(_GRID, _AXES, _CENTRE)
    return float(np.linalg.norm(volume - truth) / np.linalg.norm(truth))


@pytest.mark.parametrize("cone", [False, True])
def test_straight_views_give_the_volume_of_fbp_and_fdk(cone: bool) -> None:
    views = replace(_views(cone), shifts=np.full((90, 2), (0.7, -1.3)))
    data = ellipsoid_shadow(views, _AXES, _CENTRE).astype(np.float32)
    expected = (fdk if cone else fbp)(data, views, _GRID, "hann")
    np.testing.assert_allclose(posed_direct(data, views, _GRID, "hann"), expected, atol=2e-3)


@pytest.mark.parametrize("cone", others_slow([False, True]))
def test_leaning_views_are_reconstructed_about_as_well_as_straight_ones(cone: bool) -> None:
    straight = _views(cone)
    wobble = {
        "shifts": np.stack((2 * np.cos(3 * straight.angles), 3 * np.sin(straight.angles)), axis=1),
        "roll": np.deg2rad(2 + np.cos(straight.angles)),
        "tilt": np.deg2rad(1.5 * np.sin(straight.angles)),
    }
    posed = replace(straight, **wobble)
    best = _error(direct(ellipsoid_shadow(straight, _AXES, _CENTRE).astype(np.float32), straight, _GRID, "hann"))
    data = ellipsoid_shadow(posed, _AXES, _CENTRE).astype(np.float32)
    assert has_direct_method(posed)
    # Slices between two rows are interpolated from both, which blurs; the straight views' rows lie on the slices.
    assert _error(direct(data, posed, _GRID, "hann")) < 1.1 * best
    assert _error(direct(data, straight, _GRID, "hann")) > 1.5 * best  # the poses matter


def test_an_axis_that_leans_far_loses_the_missing_cone_alone() -> None:
    """Laminography: of the directions of Fourier space a cone about the axis is missing, a share 1 - cos(tilt)."""
    views = replace(_views(False), tilt=np.full(90, np.deg2rad(30)), roll=np.full(90, np.deg2rad(20)))
    data = ellipsoid_shadow(views, _AXES, _CENTRE).astype(np.float32)
    found = posed_direct(data, views, _GRID, "hann")
    inside = smooth_ball(_GRID, _AXES * 0.6, _CENTRE) == 1
    assert found[inside].mean() == pytest.approx(np.cos(np.deg2rad(30)), abs=0.01)


def test_one_row_that_rolls() -> None:
    views = replace(_views(False), roll=np.full(90, 0.01)).rows(30, 31)
    data = ellipsoid_shadow(views, _AXES, _CENTRE).astype(np.float32)
    grid = replace(Grid.matching(views), shape=(1, 60, 60))
    straight = fbp(data, replace(views, roll=np.zeros(90)), grid, "hann")
    found = posed_direct(data, views, grid, "hann")
    assert np.abs(found - straight)[0, 20:40, 20:40].max() < 0.1 * straight.max()


def test_values_that_are_not_finite_and_boxes_at_the_source_are_named() -> None:
    views = replace(_views(True), roll=np.full(90, 0.01))
    data = np.zeros((90, 60, 80), np.float32)
    for value in (np.nan, np.finfo(np.float32).max):  # the last one is finite before the filter
        data[3, 2, 1] = value
        with refused(ValueError), np.errstate(over="ignore", invalid="ignore"):
            posed_direct(data, views, _GRID)
    with refused(ValueError):
        posed_direct(data, views, Grid((4, 60, 60), 0.5))
    with refused(ValueError):
        posed_direct(data[1:], views, _GRID)
