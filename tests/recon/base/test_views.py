"""Selections of projections: the result of each form, and errors for anything else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.views import parse_views
from tests.refused_calls import refused_calls

HALF = np.deg2rad(np.arange(0, 180, 1.0))


def picked_deg(spec: str, angles: NDArray[np.float64]) -> list[float]:
    return [round(float(a), 6) for a in np.rad2deg(angles[parse_views(spec, angles)])]


def test_all_and_first() -> None:
    np.testing.assert_array_equal(parse_views("all", HALF), np.arange(180))
    np.testing.assert_array_equal(parse_views("first:3", HALF), [0, 1, 2])
    assert parse_views("all", HALF).dtype == np.int64


def test_every_takes_one_of_so_many_in_the_order_taken() -> None:
    np.testing.assert_array_equal(parse_views("every:50", HALF), [0, 50, 100, 150])


@pytest.mark.parametrize("n", [1, 2, 45, 60, 90, 180])
def test_fixed_takes_equal_steps_from_the_first_view(n: int) -> None:
    assert picked_deg(f"fixed:{n}", HALF) == list(np.arange(n) * 180 / n)


def test_fixed_counts_0_and_180_degrees_once() -> None:
    closed = np.deg2rad(np.arange(-88.2, 92, 2.0))
    assert closed.size == 91
    np.testing.assert_array_equal(parse_views("fixed:45", closed), np.arange(0, 90, 2))
    jitter = closed + np.random.default_rng(0).uniform(-1e-4, 1e-4, 91)
    np.testing.assert_array_equal(parse_views("fixed:45", jitter), np.arange(0, 90, 2))
    assert parse_views("fixed:91", closed).size == 91


def test_fixed_of_a_full_turn_spreads_over_the_half_circle() -> None:
    turn = np.deg2rad(np.arange(0, 360, 0.5))
    places = np.sort(np.mod(np.rad2deg(turn[parse_views("fixed:90", turn)]) + 1e-6, 180))
    np.testing.assert_allclose(np.diff(places), 2.0, atol=1e-5)
    assert parse_views("fixed:500", turn).size == 500


@pytest.mark.parametrize("spec", ["fixed:90", "sector:0-360:90"])
def test_fixed_of_a_cone_spreads_over_the_whole_turn(spec: str) -> None:
    cone = Geometry.cone(np.deg2rad(np.arange(0, 360, 0.5)), (4, 8), 1.0, 50.0, 100.0)
    chosen = np.rad2deg(cone.angles[parse_views(spec, cone.angles, period=cone.period)])
    np.testing.assert_allclose(chosen, np.arange(0, 360, 4.0), atol=1e-9)
    closed = np.deg2rad(np.arange(0, 361, 2.0))  # 0 and 360 degrees are one place of a cone
    np.testing.assert_array_equal(parse_views("fixed:90", closed, period=2 * np.pi), np.arange(0, 180, 2))


def test_fixed_works_in_any_order_of_angles() -> None:
    golden = np.mod(np.arange(144) * np.pi * 0.6180339887498949, np.pi)
    chosen = np.sort(golden[parse_views("fixed:24", golden)])
    gaps = np.diff(chosen, append=chosen[0] + np.pi)
    assert gaps.max() < 2 * np.pi / 24


def test_fixed_of_a_sector_across_180_degrees() -> None:
    angles = np.deg2rad(np.arange(150, 210, 1.0))
    assert picked_deg("fixed:6", angles) == [150, 160, 170, 180, 190, 200]


def test_sector() -> None:
    assert picked_deg("sector:30-33", HALF) == [30, 31, 32, 33]
    assert picked_deg("sector:30-150:4", HALF) == [30, 60, 90, 120]
    assert picked_deg("sector:29.5-31.5", HALF) == [30, 31]
    turning = np.deg2rad(np.arange(-90, 90, 10.0))
    assert picked_deg("sector:-20-10", turning) == [-20, -10, 0, 10]
    assert picked_deg("sector:-20--10", turning) == [-20, -10]
    assert picked_deg("sector:340-350", turning) == [-20, -10]


def test_random_is_drawn_once_each_and_by_its_seed() -> None:
    chosen = parse_views("random:90:7", HALF)
    assert len(set(chosen.tolist())) == 90
    np.testing.assert_array_equal(chosen, parse_views("random:90:7", HALF, seed=3))
    np.testing.assert_array_equal(parse_views("random:90", HALF, seed=7), chosen)
    assert (parse_views("random:90", HALF) != chosen).any()


@given(
    form=st.sampled_from(["fixed:{n}", "first:{n}", "random:{n}", "random:{n}:5", "sector:0-360:{n}"]),
    angles=st.lists(st.floats(-20, 20), min_size=1, max_size=50),
    data=st.data(),
)
def test_the_number_asked_for_ascending_and_none_twice(form: str, angles: list[float], data: st.DataObject) -> None:
    n = data.draw(st.integers(1, len(angles)))
    chosen = parse_views(form.format(n=n), angles)
    assert chosen.size == n
    assert (np.diff(chosen) > 0).all()
    assert 0 <= chosen[0] <= chosen[-1] < len(angles)


test_calls_that_are_refused = refused_calls(__file__, globals())
