"""The time of a fit in time: as long as the fit takes, longer where the sample may move, and refused as the fit is."""

from __future__ import annotations

import time

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.series_time import series_seconds

GEOMETRY = Geometry.parallel(np.arange(48) * 2.4, (8, 40))


def seconds(geometry: Geometry = GEOMETRY, knots: int = 2, motion: bool | None = None) -> tuple[float, float]:
    least, most = sorted(series_seconds(geometry, knots, motion, 60, time.perf_counter))
    return least, most


def test_motion_and_wider_detectors_take_longer() -> None:
    wide = Geometry.parallel(np.arange(48) * 2.4, (8, 160))
    assert seconds(motion=False)[1] < seconds(motion=True)[0] < seconds(motion=None)[1]
    assert seconds(wide, motion=False)[0] > 2 * seconds(motion=False)[1]


def test_too_few_views_are_refused_as_by_the_fit() -> None:
    with pytest.raises(ValueError, match="5 volumes of 48 views: expected 2 volumes or more"):
        seconds(knots=5)


def test_cones_are_estimated_too() -> None:
    cone = Geometry.cone(np.linspace(0, 2 * np.pi, 48, endpoint=False), (8, 40), 1.0, 60.0, 120.0)
    assert 0 < seconds(cone)[0] < 600
