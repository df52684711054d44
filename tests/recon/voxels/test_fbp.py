"""FBP compared with closed forms, an independent implementation and the project's convention."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.direct import direct, has_direct_method
from recon.voxels.fbp import fbp, filter_projections
from recon.voxels.view_weights import partly_seen
from tests.messages import refused


def disc_views(
    geometry: Geometry, radius: float, centre: tuple[float, float], rows: slice = slice(None), density: float = 1.0
) -> NDArray[np.float32]:
    """Line integrals of a disc (mm, [x, y]) that fills `rows`: chords 2 √(r² - s²), averaged over each pixel."""
    fine = 8
    cols = geometry.detector_shape[1]
    edges = (np.arange(cols * fine) + 0.5) / fine - 0.5
    u = (edges - geometry.axis_col) * geometry.pixel_pitch
    x, y = centre
    s = u - (x * np.cos(geometry.angles) + y * np.sin(geometry.angles))[:, None]
    chord = 2 * density * np.sqrt(np.maximum(radius**2 - s**2, 0))
    data = np.zeros((geometry.n_views, *geometry.detector_shape), np.float32)
    data[:, rows] = chord.reshape(geometry.n_views, cols, fine).mean(2)[:, None]
    return data


def half_turn(n: int) -> NDArray[np.float64]:
    return np.arange(n) * np.pi / n


def test_impulse_gives_the_band_limited_kernel() -> None:
    """Kak & Slaney 1988, eq. 3.61: h(0) = 1/(4τ²), h(odd n) = -1/(nπτ)², 0 at even n; a convolution carries one τ."""
    tau = 0.5
    impulse = np.zeros((1, 1, 65), np.float32)
    impulse[..., 32] = 1
    n = np.arange(-32, 33)
    expected = np.where(n % 2 == 1, -1 / (np.pi * np.where(n == 0, 1, n) * tau) ** 2, 0)
    expected[32] = 1 / (4 * tau**2)
    np.testing.assert_allclose(filter_projections(impulse, tau)[0, 0], expected * tau, atol=2e-6)


def test_filter_is_the_plain_convolution_without_wrap_around(rng: np.random.Generator) -> None:
    row = rng.normal(size=37)
    n = np.arange(-36, 37)
    kernel = np.where(n % 2 == 1, -1 / (np.pi * np.where(n == 0, 1, n)) ** 2, 0)
    kernel[36] = 0.25
    expected = np.convolve(row, kernel)[36 : 36 + 37]
    np.testing.assert_allclose(filter_projections(row.astype(np.float32)), expected, atol=2e-6)


@pytest.mark.parametrize("window", ["ram-lak", "shepp-logan", "hann"])
@pytest.mark.parametrize(("density", "pitch"), [(1.0, 1.0), (0.4, 0.05)])
def test_uniform_disc_has_its_density(window: str, density: float, pitch: float) -> None:
    geometry = Geometry.parallel(half_turn(180), (3, 101), pixel_pitch=pitch)
    volume = fbp(disc_views(geometry, 30 * pitch, (0, 0), density=density), geometry, filter=window)  # type: ignore[arg-type]
    middle = volume[:, 40:61, 40:61]
    assert np.abs(middle / density - 1).max() < 0.01
    assert abs(middle.mean() / density - 1) < 0.002
    assert abs(volume[:, 50, :8].mean()) < 0.01 * density


def test_disc_away_from_the_axis_with_a_shifted_axis_and_random_angles(rng: np.random.Generator) -> None:
    angles = rng.uniform(-np.pi, 3 * np.pi, 400)
    geometry = Geometry.parallel(angles, (1, 120), pixel_pitch=0.1, axis_col=63.3)
    volume = fbp(disc_views(geometry, 1.5, (1.7, -0.8)), geometry)
    _, y, x = Grid.matching(geometry).coordinates()
    inside = np.hypot(x[None] - 1.7, y[:, None] + 0.8) < 1.0
    assert abs(volume[0][inside].mean() - 1) < 0.01


def test_blob_lands_on_its_voxel() -> None:
    """u = x cos θ + y sin θ, columns grow with u, rows and volume indices grow with z, y, x."""
    angles = np.deg2rad(np.arange(0, 180, 2.0))
    geometry = Geometry.parallel(angles, (21, 64), pixel_pitch=0.2, axis_col=30.0)
    x, y, z, sigma = 2.5, -1.1, 0.8, 0.6
    u = (np.arange(64) - 30.0) * 0.2
    v = (np.arange(21) - 10) * 0.2
    s = u - (x * np.cos(angles) + y * np.sin(angles))[:, None]
    gauss = np.exp(-(s**2) / (2 * sigma**2)) * np.sqrt(2 * np.pi) * sigma  # line integral of a peak of 1
    views = gauss[:, None, :] * np.exp(-((v - z) ** 2) / (2 * sigma**2))[None, :, None]
    volume = fbp(views.astype(np.float32), geometry)
    zs, ys, xs = Grid.matching(geometry).coordinates()
    truth = np.exp(-((zs[:, None, None] - z) ** 2 + (ys[:, None] - y) ** 2 + (xs - x) ** 2) / (2 * sigma**2))
    assert np.unravel_index(volume.argmax(), volume.shape) == np.unravel_index(truth.argmax(), truth.shape)
    np.testing.assert_allclose(volume, truth, atol=0.025)


@pytest.mark.parametrize("window", ["ram-lak", "shepp-logan", "hann"])
def test_agrees_with_skimage(window: str) -> None:
    """skimage.transform.iradon has its rotation axis at column cols // 2 and y downwards."""
    transform = pytest.importorskip("skimage.transform")
    angles = half_turn(90)
    geometry = Geometry.parallel(angles, (1, 81), axis_col=40)
    views = disc_views(geometry, 12, (9.0, -6.0)) + disc_views(geometry, 5, (-14.0, 10.0), density=2)
    ours = fbp(views, geometry, filter=window)[0]  # type: ignore[arg-type]
    name = {"ram-lak": "ramp"}.get(window, window)
    theirs = transform.iradon(views[:, 0].T.astype(np.float64), np.rad2deg(angles), filter_name=name, circle=True)
    x = np.arange(81) - 40
    inside = np.hypot(x[None], x[:, None]) < 38
    difference = (ours[::-1] - theirs)[inside]
    assert np.sqrt(np.mean(difference**2)) < 2e-3
    assert np.abs(difference).max() < 0.05


