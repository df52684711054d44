"""Weights of projections and rays: together they cover what was measured; the two rays of a line share its weight."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from recon import reconstruct
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.fbp import fbp
from recon.voxels.view_weights import (
    angular_weights,
    circle_weights,
    cone_weights,
    density_errors,
    density_gain,
    missing_arc,
    ray_weights,
    unseen_wedges,
)
from tests.messages import refused
from tests.recon.voxels.test_fbp import disc_views, half_turn


def full_turn(n: int) -> np.ndarray:
    return np.arange(n) * 2 * np.pi / n


@given(n=st.integers(2, 40), cols=st.integers(1, 30), twice=st.integers(-40, 100), seed=st.integers(0, 99))
def test_every_line_has_its_weight_once(n: int, cols: int, twice: int, seed: int) -> None:
    # The axis falls on a column or between two, so that each ray's mirror image is a ray of the detector or none.
    angles = np.random.default_rng(seed).permutation(full_turn(2 * n)) + 0.3
    geometry = Geometry.parallel(angles, (1, cols), axis_col=twice / 2)
    weights, (before, after) = ray_weights(geometry)
    weights = weights[:, 1:-1]
    assert weights.shape == (2 * n, cols) and weights.min() >= 0
    assert before == min(max(0, cols - 1 - twice), 2 * cols) and after == min(max(0, twice - cols + 1), 2 * cols)
    for view, angle in enumerate(angles):
        off = np.abs(np.mod(angles - angle - np.pi / 2, 2 * np.pi) - np.pi / 2)
        opposite = weights[int(off.argmin())]
        for col in range(cols):
            again = twice - col
            other = opposite[again] if 0 <= again < cols else 0
            assert weights[view, col] + other == pytest.approx(np.pi / n)


@given(cols=st.integers(1, 30), axis_col=st.floats(-20, 50))
def test_what_lies_beyond_the_edges_has_its_weight_once(cols: int, axis_col: float) -> None:
    """At the edge which lies farther from the axis, unless that is a column's fraction farther; else at both."""
    weights, zeros = ray_weights(Geometry.parallel(full_turn(8), (1, cols), axis_col=axis_col))
    ends = weights[:, (0, -1)]
    np.testing.assert_allclose(ends.sum(axis=1), np.pi / 4)
    if max(zeros) > 1:
        np.testing.assert_array_equal(ends[:, zeros.index(max(zeros))], 0)


@pytest.mark.parametrize("span", [np.pi, 1.3 * np.pi])
def test_columns_are_alike_where_no_full_turn_is(span: float) -> None:
    angles = np.linspace(0, span, 60, endpoint=False)
    weights, zeros = ray_weights(Geometry.parallel(angles, (1, 40), axis_col=7.0))
    assert zeros == (0, 0)
    np.testing.assert_array_equal(weights, np.repeat(angular_weights(angles)[:, None], 42, 1))


@pytest.mark.parametrize("n", [8, 9, 360])
def test_an_axis_in_the_middle_leaves_all_columns_alike(n: int) -> None:
    weights, zeros = ray_weights(Geometry.parallel(full_turn(n), (1, 40)))
    assert zeros == (0, 0)
    np.testing.assert_allclose(weights, np.pi / n, rtol=1e-12)


