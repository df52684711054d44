"""Angles that do not belong to the projections: list positions, twice or half of the true angles.

Scans of balls by the formula of a sphere's chord; one sample is wider than the field, one is round.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.storage.rules import Finding
from beamline.storage.rules.angles import angles_spread
from beamline.storage.rules.angles_shown import angles_in_order, coarse_views, rotation_matches_images
from beamline.storage.rules.evidence import ScanEvidence
from tests.beamline.array_source import ArraySource, scan_of

ROWS, COLS, LIGHT, DARK = 8, 96, 3e4, 100.0
Balls = list[tuple[float, float, float, float]]  # x, y, radius in px, and attenuation a px
WITHIN: Balls = [(0, 0, 32, 0.004), (14, 6, 8, 0.03), (-12, 10, 7, 0.02), (-9, -15, 6, 0.06)]
WIDER: Balls = [(0, 0, 70, 0.004), (20, 10, 12, 0.03), (-30, 12, 9, 0.02), (25, -34, 8, 0.03)]
ROUND: Balls = [(0, 0, 32, 0.02)]


def scan(balls: Balls, true: NDArray[np.float64], stated: NDArray[np.float64], axis: float = 44.3) -> ArraySource:
    """Counts of views at these true angles in degrees under other labels."""
    rng = np.random.default_rng(3)
    row, col, angles = np.arange(ROWS) - (ROWS - 1) / 2, np.arange(COLS) - axis, np.radians(true)
    depth = np.zeros((true.size, ROWS, COLS))
    for x, y, radius, mu in balls:
        at = (x * np.cos(angles) + y * np.sin(angles))[:, None, None]
        depth += 2 * mu * np.sqrt((radius**2 - (col - at) ** 2 - (row[:, None] + y / 8) ** 2).clip(0))
    beam = LIGHT * np.exp(-0.3 * np.linspace(-1, 1, COLS) ** 2)
    light = np.zeros((4, ROWS, COLS)), np.tile(beam, (4, ROWS, 1)), beam * np.exp(-depth)
    darks, flats, views = (rng.poisson(each + DARK) for each in light)
    return scan_of(darks, flats, views, np.radians(stated))


def told(source: ArraySource) -> list[Finding]:
    seen = coarse_views(ScanEvidence(source))
    return [] if seen is None else list(rotation_matches_images(seen))


def turn(degrees: float, views: int, endpoint: bool = False) -> NDArray[np.float64]:
    return np.linspace(0, degrees, views, endpoint=endpoint)


@pytest.mark.parametrize("balls", [WITHIN, WIDER], ids=["within", "wider"])
@pytest.mark.parametrize(
    ("true", "stated", "unit"),
    [
        (turn(180, 240), np.arange(240.0), "the values are 0, 1, 2 and so on, so they are frame numbers"),
        (turn(180, 90), np.arange(90.0), "the values are 0, 1, 2 and so on, so they are frame numbers"),
        (turn(180, 120), turn(360, 120), "times the stated angles"),
    ],
)
def test_angles_of_another_unit_are_refused_or_doubted(
    balls: Balls, true: NDArray[np.float64], stated: NDArray[np.float64], unit: str
) -> None:
    (hit,) = told(scan(balls, true, stated))
    stated_apart = np.ptp(stated) > 176  # else a sample that is symmetric looks so, too
    assert (hit.severity, hit.rule) == ("error" if stated_apart else "warning", "angle-spread")
    assert unit in hit.message and "--angles FILE" in hit.message


@pytest.mark.parametrize("balls", [WITHIN, WIDER, ROUND], ids=["within", "wider", "round"])
@pytest.mark.parametrize(
    "true",
    [turn(180, 90), turn(360, 90), turn(180, 181, endpoint=True), turn(120, 60), turn(200, 90),
     np.arange(90) * 111.246 % 180, np.sort(np.random.default_rng(4).uniform(0, 360, 80))],
    ids=["half", "whole", "0 to 180", "limited", "more", "golden", "random"],
)  # fmt: skip
def test_angles_that_the_views_show_are_not_doubted(balls: Balls, true: NDArray[np.float64]) -> None:
    assert told(scan(balls, true, true)) == []


def test_half_of_the_turn_is_told_by_one_pair_of_a_sample_within_the_field() -> None:
    (hit,) = told(scan(WITHIN, turn(360, 120), turn(180, 120)))
    assert hit.severity == "error" and "times the stated angles" in hit.message


@pytest.mark.parametrize("axis", [24.3, 44.3, 70.2])
def test_a_rod_about_an_axis_far_from_the_middle_is_never_refused(axis: float) -> None:
    rod: Balls = [(11, 4, 6, 0.05)]
    for true in (turn(180, 90), turn(360, 90), np.arange(140.0)):
        assert all(hit.severity == "warning" for hit in told(scan(rod, true, true, axis)))


def ordered(source: ArraySource) -> list[Finding]:
    seen = coarse_views(ScanEvidence(source))
    return [] if seen is None else list(angles_in_order(seen))


ROD: Balls = [(11, 4, 6, 0.05)]  # off the axis: directions that mirror each other look alike
EVEN = turn(180, 64)
PASSES = np.concatenate([np.arange(at, 64, 4) for at in range(4)])
MIXED = np.random.default_rng(1).permutation(64)
GOLDEN = np.arange(64) * 111.246


@pytest.mark.parametrize("balls", [WITHIN, WIDER], ids=["within", "wider"])
@pytest.mark.parametrize(
    ("true", "stated", "severity", "says"),
    [
        (EVEN, np.roll(EVEN, 10), "error", "stated at 177.188 and 0 degrees, look similar"),
        (EVEN, EVEN[PASSES], "error", "not in the order of the frames"),
        (EVEN, EVEN[MIXED], "error", "not in the order of the frames"),
        (EVEN, np.r_[EVEN[:54], np.zeros(10)], "error", "not in the order of the frames"),
        (
            EVEN,
            np.where(np.arange(64) == 40, 0, EVEN),
            "warning",
            "not between the angles of the neighbouring projections",
        ),
        (EVEN[PASSES], EVEN, "warning", "look more similar than neighbouring"),
    ],
    ids=["shifted", "passes stated", "shuffled", "end not written", "one wrong", "passes taken"],
)
def test_angles_in_another_order_than_the_frames_are_told(
    balls: Balls, true: NDArray[np.float64], stated: NDArray[np.float64], severity: str, says: str
) -> None:
    (hit,) = ordered(scan(balls, true, stated))
    assert hit.severity == severity and says in hit.message


ORDERS = [EVEN, EVEN[::-1], EVEN[PASSES], EVEN[MIXED], GOLDEN, GOLDEN % 180, turn(720, 128), np.r_[EVEN, EVEN]]


@pytest.mark.parametrize(
    ("balls", "true"),
    [*product([WITHIN, WIDER], ORDERS), *product([ROUND, ROD], [EVEN, EVEN[MIXED], GOLDEN])],
)
def test_any_order_of_frames_with_their_own_angles_is_right(balls: Balls, true: NDArray[np.float64]) -> None:
    assert ordered(scan(balls, true, true)) == []


def test_views_that_count_up_are_asked_about_unless_a_plan_of_ours_states_them() -> None:
    source: Any = scan(WITHIN, turn(60, 60), np.arange(60.0))
    (asked,) = angles_spread(ScanEvidence(source))
    source.plan = {"angles_deg": np.arange(180.0)}
    (known,) = angles_spread(ScanEvidence(source))
    assert "are these values frame numbers?" in asked.message and "count" not in known.message
