"""The time of a fit in time: sweeps by what a sweep costs, longer where the sample may move, refused as the fit is."""

from __future__ import annotations

import time

import numpy as np
import pytest

from recon import series_time
from recon.base.geometry import Geometry
from recon.series_time import _Cost, series_seconds

GEOMETRY = Geometry.parallel(np.arange(48) * 2.4, (8, 40))
STILL, MOVING = _Cost(0.0, 1e-6), _Cost(0.0, 3e-6)
SWEEP = 48 * 8 * 40**2 * 1e-6  # s


@pytest.fixture
def _known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(series_time, "_cost", lambda geometry, knots, moves, now: MOVING if moves else STILL)


def seconds(geometry: Geometry = GEOMETRY, motion: bool | None = None, knots: int = 2) -> tuple[float, float]:
    """Least and most."""
    most, least = series_seconds(geometry, knots, motion, 60, time.perf_counter)
    return least, most


@pytest.mark.usefixtures("_known")
def test_a_sample_at_rest_takes_trials_of_weights_and_factors_and_the_fit() -> None:
    least, most = seconds(motion=False)
    assert least == pytest.approx((24 * 11 + 60 + 120 + 60 + 60) * SWEEP)
    assert most - least == pytest.approx(24 * 5 * SWEEP)


@pytest.mark.usefixtures("_known")
def test_a_motion_takes_the_fit_with_it_and_turns_on_coarser_voxels() -> None:
    """40 columns: 6 turns on voxels of two pixels, 4 on single ones."""
    least, _ = seconds(motion=True)
    turns = 6 / 8 + 4
    assert least == pytest.approx((24 * 11 + 3 * 60 + 3 * turns * (6 + 4)) * SWEEP)
    assert seconds()[0] > seconds(motion=False)[0]
    assert seconds()[1] > seconds(motion=True)[1]


def test_sweeps_are_measured_for_cones_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(series_time, "_COLUMNS", (12, 20))
    monkeypatch.setattr(series_time, "_TIMED", 1)
    cone = Geometry.cone(np.linspace(0, 2 * np.pi, 24, endpoint=False), (4, 40), 1.0, 60.0, 120.0)
    assert 0 < seconds(cone)[0] < 3600


def test_too_few_views_are_refused_as_by_the_fit() -> None:
    with pytest.raises(ValueError, match="5 volumes of 48 views: expected 2 volumes or more"):
        seconds(knots=5)