@pytest.mark.parametrize("axis_col", [6.0, 20.4, 31.7, 55.0, 90.0])
@pytest.mark.parametrize("n", [360, 361])
def test_a_full_turn_off_the_middle_shows_the_disc_as_a_wide_detector_does(axis_col: float, n: int) -> None:
    # A disc that no view sees whole where the axis is far off; the reference sees all of it in half a turn.
    there, wide = Geometry.parallel(full_turn(n), (1, 97), axis_col=axis_col), Grid((1, 150, 150))
    radius, centre = 0.75 * max(axis_col, 96 - axis_col), (6.0, -9.0)
    radius -= np.hypot(*centre)
    all_of_it = Geometry.parallel(np.arange(360) * np.pi / 360, (1, 251))
    expected = fbp(disc_views(all_of_it, radius, centre), all_of_it, wide, "hann")[0]
    found = fbp(disc_views(there, radius, centre), there, wide, "hann")[0]
    _, y, x = wide.coordinates()
    away = np.hypot(x - centre[0], y[:, None] - centre[1])
    inside, edge = away < radius - 2, np.abs(away - radius) < 3
    assert found[inside].mean() == pytest.approx(1, abs=0.003)
    seen = np.hypot(x, y[:, None]) < max(axis_col, 96 - axis_col)
    assert np.abs(found - expected)[~edge & seen].max() < 0.02


def test_views_that_are_moved_to_either_side_make_one_wide_detector() -> None:
    # Every second pair of opposite views stands off to the other side: the columns that lack a partner differ.
    angles = full_turn(360)
    shifts = np.stack((np.where(np.arange(360) % 180 % 2 == 0, 18.0, -18.0), np.zeros(360)), 1)
    geometry = Geometry.parallel(angles, (1, 81), shifts=shifts)
    views = np.zeros((360, 1, 81), np.float32)
    for view, (angle, shift) in enumerate(zip(angles, shifts[:, 0], strict=True)):
        views[view] = disc_views(Geometry.parallel([angle], (1, 81), axis_col=40 + shift), 40, (3.0, 5.0))[0]
    grid = Grid((1, 100, 100))
    found = fbp(views, geometry, grid)[0]
    _, y, x = grid.coordinates()
    assert found[np.hypot(x - 3, y[:, None] - 5) < 37].mean() == pytest.approx(1, abs=0.005)


@given(st.lists(st.floats(-20, 20, allow_nan=False), min_size=1, max_size=40))
def test_weights_cover_the_measured_angle(angles: list[float]) -> None:
    weights = angular_weights(angles)
    assert weights.shape == (len(angles),)
    assert (weights >= 0).all()
    assert 0 < weights.sum() <= np.pi * (1 + 1e-12)


@given(st.integers(2, 60), st.floats(-7, 7), st.integers(0, 2**31))
def test_equal_steps_in_any_order_weigh_the_same(n: int, start: float, seed: int) -> None:
    angles = start + half_turn(n) + np.pi * np.random.default_rng(seed).integers(-2, 3, n)
    np.testing.assert_allclose(angular_weights(angles), np.pi / n, rtol=1e-9)
    np.testing.assert_allclose(angular_weights(np.random.default_rng(seed).permutation(angles)), np.pi / n, rtol=1e-9)


def test_views_half_a_turn_apart_share_their_weight() -> None:
    closed = np.linspace(0, np.pi, 91)  # holds both 0 and 180 degrees
    weights = angular_weights(closed)
    np.testing.assert_allclose(weights[1:-1], np.pi / 90, rtol=1e-9)
    np.testing.assert_allclose(weights[[0, -1]], np.pi / 180, rtol=1e-9)
    np.testing.assert_allclose(angular_weights(np.linspace(0, 2 * np.pi, 180, endpoint=False)), np.pi / 180, rtol=1e-9)
    np.testing.assert_allclose(angular_weights([0.3, 0.3 + np.pi, 0.3 + 2 * np.pi]), np.pi / 3, rtol=1e-9)


def test_uneven_steps_weigh_by_their_cells() -> None:
    # Cells on the circle of length π: neighbours 0 | 1 | 1.5 and back to π.
    np.testing.assert_allclose(angular_weights([0, 1.5, 1]), [(np.pi - 1.5 + 1) / 2, (0.5 + np.pi - 1.5) / 2, 0.75])


@pytest.mark.parametrize("n", [12, 20, 45, 400])
def test_random_angles_cover_the_half_circle(n: int) -> None:
    # Their widest gap is chance, not a missing wedge: no density may be lost.
    sums = [angular_weights(np.random.default_rng(seed).uniform(-np.pi, np.pi, n)).sum() for seed in range(400)]
    assert np.isclose(sums, np.pi).mean() > 0.99