def test_any_grid_samples_the_same_volume() -> None:
    """A box off the axis holds what the full grid holds at the same places."""
    geometry = Geometry.parallel(half_turn(60), (7, 50), pixel_pitch=0.2, axis_col=23.4)
    views = disc_views(geometry, 2.5, (0.4, 0.2), rows=slice(2, 6))
    whole = Grid.matching(geometry)
    box = Grid((3, 5, 10), 0.2, centre=(0.2, 0.5, -0.4))
    places = [
        [int(np.abs(full - value).argmin()) for value in part]
        for full, part in zip(whole.coordinates(), box.coordinates(), strict=True)
    ]
    for full, part, index in zip(whole.coordinates(), box.coordinates(), places, strict=True):
        np.testing.assert_allclose(full[index], part, atol=1e-12)
    np.testing.assert_allclose(fbp(views, geometry, box), fbp(views, geometry)[np.ix_(*places)], atol=1e-5)


def test_rows_between_the_slices_are_interpolated_and_beyond_the_detector_zero() -> None:
    geometry = Geometry.parallel(half_turn(30), (2, 20))
    views = disc_views(geometry, 6, (0, 0))
    views[:, 1] *= 3
    rows = fbp(views, geometry)[:, 10, 10]
    volume = fbp(views, geometry, Grid((7, 20, 20), 0.5))  # z = -1.5, -1, -0.5, 0, 0.5, 1, 1.5 in pixels
    first, second = rows
    # The detector ends at ±1; its outermost half pixel belongs to the nearest row.
    expected = [0, first, first, (first + second) / 2, second, second, 0]
    np.testing.assert_allclose(volume[:, 9:11, 9:11].mean((1, 2)), expected, rtol=0.05, atol=1e-6)


