"""The time of a run, as small runs foretell it: in proportion to what is asked for."""

from __future__ import annotations

import itertools

import pytest

import recon
from recon import run_time
from recon.auto import Auto
from recon.run_time import Extent, run_seconds


def test_fbp_takes_twice_as_long_for_two_slabs_and_a_choice_as_long_as_its_parts() -> None:
    one, two = Extent(90, 64, [32]), Extent(90, 64, [32, 32])
    seconds = [run_seconds(recon.Fbp(), extent, itertools.count().__next__) for extent in (one, two)]
    assert seconds[1] == pytest.approx(2 * seconds[0])
    assert run_seconds(Auto((recon.Fbp(),)), two, itertools.count().__next__) == pytest.approx(3 * seconds[0])


def test_iterations_cost_by_their_number() -> None:
    """By a clock that ticks once a run, whatever it does, an iteration costs nothing: what is left is one run."""
    few, many = (
        run_seconds(recon.Sirt(iterations=n), Extent(108, 64, [16]), itertools.count().__next__) for n in (3, 300)
    )
    assert few == many == pytest.approx(1.0)


def test_what_another_slab_has_decided_costs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where deciding takes 4 s of a small run, whatever its size."""

    def took(*arguments: object, twice: bool = False) -> tuple[float, dict[str, list[float]]]:
        return (5.0 if twice else 1.0), {}

    monkeypatch.setattr(run_time, "_took", took)
    rest, whole = (
        run_seconds(recon.FistaTv(), Extent(72, 64, [16], decided=decided), itertools.count().__next__)
        for decided in (True, False)
    )
    assert (rest, whole) == (1.0, 5.0)