@pytest.mark.parametrize(("span", "n"), [(3, 3), (4, 4), (30, 8), (90, 45), (120, 20), (150, 600), (170, 170)])
def test_a_real_wedge_is_missed_however_dense_the_views(span: float, n: int) -> None:
    angles = np.deg2rad(np.arange(n) * span / n)
    np.testing.assert_allclose(angular_weights(angles), np.deg2rad(span / n), rtol=1e-9)


def test_gaps_between_groups_are_sampling_and_lose_no_density() -> None:
    """Views in groups, a part repeated finely, turns that nearly repeat: also for the slices that some of them see."""
    even = np.arange(0, 180, 2.0)
    groups = np.concatenate([18 * k + 0.5 * np.arange(12) for k in range(20)])
    finely = np.sort(np.concatenate((even, np.arange(0.01, 20, 0.02))))
    for degrees in (groups, finely, np.arange(0, 12 * 360, 7.013)):
        weights = angular_weights(np.radians(degrees))
        assert weights.sum() == pytest.approx(np.pi) and weights.max() < np.radians(13)
        assert angular_weights(np.radians(degrees[1:]), np.radians(degrees)).sum() == pytest.approx(np.pi)
    assert circle_weights(np.radians(groups)).sum() == pytest.approx(2 * np.pi)
    geometry = Geometry.parallel(np.radians(groups), (1, 64))
    shown = fbp(disc_views(geometry, 20, (0.0, 0.0)), geometry, Grid((1, 64, 64)), "hann")[0]
    assert shown[22:42, 22:42].mean() == pytest.approx(1, abs=0.01)


def test_two_missing_sectors_are_missed_however_wide() -> None:
    for far in (20, 50, 70):
        degrees = np.concatenate((np.arange(0, 90 - far, 0.5), np.arange(90, 180 - far, 0.5)))
        assert np.degrees(angular_weights(np.radians(degrees)).sum()) == pytest.approx(180 - 2 * far, abs=0.1)


@pytest.mark.parametrize("angles", [[], [0.0, np.nan]])
def test_weights_of_no_angle_are_refused(angles: list[float]) -> None:
    with refused(ValueError):
        angular_weights(angles)


@given(st.integers(8, 200), st.floats(-7, 7), st.integers(0, 2**31))
def test_equal_steps_of_a_circle_weigh_the_same(n: int, start: float, seed: int) -> None:
    angles = start + np.random.default_rng(seed).permutation(full_turn(n))
    np.testing.assert_allclose(circle_weights(angles), 2 * np.pi / n, rtol=1e-9)


def test_uneven_steps_of_a_circle_weigh_by_their_cells_and_sum_to_a_turn(rng: np.random.Generator) -> None:
    np.testing.assert_allclose(circle_weights([0, 2, 1, 3.5, 5]), [1.1415926536, 1.25, 1.0, 1.5, 1.3915926536])
    np.testing.assert_allclose(circle_weights(rng.uniform(0, 50, 300)).sum(), 2 * np.pi)
    closed = np.linspace(0, 2 * np.pi, 121)  # first and last view are the same
    np.testing.assert_allclose(circle_weights(closed)[[0, -1]], np.pi / 120, rtol=1e-9)


@pytest.mark.parametrize(("span", "n"), [(180, 90), (200, 25), (270, 100), (300, 40)])
def test_weights_of_the_circle_are_not_those_of_a_short_scan(span: float, n: int) -> None:
    with refused(ValueError):
        circle_weights(np.deg2rad(np.linspace(0, span, n)))


