"""Work adds and multiplies as times do, and each method states it: in operations that can be measured, and by size."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import recon
from recon.auto import Auto
from recon.base.geometry import Geometry
from recon.base.method import Method
from recon.base.volume import Grid
from recon.base.work import CLOCK, CostedMethod, Costs, Rate, Work, costs_of, parts_of, seconds_of
from recon.machine_speed import OPERATIONS
from recon.methods import by_name, names

NUMBERS = st.floats(0, 1e6)
WORKS = st.dictionaries(st.sampled_from("abc"), st.tuples(NUMBERS, NUMBERS)).map(Work)
VIEWS = Geometry.parallel(np.linspace(0, np.pi, 60, endpoint=False), (32, 64))


def rates(operation: str) -> Rate:
    """Those of a machine on which every operation takes as long."""
    return Rate(1e-9, 1e-9)


def seconds(method: Method, geometry: Geometry = VIEWS, heights: list[int] | None = None, decided: bool = False) -> Any:
    parts = parts_of(geometry, heights or [Grid.matching(geometry).shape[0]])
    costs = costs_of(method, parts, decided)
    assert costs is not None
    return seconds_of(costs, rates)


@given(WORKS, WORKS, st.floats(0, 1e3))
def test_seconds_are_linear_in_the_work(one: Work, other: Work, factor: float) -> None:
    both = (one + factor * other).seconds(rates)
    assert both == pytest.approx(one.seconds(rates) + factor * other.seconds(rates), rel=1e-9, abs=1e-12)
    assert Work.of(CLOCK, 7.0).seconds(rates) == 7.0


def test_a_choice_of_the_data_spans_from_the_least_to_the_most() -> None:
    costs = Costs({"a": Work.of(CLOCK, 2.0), "b": Work.of(CLOCK, 5.0)}, Work.of(CLOCK, 1.0))
    assert seconds_of(costs, rates) == (3.0, 6.0)


@pytest.mark.parametrize("name", names())
def test_each_method_states_its_work_in_operations_that_can_be_measured(name: str) -> None:
    cone = Geometry.cone(np.linspace(0, 2 * np.pi, 60, endpoint=False), (32, 64), 1.0, 200.0, 400.0)
    for geometry in (VIEWS, cone, replace(VIEWS, tilt=np.full(60, 0.02))):
        method = by_name(name)()
        assert isinstance(method, CostedMethod)
        costs = method.costs(geometry, Grid.matching(geometry))
        stated = sum(costs.volumes.values(), costs.choice).amounts
        assert stated and {operation.partition(", ")[0] for operation in stated} <= set(OPERATIONS)
        assert all(min(amounts) >= 0 < max(amounts) for amounts in stated.values())


@pytest.mark.parametrize("method", [recon.Sirt(iterations=30), recon.FistaTv(), recon.R2(steps=50, finish=0)])
def test_twice_the_slabs_take_twice_as_long_and_what_is_decided_costs_nothing(method: Method) -> None:
    one, two = seconds(method, heights=[16]), seconds(method, heights=[16, 16])
    choice = one.most - seconds(method, heights=[16], decided=True).most
    assert two.most - choice == pytest.approx(2 * (one.most - choice), rel=0.3)
    assert (choice > 0) is isinstance(method, recon.FistaTv)


def test_iterations_cost_by_their_number_and_a_time_is_what_it_costs() -> None:
    few, many = (seconds(recon.Sirt(iterations=n)).most for n in (9, 19))
    assert many == pytest.approx(2 * few)
    assert seconds(recon.R2(seconds=7.0)) == (7.0, 7.0)


def test_a_fit_that_the_data_may_end_takes_least_where_voxels_make_its_volume() -> None:
    free, given_steps = recon.R2(), recon.R2(steps=400)
    assert seconds(free).least < seconds(free).most
    assert seconds(given_steps).least == seconds(given_steps).most
    costs = free.costs(VIEWS, Grid.matching(VIEWS))
    assert set(costs.volumes) == {"r2", "fista-tv", "pnp-dct"} and costs.choice.amounts["view, parallel"][0] > 100


def test_a_choice_among_methods_takes_trials_of_all_and_then_one() -> None:
    costs = Auto().costs(VIEWS, Grid.matching(VIEWS))
    assert set(costs.volumes) == {"fbp", "fista-tv", "pnp-dct", "r2"}
    assert costs.choice.seconds(rates) > sum(seconds(m, decided=True).least for m in (recon.FistaTv(), recon.PnpDct()))
    few = VIEWS.select(slice(0, 12))
    assert set(Auto().costs(few, Grid.matching(few)).volumes) == {"r2"}


def test_views_that_a_method_refuses_are_refused_before_any_work() -> None:
    wide = Geometry.cone(np.linspace(0, 6, 60), (8, 64), 1.0, 20.0, 30.0)
    with pytest.raises(ValueError, match="the box reaches"):
        seconds(recon.Sirt(), wide)
