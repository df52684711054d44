"""What a trial costs: in proportion to views and iterations, and no more than is asked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from beamline.trials.cost import expected_seconds, sweep_seconds
from beamline.trials.trial import Trial
from recon.base.geometry import Geometry

VIEWS = Geometry.parallel(np.linspace(0, np.pi, 60, endpoint=False), (8, 64))


def test_iterations_and_views_cost_in_proportion() -> None:
    few, many = (Trial("method", "sirt", 60, settings={"iterations": n}) for n in (10, 20))
    first, second = (expected_seconds(trial, VIEWS) for trial in (few, many))
    assert first is not None and second is not None and second - first == pytest.approx(10)
    assert expected_seconds(replace(many, views=30), VIEWS) == pytest.approx(second / 2)
    assert expected_seconds(replace(many, halves=True), VIEWS, 0.5) == pytest.approx(second)


def test_a_time_is_what_it_costs_and_one_fit_of_all_is_not_known() -> None:
    assert expected_seconds(Trial("method", "r2", 60).in_time(7.0), VIEWS) == 7.0
    assert expected_seconds(Trial("one fit", "series", 60, settings={"volumes": 2, "motion": "none"}), VIEWS) is None


def test_a_sweep_of_the_scan_is_that_of_a_small_one_by_rays_and_voxels(one_thread: None) -> None:
    """On a clock on which every sweep takes a second."""
    ticks = iter(range(100))
    assert sweep_seconds(VIEWS, lambda: float(next(ticks))) == pytest.approx(60 / 48)