@pytest.mark.parametrize("arc", [200, 214, 260, 330])
@pytest.mark.parametrize("sense", [1, -1])
def test_both_measurements_of_a_ray_of_a_short_scan_weigh_one_together(arc: float, sense: int) -> None:
    """The ray at γ in the view β is the ray at -γ in the view β + π - 2γ, if the scan goes that far."""
    n, cols, start = round(4 * arc), 41, 2.0
    angles = sense * (start + np.deg2rad(arc) * (np.arange(n) + 0.5) / n)
    geometry = Geometry.fan(np.random.default_rng(0).permutation(angles), cols, 1.0, 150.0, 300.0)
    weights, zeros = cone_weights(geometry)
    assert zeros == (0, 0) and missing_arc(geometry) == 0 and weights.min() >= 0
    share = weights[:, 1:-1] / (np.deg2rad(arc) / n)
    order = np.argsort(geometry.angles)
    at, gamma = geometry.angles[order], np.arctan((np.arange(cols) - 20) / 300.0)
    sums = np.zeros((n, cols))
    for col in range(cols):
        for turn in (-np.pi, np.pi):
            again = at + turn - 2 * gamma[col]
            there = np.interp(again, at, share[order, cols - 1 - col], left=0, right=0)
            sums[:, col] += there
        sums[:, col] += share[order, col]
    np.testing.assert_allclose(sums, 1, atol=0.02)


@pytest.mark.parametrize(("arc", "lacking"), [(180, 7.6), (100, 87.6), (187, 0.6), (188.5, 0)])
def test_what_a_short_scan_lacks_is_said_in_degrees(arc: float, lacking: float) -> None:
    # 41 columns of 1 mm, 300 mm from the source: the fan is 7.63 degrees wide.
    geometry = Geometry.fan(np.deg2rad(np.linspace(0, arc, 400, endpoint=False)), 41, 1.0, 150.0, 300.0)
    assert np.rad2deg(missing_arc(geometry)) == pytest.approx(lacking, abs=0.05)
    if lacking:
        with refused(ValueError):
            cone_weights(geometry)
    gaps = Geometry.fan([0, 0.1, 0.2, 0.3, 0.4, 2.0, 2.1, 2.2, 2.3, 4.0], 41, 1.0, 150.0, 300.0)
    assert missing_arc(gaps) == np.inf
    with refused(ValueError):
        cone_weights(gaps)


def test_the_wedge_is_what_no_view_sees() -> None:
    """Of a parallel beam between views; of a fan what a short scan lacks, in the middle of the rays of the axis."""
    (wedge,) = unseen_wedges(Geometry.parallel(np.radians(np.arange(10, 130, 1.5)), (4, 64)))
    assert np.degrees([wedge.first, wedge.size]) == pytest.approx([129.25, 60.0])
    assert wedge.rays == pytest.approx((39.25, 99.25))
    fan = Geometry.fan(np.radians(np.arange(20, 170, 1.5)), 64, 1.0, 100, 150)
    (wedge,) = unseen_wedges(fan)
    assert wedge.size == pytest.approx(missing_arc(fan))
    assert np.degrees(wedge.first + wedge.size / 2) == pytest.approx((19.25 + 169.25 + 180) / 2)
    two = np.concatenate((np.arange(0, 60, 1.5), np.arange(90, 150, 1.5)))
    assert np.degrees([each.size for each in unseen_wedges(Geometry.parallel(np.radians(two), (4, 64)))]) == (
        pytest.approx([30, 30])
    )


@pytest.mark.parametrize("turn", [np.pi, 2 * np.pi])
def test_views_all_around_leave_no_wedge(turn: float) -> None:
    even, golden = np.linspace(0, turn, 60, endpoint=False), np.arange(60) * np.pi * 0.618034
    for angles in (even, golden, np.random.default_rng(0).uniform(0, turn, 60)):
        assert unseen_wedges(Geometry.parallel(angles, (4, 64))) == []
    assert unseen_wedges(Geometry.fan(np.linspace(0, 2 * np.pi, 60, endpoint=False), 64, 1.0, 100, 150)) == []


