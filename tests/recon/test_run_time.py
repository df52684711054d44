"""The time of a run, as small runs foretell it: in proportion to what is asked for."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import recon
from recon import run_time
from recon.auto import Auto
from recon.base.geometry import Geometry
from recon.base.ray_width import RayWidth
from recon.base.volume import Grid
from recon.run_time import Extent, RunTime, run_seconds
from recon.splatting.initialise import count_for

PARALLEL = Geometry.parallel(np.linspace(0, 3, 60), (16, 64), pixel_pitch=1.0)
CONE = Geometry.cone(np.linspace(0, 6, 60), (16, 64), 1.0, 200.0, 400.0)


def extent(views: int, cols: int, heights: Sequence[int], decided: bool = False) -> Extent:
    """Of a parallel beam."""
    return Extent(Geometry.parallel(np.arange(views) * np.pi / views, (sum(heights), cols)), heights, decided)


def test_fbp_takes_twice_as_long_for_two_slabs_and_a_choice_as_long_as_its_parts() -> None:
    one, two = extent(90, 64, [32]), extent(90, 64, [32, 32])
    seconds = [run_seconds(recon.Fbp(), each, itertools.count().__next__) for each in (one, two)]
    assert seconds[1].most == seconds[1].least == pytest.approx(2 * seconds[0].most)
    assert run_seconds(Auto((recon.Fbp(),)), two, itertools.count().__next__).least == pytest.approx(
        3 * seconds[0].least
    )


def test_iterations_cost_by_their_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where each run takes a second, whatever it does, an iteration costs nothing: what is left is one run."""
    monkeypatch.setattr(run_time, "_took", lambda *_: (1.0, {}, 0))
    few, many = (
        run_seconds(recon.Sirt(iterations=n), extent(108, 64, [16]), itertools.count().__next__).most for n in (3, 300)
    )
    assert few == many == pytest.approx(1.0)


def test_iterations_cost_by_voxels_and_views(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a law of so much a voxel, a voxel and view, and for trials a voxel of a slice and view."""

    def took(*arguments: Any) -> tuple[float, Any, int]:
        *_, (views, cols, rows), iterations, decide = arguments
        trials = 0 if decide._followed else 32 * views * cols**2
        return 1e-6 * (rows * cols**2 * (10 + iterations * (5 + views)) + trials), {"weight": [1.0]}, 32

    monkeypatch.setattr(run_time, "_took", took)
    for views, cols, rows in ((90, 100, 8), (1800, 2048, 64)):
        found = run_seconds(recon.OsSirtTv(iterations=40), extent(views, cols, [rows]), itertools.count().__next__)
        assert found.most == pytest.approx(1e-6 * cols**2 * (rows * (10 + 40 * (5 + views)) + 64 * views))


def test_a_neural_field_costs_by_its_steps_and_slabs_and_ends_by_its_seconds() -> None:
    """By a clock that counts how often it is asked: each small run takes one, a step a twelfth of that."""

    def seconds(heights: list[int], **settings: Any) -> float:
        method = recon.NAF(rays=8, samples=4, levels=1, **settings)
        return run_seconds(method, extent(108, 128, heights), itertools.count().__next__).most

    volume = 1.0  # of sixteen rows
    assert seconds([16], steps=1200) == pytest.approx(100 + volume)
    assert seconds([8, 8], steps=1200) == pytest.approx(200 + volume)
    assert seconds([16], steps=1200, seconds=5.0) == pytest.approx(5 + volume)


def test_what_another_slab_has_decided_costs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where deciding takes 4 s of a small run, whatever its size, for as many sweeps of trials as a rule."""

    def took(*arguments: Any) -> tuple[float, dict[str, list[float]], int]:
        return (1.0 if arguments[-1]._followed else 5.0), {"weight": [1.0]}, 64

    monkeypatch.setattr(run_time, "_took", took)
    rest, whole = (
        run_seconds(recon.FistaTv(), extent(72, 64, [16], decided), itertools.count().__next__).most
        for decided in (True, False)
    )
    assert (rest, whole) == (1.0, 5.0)


@pytest.mark.parametrize("runs", [(1, 100, 1, 1, 1), (1, 9, 9, 1, 1), (1, 1, 1, 100, 2)])
def test_no_fit_takes_less_than_nothing_on_a_busy_machine(monkeypatch: pytest.MonkeyPatch, runs: list[float]) -> None:
    """Seconds of a first small run, two short ones and two long ones; the same for fits of another size."""
    monkeypatch.setattr(run_time, "reconstruct", lambda *_, **__: None)
    monkeypatch.setattr(run_time, "_of_direct", lambda *_: 0.0)
    clock = iter(itertools.accumulate(seconds for run in 2 * runs for seconds in (0, run)))
    fit = recon.R2(steps=1000, finish=0)
    assert run_seconds(fit, extent(108, 128, [16]), clock.__next__).least > 1000 * runs[-1] / 100


@pytest.mark.parametrize(
    ("settings", "least", "most"), [({}, 450, 900), ({"finish": 8}, 500, 500), ({"steps": 400}, 500, 500)]
)
def test_the_time_of_a_fit_that_the_data_may_end_is_said_twice(
    monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any], least: float, most: float
) -> None:
    """Where a step takes a second, and a quarter more once Gaussians are added, and a finish takes none: a trial of 400
    steps on all sixteen rows, and then 50 or 400."""
    work = run_time._work(16 * 128**2, count_for(Grid((16, 128, 128)), cone=False))
    monkeypatch.setattr(run_time, "_step_of_fit", lambda *_: (work, 1.0))
    monkeypatch.setattr(run_time, "_of_direct", lambda *_: 0.0)
    monkeypatch.setattr(run_time, "_of_iterations", lambda *_: 0.0)
    found = run_seconds(recon.R2(**settings), extent(108, 128, [16]), itertools.count().__next__)
    assert found == pytest.approx(RunTime(most, least))


def test_small_runs_are_of_the_scan_s_own_beam() -> None:
    """As wide a fan, as many pixels of motion in an exposure, the axis at the same share, one row of a fan."""
    views = Geometry.cone(np.linspace(0, 2 * np.pi, 300), (64, 400), 0.1, 50, 150, axis_col=210.0, axis_row=20.0)
    views = replace(views, shifts=np.tile((2.0, 30.0), (300, 1))).seen_with(RayWidth(arc=0.01))
    few = run_time._fewer(views, 50, 100, 16)
    assert few.is_cone and few.n_views == 50 and few.detector_shape == (16, 100)
    assert few.reach == pytest.approx(views.reach) and few.sdd == views.sdd
    assert np.ptp(few.angles) == pytest.approx(np.ptp(views.angles))
    motion = [one.width.arc * one.reach / one.sample_pitch for one in (views, few)]
    assert motion[0] == pytest.approx(motion[1])
    assert Grid.matching(few).shape == (16, 100, 100)
    fan = Geometry.fan(views.angles, 400, 0.1, 50, 150)
    assert run_time._within(Extent(fan, [1]), 128, 16) == (400, 1)
    assert run_time._fewer(fan, 50, 300, 1).axis_row == 0
