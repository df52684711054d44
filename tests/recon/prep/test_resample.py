"""Resampling: a distorted grid becomes regular, a rotated detector straight, a slab equals part of the whole."""

from __future__ import annotations

import math

import numpy as np
import pytest

from recon.prep.resample import Distortion, Resampling

LENS = Distortion(101.3, 72.8, (1.003, -2.2e-4, 9e-7, -6e-9, 2e-11))
SHAPE = (150, 200)


def _spots(col: np.ndarray, row: np.ndarray) -> np.ndarray:
    """An image of Gaussians of 2 px at these places."""
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return sum(np.exp(-((rows - r) ** 2 + (cols - c) ** 2) / 8) for c, r in zip(col, row, strict=True)).astype(
        np.float32
    )


def test_a_grid_seen_through_a_lens_lies_where_it_is() -> None:
    """Spots at positions displaced by hand with Vo's formula come back, to a thirtieth of a pixel."""
    col, row = (part.ravel().astype(float) for part in np.meshgrid(np.arange(20, 190, 20), np.arange(20, 140, 20)))
    r = np.sqrt((col - LENS.col) ** 2 + (row - LENS.row) ** 2)
    scale = sum(a * r**i for i, a in enumerate(LENS.factors))
    seen = LENS.col + (col - LENS.col) * scale, LENS.row + (row - LENS.row) * scale
    assert np.hypot(seen[0] - col, seen[1] - row).max() > 1
    views = _spots(*seen)[None]
    Resampling(SHAPE, distortion=LENS).apply(views, 0)
    for c, r in zip(col.astype(int), row.astype(int), strict=True):
        box = views[0, r - 7 : r + 8, c - 7 : c + 8]
        down, along = np.mgrid[-7:8, -7:8]
        off = (box * down).sum() / box.sum(), (box * along).sum() / box.sum()
        assert math.hypot(*off) < 0.033, (c, r, off)


def test_views_of_a_turned_detector_are_those_of_a_straight_one() -> None:
    """Where the axis leans by the angle, its column grows with the rows; smooth spots come back to a thousandth."""
    turn, rng = math.radians(2.5), np.random.default_rng(5)
    u, v = rng.uniform(-80, 80, 20), rng.uniform(-60, 60, 20)
    c, s = math.cos(turn), math.sin(turn)
    views = _spots(99.5 + c * u + s * v, 74.5 + c * v - s * u)[None]
    there = _spots(99.5 + u, 74.5 + v)
    Resampling(SHAPE, turn).apply(views, 0)
    seen = ~Resampling(SHAPE, turn).outside_detector(SHAPE, 0)
    np.testing.assert_allclose(views[0][seen], there[seen], atol=0.003 * there.max())


@pytest.mark.parametrize("binning", [1, 2])
def test_rows_of_a_slab_are_those_of_the_whole(binning: int) -> None:
    resampling = Resampling(SHAPE, 0.02, LENS, binning)
    rows, cols = (n // binning for n in SHAPE)
    whole = np.random.default_rng(2).random((2, rows, cols)).astype(np.float32)
    first, last, reach = 30, 45, resampling.reach
    slab = whole[:, first - reach : last + reach].copy()
    start = (first - reach) * binning
    where = np.s_[reach : reach + last - first]
    np.testing.assert_array_equal(
        resampling.outside_detector(slab.shape[1:], start),
        resampling.outside_detector((rows, cols), 0)[first - reach : last + reach],
    )
    mask = whole[0] > 0.9
    near = resampling.nearest(mask[first - reach : last + reach], start)[where]
    np.testing.assert_array_equal(near, resampling.nearest(mask, 0)[first:last])
    resampling.apply(slab, start)
    resampling.apply(whole, 0)
    np.testing.assert_array_equal(slab[:, where], whole[:, first:last])


def test_bins_are_taken_from_where_their_pixels_are() -> None:
    """A ramp is the same ramp in bins: what is seen at a place depends on no binning."""
    lens = Distortion(90.0, 60.0, (1.02, 1e-5))
    ramp = np.tile(np.arange(SHAPE[1], dtype=np.float32), (SHAPE[0], 1))
    binned = ramp.reshape(75, 2, 100, 2).mean(axis=(1, 3))
    views = [ramp[None].copy(), binned[None].copy()]
    for view, n in zip(views, (1, 2), strict=True):
        Resampling(SHAPE, 0.01, lens, n).apply(view, 0)
    inside = np.s_[10:-10, 10:-10]
    means = views[0][0].reshape(75, 2, 100, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(views[1][0][inside], means[inside], atol=0.02)


@pytest.mark.parametrize("sign", [" = ", " : "])
def test_a_distortion_is_read_as_discorpy_writes_it(sign: str) -> None:
    values = {"xcenter": 588.69, "ycenter": 462.09, "factor0": 1.00227, "factor1": -2.9952e-05}
    text = "".join(f"{name}{sign}{value}\n" for name, value in values.items())
    assert Distortion.parse(text) == Distortion(588.69, 462.09, (1.00227, -2.9952e-05))


@pytest.mark.parametrize(
    "text", ["", "xcenter = 1\nycenter = 2\n", "xcenter = 1\nfactor0 = 1\nycenter = 2\n", "a b c\n1 2\n3 4\n"]
)
def test_another_text_is_no_distortion(text: str) -> None:
    with pytest.raises(ValueError, match="expected the lines"):
        Distortion.parse(text)
    with pytest.raises(ValueError, match="the first above 0"):
        Distortion.parse("xcenter = 1\nycenter = nan\nfactor0 = 1\n")
