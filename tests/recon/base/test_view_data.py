"""Views: which projections are held out, and the weights of rays."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.base.view_data import Views, split_views

TURN = Geometry.parallel(np.arange(24) * np.pi / 12, (2, 5))


@pytest.mark.parametrize("one_in", [3, 4, 8])
def test_views_held_out_are_spread_over_the_angle_and_the_others_are_the_rest(one_in: int) -> None:
    order = np.random.default_rng(one_in).permutation(24)  # in which views were taken
    seen, unseen = split_views(TURN.select(order), one_in, 2 * np.pi)
    assert np.union1d(seen, unseen).tolist() == list(range(24)) and not np.intersect1d(seen, unseen).size
    assert sorted(order[unseen]) == [*range(one_in // 2, 24, one_in)]


def test_views_half_a_turn_apart_are_neighbours_where_they_see_the_same_rays() -> None:
    _, unseen = split_views(TURN, 2)  # view 0 or 12, 1 or 13 ...
    assert sorted(unseen % 12) == [*range(12)]
    assert split_views(TURN, 2, 2 * np.pi)[1].tolist() == [*range(1, 24, 2)]


def test_weights_are_multiplied_and_begin_at_one() -> None:
    views, lit = Views(np.ones((24, 2, 5), np.float32), TURN), np.arange(24)[:, None, None] % 2 > 0
    halves = np.full((24, 1, 1), 0.5, np.float32)
    once = views.weighed(lit)
    assert once.weights is not None and once.weights.dtype == np.float32 and views.weights is None
    np.testing.assert_array_equal(once.weights, np.broadcast_to(lit, views.data.shape))
    np.testing.assert_array_equal(once.weighed(halves).weights, 0.5 * once.weights)
