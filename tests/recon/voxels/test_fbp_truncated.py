"""Truncated projections: they are extrapolated if they end in the sample, and not if they end in air."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.direct import direct
from recon.voxels.fbp import continuation, continued, fbp, filter_projections
from recon.voxels.field_edges import ends_in_matter, sample_reach

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
    assert not ends_in_matter((lines + noise).mean(axis=0)).any()
    assert not ends_in_matter((lines + np.float32(0.001)).mean(axis=0)).any()


@pytest.mark.parametrize("radius", [33.0, 48.0, 64.0, 96.0])
@pytest.mark.parametrize("core", [0.0, 15.0])
def test_the_end_of_a_sample_shows_in_the_fall_of_its_rows(radius: float, core: float) -> None:
    """A dense core makes the whole row fall steeply; noise then has the outer columns alone."""
    u = np.arange(COLS) - 30.0
    mean = 0.02 * np.sqrt(radius**2 - u**2) + 0.06 * np.sqrt(np.clip(core**2 - u**2, 0, None))
    assert sample_reach(mean[None].astype(np.float32), 30.0) == pytest.approx(radius, rel=0.01)
    assert sample_reach(np.ones((1, COLS), np.float32), 30.0) > 1e3  # nothing falls


@pytest.mark.parametrize("cols", range(1, 8))
def test_rows_too_short_to_tell_how_they_go_on_are_filtered_as_they_are(cols: int) -> None:
    assert np.isfinite(fbp(disc(cols, 90, 0.004), Geometry.parallel(ANGLES, (3, cols)))).all()


def test_rows_are_cut_each_by_itself() -> None:
    """Rows are independent: what a block of slices has beside it changes no bit."""
    lines = disc(COLS, 24, 0.01)
    lines[:, 1] = disc(COLS, 90, 0.01)[:, 1]
    geometry = Geometry.parallel(ANGLES, (3, COLS))
    np.testing.assert_array_equal(ends_in_matter(lines.mean(axis=0)), [[False] * 2, [True] * 2, [False] * 2])
    inside = disc(COLS, 24, 0.01)
    np.testing.assert_array_equal(fbp(lines, geometry)[[0, 2]], fbp(inside, geometry)[[0, 2]])


@pytest.mark.parametrize("zeros", [(0, 0), (10, 0), (3, 10)])
def test_what_is_beyond_an_edge_is_filtered_with_what_is_inside(zeros: tuple[int, int]) -> None:
    """By the whole ellipse, of which the row sees the middle, and so into the columns beside it."""
    u = np.arange(4 * COLS) + 0.5 - 2 * COLS
    ellipse = np.sqrt(np.clip(48.0**2 - u**2, 0, None))[None].astype(np.float32)
    row = ellipse[:, np.abs(u) < COLS / 2]
    weights = np.ones((1, COLS + 2))
    beyond, _ = continuation(row, Geometry.parallel([0.0], (1, COLS)), weights, zeros, "ram-lak")
    assert beyond is not None
    found = filter_projections(np.pad(row, ((0, 0), zeros))) + continued(beyond, row[None], weights)[0]
    there = slice(3 * COLS // 2 - zeros[0], 5 * COLS // 2 + zeros[1])
    np.testing.assert_allclose(found, filter_projections(ellipse)[:, there], atol=2e-3 * float(row.max()))


BEAMS = {
    "parallel": partial(Geometry.parallel, detector_shape=(3, COLS)),
    "tilted": partial(Geometry.parallel, detector_shape=(3, COLS), tilt=1e-4),
    "cone": partial(Geometry.cone, detector_shape=(3, COLS), pixel_pitch=2.0, sod=1e4, sdd=2e4),
    "rolled cone": partial(Geometry.cone, detector_shape=(3, COLS), pixel_pitch=2.0, sod=1e4, sdd=2e4, roll=1e-4),
}


@pytest.mark.parametrize("beam", BEAMS)
@pytest.mark.parametrize("off", [0.0, 0.01, 0.3, 0.5, 2.0, 3.0, 8.0])
def test_a_full_turn_is_continued_wherever_its_axis_is(beam: str, off: float) -> None:
    """Beside the middle one edge lies farther out than the other; neither may lose what is beyond."""
    axis = (COLS - 1) / 2 + off
    u = np.arange(COLS) - axis
    lines = 2 * 0.01 * np.sqrt(64.0**2 - u**2)
    views = np.broadcast_to(lines, (120, 3, COLS)).astype(np.float32)
    geometry = BEAMS[beam](np.linspace(0, 2 * np.pi, 120, endpoint=False), axis_col=axis)
    field = Grid((1, COLS, COLS))
    volume = direct(views, geometry, field, "hann")[0]
    away = np.hypot(*np.meshgrid(*field.coordinates()[1:]))
    seen = 30.5 - ("cone" in beam) * off % 8  # out to the nearer edge, where no shares of a circle are taken
    np.testing.assert_allclose(volume[away < seen], 0.01, rtol=0.06)


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
