"""Each state of a streamed fit on its own: what it holds, and which state follows it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.splatting.anytime import WHILE_VIEWS_COME
from recon.splatting.settings import DensityPolicy
from recon.splatting.stream_placement import Arrivals, StreamPlan
from recon.splatting.stream_states import Finishing, Growing, Waiting
from tests.messages import refused

pytestmark = pytest.mark.usefixtures("one_thread")

SHAPE, PITCH = (4, 24), 0.1
ANGLES = np.linspace(0, np.pi, 24, endpoint=False)
TEMPLATE = Geometry.parallel([0.0], SHAPE, pixel_pitch=PITCH)
PLAN = StreamPlan(WHILE_VIEWS_COME, Grid.matching(TEMPLATE), count=60, first_views=8, first_span=np.pi / 6)
AXIS = (SHAPE[1] - 1) / 2


def _disc(radius: float = 0.8) -> np.ndarray:
    """A projection of a disc of this radius in mm around the axis."""
    u = PITCH * (np.arange(SHAPE[1]) - AXIS)
    return np.tile(2 * np.sqrt(np.clip(radius**2 - u**2, 0, None)), (SHAPE[0], 1)).astype(np.float32)


DATA = np.stack([_disc()] * ANGLES.size)


def _waiting(n: int, data: np.ndarray = DATA, angles: np.ndarray = ANGLES) -> Waiting:
    return Waiting(Arrivals(TEMPLATE), (), np.random.default_rng(0)).followed_by(data[:n], angles[:n])


def _growing(n: int = 24) -> Growing:
    model = _waiting(n).next_round(PLAN)
    assert isinstance(model, Growing)
    return model


@given(st.lists(st.integers(1, 40), max_size=6), st.lists(st.booleans(), min_size=240, max_size=240))
def test_one_arrival_in_sixteen_is_held_out_whatever_was_dropped_before(sizes: list[int], kept: list[bool]) -> None:
    """Whether a projection is held out is decided when it arrives, and stays."""
    views, numbers = Arrivals(TEMPLATE), np.empty(0, int)
    for size in sizes:
        numbers = np.append(numbers, views.n_ever + np.arange(size))
        views = views.followed_by(numbers[-size:].astype(float))
        which = np.flatnonzero([kept[number] for number in numbers])
        views, numbers = views.only(which), numbers[which]
    assert views.held_out.tolist() == (numbers % 16 == 8).tolist()
    np.testing.assert_array_equal(views.angles, numbers)
    assert views.n_ever == sum(sizes)


class TestWaiting:
    def test_new_projections_make_a_new_state(self) -> None:
        before = _waiting(5)
        after = before.followed_by(DATA[5:7], ANGLES[5:7])
        assert (before.views.n, len(before.images), after.views.n, len(after.images)) == (5, 5, 7, 7)

    @pytest.mark.parametrize(("n", "angles"), [(7, ANGLES), (24, ANGLES / 10)], ids=["few", "narrow"])
    def test_it_waits_for_enough_projections_that_are_apart(self, n: int, angles: np.ndarray) -> None:
        state = _waiting(n, angles=angles)
        assert state.next_round(PLAN) is state

    def test_then_it_has_a_model(self) -> None:
        model = _growing(20)
        assert (model.placed, model.state.n, model.round_views, model.unseen) == (60, 60, 20, ())
        np.testing.assert_array_equal(model.problem.geometry.angles, ANGLES[:20])

    def test_projections_without_material_are_tried_again_with_half_as_many_again(self) -> None:
        tried = _waiting(16, np.zeros_like(DATA)).next_round(PLAN)
        assert isinstance(tried, Waiting) and tried.round_views == 16
        more = tried.followed_by(DATA[:7], ANGLES[:7])
        assert more.next_round(PLAN) is more
        assert isinstance(more.followed_by(DATA[7:8], ANGLES[7:8]).next_round(PLAN), Growing)

    def test_other_line_integrals_are_tried_at_once(self) -> None:
        tried = _waiting(16, np.zeros_like(DATA)).next_round(PLAN)
        assert isinstance(tried.with_images(DATA[:16], None).next_round(PLAN), Growing)

    def test_the_newest_may_be_replaced_and_some_dropped(self) -> None:
        state = _waiting(4).with_newest(2 * _disc())
        assert [float(image.max() / _disc().max()) for image in state.images] == [1, 1, 1, 2]
        left = state.with_images(DATA[:2], np.array([1, 3]))
        np.testing.assert_array_equal(left.views.angles, ANGLES[[1, 3]])

    def test_the_final_fit_takes_any_number_of_projections_but_needs_material(self) -> None:
        assert _waiting(2).completed(PLAN).views.n == 2
        with refused(ValueError):
            _waiting(24, np.zeros_like(DATA)).completed(PLAN)


class TestGrowing:
    def test_steps_use_each_new_projection_once_except_those_that_are_held_out(self) -> None:
        before = _growing(8)
        model = before.followed_by(DATA[8:12], ANGLES[8:12])
        assert model.views.held_out.tolist() == [False] * 8 + [True] + [False] * 3
        assert (before.unseen, model.unseen) == ((), (9, 10, 11))
        for left in ((10, 11), (11,), (), ()):
            model = model.stepped(PLAN.settings)
            assert model.unseen == left
        assert model.state.step == 4 and 8 not in model.state.drawn

    def test_a_projection_that_is_not_taken_leaves_it_as_it_was(self) -> None:
        model = _growing(8)
        with refused(ValueError):
            model.followed_by(np.full((1, *SHAPE), 1e30, np.float32), ANGLES[8:9])
        with refused(ValueError):
            model.with_images(np.full((4, *SHAPE), np.nan, np.float32), np.arange(4))
        assert model.views.n == model.problem.geometry.n_views == 8

    def test_the_newest_may_be_replaced(self) -> None:
        model = _growing(8)
        other = model.with_newest(np.float32(1.5) * _disc())
        np.testing.assert_allclose(other.problem.projections[[0, -1]], [_disc(), 1.5 * _disc()], rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(other.problem.geometry.angles, model.problem.geometry.angles)

    def test_similar_line_integrals_keep_the_model_and_others_do_not(self) -> None:
        model = _growing(16)
        kept, other = (model.with_images(np.float32(gain) * DATA[:16], None) for gain in (1.1, 1.3))
        assert isinstance(kept, Growing) and kept.state is model.state
        assert isinstance(other, Waiting) and (other.views.n, other.round_views) == (16, 0)
        np.testing.assert_allclose(other.images[3], 1.3 * _disc(), rtol=1e-6)

    def test_without_bad_projections_the_rates_start_again(self) -> None:
        model = _growing(16).followed_by(DATA[16:18], ANGLES[16:18])
        for _ in range(8):
            model = model.stepped(PLAN.settings)
        model = replace(model, unseen=(16, 17))
        which = np.arange(2, 18)
        after = model.with_images(DATA[which], which)
        assert isinstance(after, Growing)
        assert after.fraction(PLAN.settings) == 0 < model.fraction(PLAN.settings)
        assert (after.views.n, after.round_views, after.unseen) == (16, 16, ())
        assert after.state.mean is None

    @pytest.mark.parametrize(("moved", "again"), [(0.15, 0.5), (0.3, 1.0), (-2.0, 1.0)])
    def test_a_move_of_the_axis_raises_the_rates_in_proportion(self, moved: float, again: float) -> None:
        model = _growing()
        for _ in range(40):
            model = model.stepped(PLAN.settings)
        means = model.state.parameters["means"].copy()
        after = model.about(AXIS + moved)
        assert after.schedule_step == round(again * 40)
        assert after.problem.geometry.axis_col == after.views.template.axis_col == AXIS + moved
        expected = np.tile((0, -4 / np.pi * moved * PITCH, 0), (after.state.n, 1))  # of a continuous half turn
        nearly = 2 / ANGLES.size * abs(moved) * PITCH
        np.testing.assert_allclose(after.state.parameters["means"] - means, expected, atol=1.01 * nearly)

    def test_a_round_begins_with_half_as_many_projections_again_and_has_room_for_a_quarter_more(self) -> None:
        model = _growing(16)
        assert (model.state.limit, model.next_round(PLAN)) == (75, model)
        some = model.followed_by(DATA[16:23], ANGLES[16:23])
        assert some.next_round(PLAN) is some
        more = some.followed_by(DATA[23:], ANGLES[23:]).next_round(PLAN)
        assert (more.round_views, more.state, more.state.drawn) == (24, model.state, [])

    def test_after_empty_projections_all_gaussians_are_placed_again(self) -> None:
        faint = np.float32(1e-4) * DATA
        model = _waiting(10, faint).next_round(PLAN)
        assert isinstance(model, Growing)
        again = model.followed_by(DATA[:8], ANGLES[:8]).next_round(PLAN)
        assert again.state is not model.state and again.problem.unit > 100 * model.problem.unit


class TestFinishing:
    def test_the_rates_fall_to_their_end_and_density_control_ends_in_the_middle(self) -> None:
        greedy = replace(PLAN.settings, policy=DensityPolicy(start=0, every=1, threshold=0, prune_below=0, stop=2))
        plan = replace(PLAN, settings=greedy)
        model = _growing().stepped(PLAN.settings).completed(plan)
        last = Finishing.of(model, 4, greedy)
        assert (last.share, last.begun, last.first) == (0, 1, model.fraction(greedy))
        counts = []
        for _ in range(4):
            model.state.limit = model.state.n + 1
            last.step(last.share)
            counts.append(model.state.n)
        assert last.share == 1 and counts == [61, 62, 62, 62]

    def test_it_begins_with_the_mean_of_the_parameters_and_uses_all_projections_alike(self) -> None:
        model = _growing().followed_by(DATA[:2], ANGLES[:2])
        for _ in range(6):
            model = model.stepped(PLAN.settings)
        mean = model.state.mean
        assert mean is not None
        last = replace(model, unseen=(1,)).completed(PLAN)
        assert (last.unseen, last.state.drawn) == ((), [])
        np.testing.assert_array_equal(last.state.parameters["means"], mean["means"])
        assert last.state.parameters["means"] is not mean["means"]