def test_edges_along_the_wedge_are_blurred() -> None:
    """The rim of a disc by FBP, where it runs along rays that no view shows, and where it runs across them."""
    views = Geometry.parallel(np.radians(np.arange(10, 130, 1.0)), (1, 96))
    u = np.arange(96) - 47.5
    disc = np.tile(2 * np.sqrt(np.clip(30**2 - u**2, 0, None)), (views.n_views, 1, 1)).astype(np.float32)
    with pytest.warns(UserWarning, match="because 60 of 180 degrees have no projection"):
        image = reconstruct(disc, views, "fbp").volume.data[0]
    (wedge,) = unseen_wedges(views)

    def step(angle: float) -> float:
        """From outside to inside of the rim at this angle, whose normal points there."""
        at = [47.5 + np.sin(angle) * np.array([26, 34]), 47.5 + np.cos(angle) * np.array([26, 34])]
        inside, outside = map_coordinates(image, at, order=1)
        return float(inside - outside)

    middle = wedge.first + wedge.size / 2  # the direction of columns of the missing views: across their rays
    assert step(middle) < 0.5 * step(middle + np.pi / 2)


@given(st.integers(6, 60), st.floats(1, 4), st.floats(0, np.pi))
def test_the_density_of_an_ellipse_is_within_the_stated_errors(lost: int, aspect: float, turned: float) -> None:
    """By the value that each projection adds inside an ellipse; a wedge across its thin and long direction reaches
    both ends."""
    degrees = np.arange(0, 180 - lost, 0.25)
    geometry = Geometry.parallel(np.radians(degrees), (1, 8))
    weights = ray_weights(geometry)[0][:, 4] * density_gain(geometry)

    def density(turned: float) -> float:
        theta = np.radians(degrees) - turned
        return float((weights / (aspect * np.cos(theta) ** 2 + np.sin(theta) ** 2 / aspect)).sum() / np.pi)

    low, high = density_errors(np.radians(lost), aspect)
    assert low - 1e-3 <= density(turned) - 1 <= high + 1e-3
    middle = np.radians(180 - lost / 2 - 0.125)
    ends = density(middle - np.pi / 2), density(middle)
    assert ends == pytest.approx((1 + low, 1 + high), abs=2e-3)


@pytest.mark.parametrize("lost", [(0, 0), (72, 90), (120, 180)])
def test_a_round_body_has_its_density_and_a_missing_wedge_is_told(lost: tuple[int, int]) -> None:
    degrees = np.array([each for each in np.arange(0, 180, 1.0) if not lost[0] <= each < lost[1]])
    geometry = Geometry.parallel(np.radians(degrees), (1, 64))
    views = disc_views(geometry, 12, (9.0, 5.0))
    told = pytest.warns(UserWarning, match="right only for round bodies") if lost[1] else nullcontext()
    with told:
        image = reconstruct(views, geometry, "fbp").volume
    _, y, x = image.grid.coordinates()
    inside = np.hypot(x - 9, y[:, None] - 5) < 9
    assert image.data[0][inside].mean() == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize(("turn", "radius"), [(300, 26.0), (360, 26.0), (300, 8.0)])
def test_an_incomplete_circle_of_half_acquisition_is_told(turn: int, radius: float) -> None:
    """If the sample reaches beyond the edge near the axis; what is within it has all rays in half a turn."""
    geometry = Geometry.parallel(np.radians(np.arange(0, turn, 3.0)), (1, 48), axis_col=11.5)
    views = disc_views(geometry, radius, (0.0, 0.0))
    lacking = turn < 360 and radius > 12
    told = pytest.warns(UserWarning, match="12 columns from the rotation axis") if lacking else nullcontext()
    with told:
        image = reconstruct(views, geometry, "fbp").volume
    _, y, x = image.grid.coordinates()
    mean = image.data[0][np.hypot(x, y[:, None]) < radius - 3].mean()
    assert mean < 0.8 if lacking else mean == pytest.approx(1, abs=0.01)
