"""Projections of the same rays at two times show how a sample changed; a sample at rest shows no change."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.prep.repeats import changes_seen
from tests.bench.clean_scans import Change, lines_of

SHAPE, AXIS, SOD = (20, 64), 32.4, 190.0
BALLS = np.array(
    [(0, 0, 0, 20, 0.2), (9, 4, 1, 5, 0.6), (-8, 7, -4, 4, 0.8), (-6, -10, 3, 3, 0.9), (12, -6, -3, 3, 0.7)]
)
WIDE = np.concatenate([BALLS, [(0, 0, 0, 60, 0.3)]])
BEAMS = {"half": (np.pi, 90), "full": (2 * np.pi, 90), "cone": (2 * np.pi, 120), "five turns": (10 * np.pi, 180)}


def rest(t: float, balls: NDArray[np.float64]) -> NDArray[np.float64]:
    return balls


def shrinks(t: float, balls: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(balls * [*(4 * [1 - 0.06 * t]), 1])


def drops(t: float, balls: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(balls + np.array([0, 0, 2 * (t > 0.45), 0, 0]))


def seen(beam: str, balls: NDArray[np.float64], change: Change) -> list[tuple[float, NDArray[np.float64]]]:
    """Time between views, and changes over their uncertainty where they have six of these."""
    turn, n = BEAMS[beam]
    angles, sod = np.linspace(0, turn, n, endpoint=False), SOD if beam == "cone" else None
    data = 0.05 * lines_of(balls, angles, SHAPE, AXIS, sod, change)
    data += np.random.default_rng(1).normal(0, 0.004, data.shape)
    geometry = Geometry.parallel(angles, SHAPE, axis_col=AXIS)
    if sod is not None:
        geometry = Geometry.cone(angles, SHAPE, 2.0, sod, 2 * sod, axis_col=AXIS)
    told = changes_seen(data.astype(np.float32), geometry)
    return [(between, np.where(np.abs(by) > 6 * sigma, by, 0)) for _, between, by, sigma in told]


@pytest.mark.parametrize("balls", [BALLS, WIDE], ids=["within", "wide"])
@pytest.mark.parametrize("beam", BEAMS)
def test_a_sample_that_shrinks(beam: str, balls: NDArray[np.float64]) -> None:
    between, change = seen(beam, balls, shrinks)[0]
    assert change[2] == pytest.approx(-0.06 * between, abs=0.015)


@pytest.mark.parametrize("beam", BEAMS)
def test_a_sample_that_drops_at_once(beam: str) -> None:
    assert seen(beam, WIDE, drops)[-1][1][0] == pytest.approx(2, abs=0.5)


@pytest.mark.parametrize("balls", [BALLS, WIDE], ids=["within", "wide"])
@pytest.mark.parametrize("beam", BEAMS)
def test_a_sample_at_rest(beam: str, balls: NDArray[np.float64]) -> None:
    for _, change in seen(beam, balls, rest):
        assert (np.abs(change) < [0.2, 0.02, 0.01, 0.01]).all()


def test_views_that_are_too_noisy_too_few_or_too_far_apart_tell_nothing() -> None:
    angles = np.linspace(0, np.pi, 20, endpoint=False)
    geometry, views = Geometry.parallel(angles, SHAPE, axis_col=AXIS), np.zeros((20, *SHAPE), np.float32)
    assert not list(changes_seen(0.05 * lines_of(BALLS, angles, SHAPE, AXIS).astype(np.float32), geometry))
    assert not list(changes_seen(views[:, :4], Geometry.parallel(angles, (4, 64), axis_col=AXIS)))


def test_a_sample_in_one_band_of_rows_is_not_compared() -> None:
    """Bands are left out in turn; what is left of this one is empty."""
    angles = np.linspace(0, np.pi, 60, endpoint=False)
    data = np.zeros((60, 40, 64), np.float32)
    data[:, :2] = 0.05 * lines_of(WIDE, angles, (2, 64), AXIS, None, rest)
    assert not list(changes_seen(data, Geometry.parallel(angles, (40, 64), axis_col=AXIS)))
