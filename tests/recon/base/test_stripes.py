"""Stripes: constant offsets of pixels, and sample layers around the axis, which appear on both sides of it."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from recon.base.geometry import Geometry
from recon.base.stripes import ring_offsets, without_layers


def test_what_stays_in_a_pixel_over_all_views_is_a_ring_and_what_moves_is_not(rng: np.random.Generator) -> None:
    rings = np.zeros((6, 50), np.float32)
    rings[:, 12], rings[2, 30] = 0.5, -0.4
    noise = rng.normal(0, 0.2, (60, 6, 50)).astype(np.float32)
    crack = np.zeros((60, 6, 50), np.float32)
    crack[np.arange(60), :, (25 + 20 * np.cos(np.arange(60) / 10)).astype(int)] = 1.5
    views = Geometry.parallel(np.arange(60) * np.pi / 60, (6, 50), axis_col=24.5)
    found = ring_offsets(noise + rings + crack, views)
    np.testing.assert_allclose(found[rings != 0], rings[rings != 0], atol=0.12)
    assert np.count_nonzero(np.abs(found[rings == 0]) > 0.06) < 0.02 * rings.size
    assert not ring_offsets((noise + rings)[:10], views.select(range(10))).any()  # too few views to tell
    order = rng.permutation(60)  # in which views were taken
    again = ring_offsets((noise + rings + crack)[order], views.select(order))
    np.testing.assert_array_equal(again, found)


def test_a_wall_around_the_axis_is_no_ring_and_a_stripe_of_all_rows_is(rng: np.random.Generator) -> None:
    # What the fit leaves of a can's wall stays in all views, too, but on both sides of the axis.
    wall, rings = np.zeros((12, 50), np.float32), np.zeros((12, 50), np.float32)
    wall[:, 12:14], wall[:, 37:39] = 0.5, 0.5
    rings[5, 12], rings[:, 30] = 0.5, 0.3
    views = Geometry.parallel(np.arange(60) * np.pi / 60, (12, 50), axis_col=25.0)
    found = ring_offsets(rng.normal(0, 0.2, (60, 12, 50)).astype(np.float32) + wall + rings, views)
    np.testing.assert_allclose(found[rings != 0], rings[rings != 0], atol=0.15)
    assert np.abs(found[rings == 0]).max() < 0.2 and np.count_nonzero(np.abs(found[rings == 0]) > 0.1) <= 1


@given(
    st.integers(60, 200), st.floats(-3, 3), st.floats(0.001, 0.05), st.integers(0, 2**32 - 1)
)  # fmt: skip
def test_layers_around_the_axis_are_not_stripes(cols: int, off: float, gain: float, seed: int) -> None:
    """What both sides of the axis have in common stays out, what one side has stays in: within its own size."""
    rng, axis = np.random.default_rng(seed), (cols - 1) / 2 + round(off) / 2
    gains = rng.normal(0, gain, (1, cols)).astype(np.float32)
    radii = np.abs(np.arange(cols) - axis)
    layer = np.where((radii > cols / 5) & (radii < cols / 4), np.float32(1), np.float32(0))[None]
    kept = without_layers(gains + layer, axis)
    assert np.median(np.abs(kept - gains)) < 0.2 * gain and np.abs(kept - gains).max() < 5 * gain
