"""The Pareto front against its definition, on any points."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.features.trials.table import front, rounded, steps

# Few distinct values, so that ties happen.
VALUES = st.one_of(st.integers(-5, 5).map(float), st.floats(-1e6, 1e6), st.just(math.nan), st.just(math.inf))
POINTS = st.lists(st.tuples(VALUES, VALUES), max_size=30)


def _finite(point: tuple[float, float]) -> bool:
    return math.isfinite(point[0]) and math.isfinite(point[1])


def _beats(a: tuple[float, float], b: tuple[float, float]) -> bool:
    return a[0] <= b[0] and a[1] >= b[1] and a != b


@given(POINTS)
def test_exactly_the_points_that_nothing_beats_are_kept(points: list[tuple[float, float]]) -> None:
    costs, qualities = [p[0] for p in points], [p[1] for p in points]
    kept = front(costs, qualities)
    finite = [p for p in points if _finite(p)]
    unbeaten = {p for p in finite if not any(_beats(other, p) for other in finite)}
    assert len(kept) == len(set(kept)) == len(unbeaten)
    assert {points[i] for i in kept} == unbeaten
    for i in kept:  # of equal points the first
        assert points.index(points[i]) == i


@given(POINTS)
def test_the_best_of_each_axis_is_on_it_and_both_rise_along_it(points: list[tuple[float, float]]) -> None:
    costs, qualities = [p[0] for p in points], [p[1] for p in points]
    kept = front(costs, qualities)
    finite = [p for p in points if _finite(p)]
    assert bool(kept) == bool(finite)
    if finite:
        assert costs[kept[0]] == min(p[0] for p in finite)
        assert qualities[kept[-1]] == max(p[1] for p in finite)
    stretches = steps(kept, costs, qualities)
    assert all(s.cost > 0 and s.gain > 0 for s in stretches)
    if stretches:
        assert sum(s.gain for s in stretches) == pytest.approx(qualities[kept[-1]] - qualities[kept[0]], abs=1e-6)


@given(POINTS, st.randoms(use_true_random=False))
def test_neither_order_nor_beaten_points_matter(points: list[tuple[float, float]], random: object) -> None:
    def found(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
        return [points[i] for i in front([p[0] for p in points], [p[1] for p in points])]

    shuffled = list(points)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    assert found(shuffled) == found(points) == found(found(points))


def test_what_the_next_decibel_costs() -> None:
    costs, qualities = [1.0, 10.0, 5.0, 40.0], [25.0, 29.0, 24.0, 29.5]
    kept = front(costs, qualities)
    assert kept == [0, 1, 3]
    assert [s.per_decibel for s in steps(kept, costs, qualities)] == pytest.approx([9 / 4, 60.0])
    assert steps([2], costs, qualities) == []


@given(st.floats(1e-9, 1e12), st.floats(1e-9, 1e12))
def test_rounding_moves_a_cost_by_half_a_percent_and_keeps_the_order(one: float, other: float) -> None:
    assert rounded(one) == pytest.approx(one, rel=0.0051)
    assert rounded(min(one, other)) <= rounded(max(one, other))
    assert rounded(rounded(one)) == pytest.approx(rounded(one), rel=1e-9)


def test_what_is_no_cost_stays_as_it_is() -> None:
    assert rounded(0.0) == 0 and rounded(math.inf) == math.inf and math.isnan(rounded(math.nan))
