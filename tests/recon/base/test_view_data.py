"""Views: which projections are held out, and the weights of rays."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.base.view_data import RayWeights, Views, split_views

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


def _lit() -> Views:
    """24 projections whose pixels hold their number, with weights that are a product, numbered from 7."""
    data = np.broadcast_to(np.arange(24, dtype=np.float32)[:, None, None], (24, 2, 5)).copy()
    weights = RayWeights((1 + data, np.broadcast_to(np.float32(2), data.shape)))
    return Views(data, TURN, weights, np.arange(7, 31))


def test_views_held_out_are_a_mask_and_come_last_so_that_the_others_are_not_copied() -> None:
    views = _lit().holding_out(np.array([3, 9]))
    seen, unseen = views.seen, views.unseen
    assert unseen is not None and unseen.ids is not None and seen.ids is not None
    assert views.held_out.tolist() == [22, 23] and unseen.ids.tolist() == [10, 16]
    assert np.shares_memory(seen.data, views.data) and np.shares_memory(unseen.data, views.data)
    assert seen.used is None and seen.unseen is None and unseen.data[:, 0, 0].tolist() == [3, 9]
    np.testing.assert_array_equal(seen.geometry.angles, np.delete(TURN.angles, [3, 9]))
    np.testing.assert_array_equal(unseen.weights[:, 0, 0], [8, 20])


def test_some_of_the_views_used_are_chosen_by_their_number_and_those_held_out_stay() -> None:
    some = _lit().holding_out(np.array([0, 5])).using(np.array([4, 0]))  # of 1, 2, 3, 4, 6 ...
    assert some.ids is not None and some.ids.tolist() == [13, 8, 7, 12] and some.held_out.tolist() == [2, 3]
    np.testing.assert_array_equal(some.weights[:, 0, 0], 2 * (1 + some.data[:, 0, 0]))


@pytest.mark.parametrize("held_out", [[3, 9], [0, 23]])
def test_a_mask_anywhere_in_the_views_selects_the_same(held_out: list[int]) -> None:
    views = _lit()
    anywhere = Views(views.data, TURN, views.weights, views.ids, ~np.isin(np.arange(24), held_out))
    together = views.holding_out(np.array(held_out))
    for one, other in ((anywhere.seen, together.seen), (anywhere.unseen, together.unseen)):
        assert one is not None and other is not None and isinstance(one.weights, RayWeights)  # not computed
        np.testing.assert_array_equal(one.data, other.data)
        np.testing.assert_array_equal(one.weights[...], other.weights[...])