def test_bad_input_is_refused() -> None:
    geometry = Geometry.parallel(half_turn(4), (2, 8))
    good = np.zeros((4, 2, 8), np.float32)
    with refused(ValueError):
        fbp(good[:3], geometry)
    with refused(ValueError):
        fbp(good, geometry, filter="cosine")  # type: ignore[arg-type]
    bad = good.copy()
    bad[1, 0, 3] = np.nan
    with refused(ValueError):
        fbp(bad, geometry)


@pytest.mark.parametrize("turns", [1.0, 3.0, 0.5])
@pytest.mark.parametrize("off", [0.0, 9.0], ids=["centred", "wide field"])
def test_a_helix_gives_the_density_in_every_slice_that_is_seen_over_half_a_turn(turns: float, off: float) -> None:
    """A tall cylinder: each slice is seen by views of its own; ends that few see are marked."""
    n, rows, cols = round(180 * turns), 24, 48
    heights = np.stack([np.zeros(n), np.linspace(-12, 12, n)], 1)
    geometry = Geometry.parallel(np.arange(n) * 2 * np.pi * turns / n, (rows, cols), shifts=heights)
    geometry = replace(geometry, axis_col=geometry.axis_col - off)
    views = disc_views(geometry, 12.0, (2.0, 1.0), density=0.1)
    grid = Grid.matching(geometry)
    assert grid.shape[0] == 48
    volume, z = fbp(views, geometry, grid), grid.coordinates()[0]
    marked = partly_seen(geometry, z + geometry.axis_row)
    half = 24 * min(1, 0.5 / turns)  # rows that pass a slice during half a turn
    gap = 1 + 8 * 24 / n  # eight steps that are missing are no wedge
    assert marked[np.abs(z) > 24 - half + gap].all() and not marked[np.abs(z) < 24 - half - 1].any()
    across = np.arange(grid.shape[1]) - (grid.shape[1] - 1) / 2
    inside = (across - 2) ** 2 + (across[:, None] - 1) ** 2 < 9**2
    means = volume[:, inside].mean(1)
    np.testing.assert_allclose(means[~marked], 0.1, rtol=0.03)
    assert (means[np.abs(z) > 24 - half + gap] < 0.1).all()


@pytest.mark.parametrize("cone", [False, True])
def test_direct_methods_refuse_a_climb_that_they_have_no_weights_for(cone: bool) -> None:
    angles = np.linspace(0, 6 * np.pi, 90)
    heights = np.stack([np.zeros(90), np.linspace(-5, 5, 90)], 1)
    geometry = (
        Geometry.cone(angles, (12, 16), 1.0, 100.0, 200.0, shifts=heights)
        if cone
        else Geometry.parallel(angles, (12, 16), shifts=heights, roll=0.05)
    )
    assert not has_direct_method(geometry)
    with refused(ValueError):
        direct(np.zeros((90, 12, 16), np.float32), geometry, Grid.matching(geometry))
    assert has_direct_method(replace(geometry, shifts=heights / 4))


def test_a_jitter_along_the_axis_changes_no_slice_that_all_views_see(rng: np.random.Generator) -> None:
    shifts = np.stack([np.zeros(60), rng.uniform(-1, 1, 60)], 1)
    geometry = Geometry.parallel(half_turn(60), (12, 32), shifts=shifts)
    views = disc_views(geometry, 9.0, (2.0, 1.0), density=0.1)
    volume = fbp(views, geometry)
    assert not geometry.climbs and volume.shape == (12, 32, 32)
    means = volume[:, 12:20, 12:20].mean((1, 2))
    np.testing.assert_allclose(means[2:-2], means[6], rtol=1e-5)
    np.testing.assert_allclose(means, 0.1, rtol=0.03)  # the first and the last, which half of the views miss
