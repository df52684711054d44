"""A sample wider than the field: views that end in matter go on beyond it; those that end in air do not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.fbp import beyond_edges, edge_levels, fbp, filter_projections

COLS, VIEWS = 64, 120
ANGLES = np.linspace(0, np.pi, VIEWS, endpoint=False)


def disc(cols: int, radius: float, mu: float, axis: float | None = None) -> NDArray[np.float32]:
    """[view, row, col] of a disc about the axis, with a small denser one in it."""
    u = np.arange(cols) - ((cols - 1) / 2 if axis is None else axis)
    at = (6 * np.cos(ANGLES) + 9 * np.sin(ANGLES))[:, None]
    lines = 2 * mu * np.sqrt(np.clip(radius**2 - u**2, 0, None)) + 0 * at
    lines = lines + 2 * 0.02 * np.sqrt(np.clip(16 - (u - at) ** 2, 0, None))
    return np.repeat(lines[:, None], 3, axis=1).astype(np.float32)


@given(radius=st.floats(40, 120), mu=st.floats(0.002, 0.05), filter=st.sampled_from(("ram-lak", "hann")))
@settings(deadline=None, max_examples=15)
def test_the_middle_and_the_rim_of_a_wide_disc_have_its_density(radius: float, mu: float, filter: str) -> None:
    """Without an extension the rim has twice the density of the middle and more."""
    volume = fbp(disc(COLS, radius, mu), Geometry.parallel(ANGLES, (3, COLS)), filter=filter)[1]  # type: ignore[arg-type]
    c = (np.arange(COLS) - 31.5)[None]
    away = np.hypot(c, c.T)
    small = np.hypot(c - 6, c.T - 9)
    inside, outside = volume[small < 3].mean(), volume[(away < 29) & (small > 6)]
    assert np.abs(outside - mu).max() < 0.3 * mu + 0.001  # interior tomography is not unique: a bend remains
    assert np.ptp(outside) < 0.3 * mu + 0.003
    assert inside - outside.mean() == pytest.approx(0.02, rel=0.1)


def test_the_part_in_the_field_is_that_of_a_wide_detector() -> None:
    wide = fbp(
        disc(256, 90, 0.004), Geometry.parallel(ANGLES, (3, 256)), Grid.matching(Geometry.parallel(ANGLES, (3, 64)))
    )
    cut = fbp(disc(COLS, 90, 0.004), Geometry.parallel(ANGLES, (3, COLS)))
    c = (np.arange(COLS) - 31.5)[None]
    np.testing.assert_allclose(cut[1][np.hypot(c, c.T) < 28], wide[1][np.hypot(c, c.T) < 28], atol=0.0015)


def test_views_that_end_in_air_are_filtered_as_ever() -> None:
    lines = disc(COLS, 24, 0.01)
    noise = np.random.default_rng(0).normal(0, 0.005, lines.shape).astype(np.float32)
    assert edge_levels(lines + noise) == {}
    assert edge_levels(lines + np.float32(0.001)) == {}


@pytest.mark.parametrize("cols", range(1, 8))
def test_rows_too_short_to_tell_how_they_go_on_are_filtered_as_they_are(cols: int) -> None:
    assert np.isfinite(fbp(disc(cols, 90, 0.004), Geometry.parallel(ANGLES, (3, cols)))).all()


def test_rows_are_cut_each_by_itself() -> None:
    """Rows are independent: what a block of slices has beside it changes no bit."""
    lines = disc(COLS, 24, 0.01)
    lines[:, 1] = disc(COLS, 90, 0.01)[:, 1]
    geometry = Geometry.parallel(ANGLES, (3, COLS))
    (levels,) = edge_levels(lines).values()
    assert not levels[:, [0, 2]].any() and levels[:, 1].all()
    inside = disc(COLS, 24, 0.01)
    np.testing.assert_array_equal(fbp(lines, geometry)[[0, 2]], fbp(inside, geometry)[[0, 2]])


@pytest.mark.parametrize("zeros", [(0, 0), (10, 0), (0, 10)])
def test_what_is_beyond_an_edge_is_filtered_with_what_is_inside(zeros: tuple[int, int]) -> None:
    """By the whole ellipse, of which the row sees the middle."""
    u = (np.arange(4 * COLS) + 0.5 - 2 * COLS) / (COLS / 2)
    ellipse = np.sqrt(np.clip(1.5**2 - u**2, 0, None) / (1.5**2 - 1))
    inside = np.abs(u) < 1
    whole = filter_projections(ellipse[None].astype(np.float32))[0][inside]
    row = np.pad(ellipse[inside], zeros)[None].astype(np.float32)
    sides = beyond_edges(COLS + sum(zeros), zeros, 1.0, "ram-lak", 1.5)
    found = (filter_projections(row)[0] + np.ones(2, np.float32) @ sides)[zeros[0] : zeros[0] + COLS]
    np.testing.assert_allclose(found, whole, atol=2e-5)


def test_a_full_turn_about_an_axis_off_the_middle_is_not_extended_at_the_side_near_it() -> None:
    """There the other half turn sees what is beyond; a disc that it sees whole keeps its density."""
    angles = np.linspace(0, 2 * np.pi, 240, endpoint=False)
    u = np.arange(COLS) - 12.0
    lines = np.broadcast_to(2 * 0.01 * np.sqrt(np.clip(45.0**2 - u**2, 0, None)), (240, 1, COLS)).astype(np.float32)
    geometry = Geometry.parallel(angles, (1, COLS), axis_col=12.0)
    volume = fbp(lines, geometry)[0]
    c = Grid.matching(geometry).coordinates()[2]
    away = np.hypot(c[None], c[:, None])
    assert np.abs(volume[away < 40] / 0.01 - 1).mean() < 0.02
