"""Masked pixels: the values that replace them, and their weights."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.base.masks import areas, masked, usual_weight
from tests.refused_calls import refused_calls

RNG = np.random.default_rng(0)
DATA = np.maximum(RNG.normal(0.2, 0.5, (4, 12, 30)), 0).astype(np.float32)
WEIGHTS = RNG.uniform(0.1, 2, DATA.shape).astype(np.float32)


def test_rays_past_the_sample_do_not_set_the_scale_of_weights() -> None:
    assert usual_weight(np.where(DATA > 0, WEIGHTS, 100), DATA) == pytest.approx(usual_weight(WEIGHTS, DATA), rel=1e-6)


def test_the_scale_of_weights_follows_their_unit() -> None:
    assert usual_weight(8 * WEIGHTS, DATA) == pytest.approx(8 * usual_weight(WEIGHTS, DATA), rel=1e-6)


def test_masks_have_the_scale_one() -> None:
    mask = (WEIGHTS > 1).astype(np.float32)
    assert usual_weight(mask, DATA) == 1 and usual_weight(mask, np.zeros_like(DATA)) == 1


def test_one_wild_ray_does_not_set_the_scale_of_weights() -> None:
    wild = DATA.copy()
    wild[0, 0, 0] = 1e9
    assert usual_weight(WEIGHTS, wild) == pytest.approx(usual_weight(WEIGHTS, DATA), rel=0.02)


def test_whole_data_pass_as_they_are(rng: np.random.Generator) -> None:
    data, weight = rng.random((2, 3, 4), np.float32), rng.random((2, 3, 4), np.float32) + 0.1
    assert masked(data)[0] is data and masked(data)[1] is None
    assert masked(data, weight)[0] is data and masked(data, weight)[1] is weight


def test_what_is_not_finite_weighs_nothing_and_takes_its_neighbours_mean() -> None:
    data = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    data[1, 1, 1], data[1, 1, 2], data[0, 0, 0] = np.nan, np.inf, -np.inf
    before = data.copy()
    filled, weight = masked(data)
    assert weight is not None
    np.testing.assert_array_equal(data, before)
    np.testing.assert_array_equal(weight == 0, ~np.isfinite(data))
    assert set(np.unique(weight)) == {0, 1}
    assert filled[0, 0, 0] == pytest.approx((1 + 4 + 5) / 3)
    assert filled[1, 1, 1] == pytest.approx((12 + 13 + 14 + 16 + 20 + 21 + 22) / 7)
    np.testing.assert_array_equal(filled[np.isfinite(data)], data[np.isfinite(data)])


def test_rays_of_no_weight_are_filled_too_and_others_keep_theirs() -> None:
    data, weight = np.ones((1, 4, 4), np.float32), np.full((1, 4, 4), 0.25, np.float32)
    data[0, 2, 2], weight[0, 2, 2] = 1e9, 0  # a saturated pixel, say
    data[0, 0, 3] = np.nan
    filled, given_back = masked(data, weight)
    assert given_back is not None
    np.testing.assert_array_equal(filled, np.ones((1, 4, 4)))
    assert given_back[0, 2, 2] == 0 == given_back[0, 0, 3] and given_back[0, 0, 0] == 0.25


def test_values_beyond_the_largest_count_as_not_finite() -> None:
    data = np.ones((1, 4, 4), np.float32)
    data[0, 0, 0], data[0, 2, 2], data[0, 3, 0] = 1e30, -1e7, 99.0
    filled, weight = masked(data, largest=100.0)
    assert weight is not None
    np.testing.assert_array_equal(np.argwhere(weight[0] == 0), [[0, 0], [2, 2]])
    np.testing.assert_array_equal(filled[0, 0, 0], 1.0)
    assert masked(data)[1] is None and masked(data, largest=1e300)[1] is None
    with pytest.raises(ValueError, match=r"1 of 1"):
        masked(data, largest=0.5)


@given(st.integers(1, 12), st.integers(1, 12), st.floats(0, 0.99), st.integers(0, 1000))
def test_filled_values_lie_between_known_ones(rows: int, cols: int, share: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    data = rng.normal(size=(1, rows, cols)).astype(np.float32)
    data[0][rng.random((rows, cols)) < share] = np.nan
    data[0, 0, 0] = 1
    filled, _ = masked(data)
    low, high = np.nanmin(data), np.nanmax(data)
    assert (filled >= low - 1e-6).all() and (filled <= high + 1e-6).all()


def test_areas_are_what_three_by_three_pixels_fit_into() -> None:
    mask = np.zeros((8, 20), np.bool_)
    mask[:, :3] = mask[:, 18] = mask[4, 8] = mask[2:5, 12:15] = True
    expected = np.zeros_like(mask)
    expected[:, :3] = expected[2:5, 12:15] = True
    np.testing.assert_array_equal(areas(mask), expected)
    one_row = np.zeros((1, 9), np.bool_)
    one_row[0, :4] = True
    assert areas(one_row).sum() == 4 and not areas(np.eye(5, dtype=np.bool_)).any()


test_calls_that_are_refused = refused_calls(__file__, globals())
