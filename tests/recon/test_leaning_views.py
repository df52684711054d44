"""Every method can use rolled and tilted projections; compared with a reconstruction that ignores these poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import recon
from recon import methods
from recon.auto import Auto
from recon.base.geometry import Geometry
from recon.base.view_data import Views
from recon.voxels.field_edges import busiest_rows, slab_of
from recon.voxels.odd_views import odd_views
from recon.voxels.projector import Projector, seen_rays
from tests.recon.helpers import data_residual
from tests.recon.voxels.test_projector import ellipsoid_shadow, smooth_ball

AXES, CENTRE = np.array([0.4, 0.3, 0.25]), np.array([0.08, -0.1, 0.06])
GRID = recon.Grid((28, 32, 32), 0.04)
ANGLES = np.arange(32) * 2 * np.pi / 32
# Their rays are those of r2 and fista-tv.
QUICK = "fbp", "cgls"
CONES = "r2", "fbp", "sirt"  # whose rays of a cone are those of the others
LIKE_OTHERS = "r2-published", "series", "from-reference"
SHORT = {
    "r2": {"steps": 60, "gaussians": 300, "finish": 4},
    "r2-published": {"steps": 60, "gaussians": 300},
    "fbp": {},
}


def leaning(cone: bool, degrees: float = 4.0) -> Geometry:
    """Views whose roll and tilt differ from view to view, shifted along the rows and the columns."""
    shifts = np.stack((1.5 * np.cos(2 * ANGLES), 1.5 * np.sin(ANGLES)), axis=1)
    lean = {
        "shifts": shifts,
        "roll": np.deg2rad(degrees) * np.cos(ANGLES + 1),
        "tilt": np.deg2rad(degrees) * np.sin(3 * ANGLES),
    }
    if cone:
        return Geometry.cone(ANGLES, (32, 38), 0.06, 8.0, 12.0, axis_col=18.7, **lean)
    return Geometry.parallel(ANGLES, (32, 38), pixel_pitch=0.04, axis_col=18.7, **lean)


def rays(geometry: Geometry) -> np.ndarray:
    return ellipsoid_shadow(geometry, AXES, CENTRE).astype(np.float32)


def error(volume: np.ndarray) -> float:
    return float(np.linalg.norm(volume - smooth_ball(GRID, AXES, CENTRE)))


@pytest.mark.parametrize(
    ("name", "cone"),
    [
        pytest.param(
            name,
            cone,
            marks=[pytest.mark.slow] * (name not in QUICK),
        )
        for name in methods.names()
        if name not in LIKE_OTHERS
        for cone in (False, True)[: 1 + (name in CONES)]
    ],
)
def test_poses_that_are_known_better_the_volume(
    name: str, cone: bool, rng: np.random.Generator, request: pytest.FixtureRequest
) -> None:
    if "rays" in SHORT.get(name, {}):
        request.getfixturevalue("one_thread")
    geometry, method = leaning(cone), methods.build(methods.by_name(name), SHORT.get(name, {"iterations": 6}))
    data = rays(geometry) + rng.normal(0, 0.003, (32, 32, 38)).astype(np.float32)
    straight = replace(geometry, roll=np.zeros(32), tilt=np.zeros(32), shifts=np.zeros((32, 2)))
    known, unknown = (
        error(recon.reconstruct(data, views, method, grid=GRID).volume.data) for views in (geometry, straight)
    )
    assert known < 0.75 * unknown


def test_auto_tries_leaning_views_on_rows_and_all_slices_that_they_see() -> None:
    """The part's box holds all matter that its rays meet: the true volume explains them."""
    geometry = replace(leaning(False, 1.5), detector_shape=(96, 38), axis_row=47.5)
    tall = recon.Grid((84, 32, 32), 0.04)
    axes = AXES * (1, 1, 6)  # matter above and below the rows
    data = ellipsoid_shadow(geometry, axes, CENTRE).astype(np.float32)
    rows = busiest_rows(data, 24)
    part, box = slab_of(geometry, tall, rows.start, rows.stop)
    truth = recon.Volume(smooth_ball(box, axes, CENTRE), box)
    assert box.shape[0] < tall.shape[0] / 2 and data_residual(truth, data[:, rows], part) < 0.05


@pytest.mark.parametrize("degrees", [0.0, 1.5])
def test_rays_that_leave_the_slices_are_not_seen(degrees: float) -> None:
    """Of a long sample the slices in the box explain the rays that are said to be seen, and hardly others."""
    geometry = leaning(False, degrees)
    geometry = replace(geometry, shifts=5 * geometry.shifts)  # by up to 7.5 rows
    grid, axes = recon.Grid((20, 32, 32), 0.04), AXES * (1, 1, 8)
    data = ellipsoid_shadow(geometry, axes, CENTRE)
    left = np.abs(Projector(geometry, grid).forward(smooth_ball(grid, axes, CENTRE)) - data)
    seen = np.broadcast_to(seen_rays(geometry, grid), data.shape)
    thick = data > 0.8 * data.max()
    assert seen[thick].mean() > 0.3 and left[thick & seen].max() < 0.06 * data.max()
    assert np.median(left[thick & ~seen]) > 0.1 * data.max()


def test_auto_chooses_by_views_held_out() -> None:
    geometry = leaning(False)
    auto = Auto((methods.build(methods.by_name("sirt"), {"iterations": 4}), methods.by_name("fbp")()))
    found = recon.reconstruct(rays(geometry), geometry, auto, grid=GRID)
    assert "residual in held-out projections" in found.settings["chosen_because"]


@pytest.mark.parametrize("cone", [False, True])
def test_a_view_that_differs_is_found_among_leaning_ones(cone: bool, rng: np.random.Generator) -> None:
    geometry = leaning(cone)
    data = rays(geometry) + rng.normal(0, 0.003, (32, 32, 38)).astype(np.float32)
    truth = recon.Volume(smooth_ball(GRID, AXES, CENTRE), GRID)
    assert odd_views(truth.grid, Views(data, geometry)).alone(truth, geometry) == ()
    data[11, 10:20, 14:24] += 0.1
    assert [odd.view for odd in odd_views(truth.grid, Views(data, geometry)).alone(truth, geometry)] == [11]
