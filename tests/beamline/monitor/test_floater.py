"""What crosses the field faster than the sample turns is a floater; what turns with the sample never is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.monitor.check import Flag, Level
from beamline.monitor.floater import FloaterCheck
from tests.beamline.monitor.blobs import BLOCK, COLS, STEP, Blobs, blob

BEGINS = 40


def only(scan: Blobs) -> list[Flag]:
    return scan.flags([FloaterCheck()])


def crossing(speed: float, depth: float = 0.05, row: float = 12.0, size: float = 0.75) -> Any:
    """A crumb that enters at the left edge in view BEGINS, blocks a view."""

    def change(view: int, image: NDArray[np.float64]) -> NDArray[np.float64]:
        return image + blob(row, speed * (view - BEGINS), size, depth) if view >= BEGINS - 5 else image

    return change


def test_a_sample_that_turns_has_none() -> None:
    assert only(Blobs(120)) == []


@pytest.mark.parametrize("speed", [0.6, 1.0, 4.0])
def test_a_faint_crumb_that_crosses_is_found_within_ten_views_and_where_it_is(speed: float) -> None:
    flags = only(Blobs(90, depth=crossing(speed)))
    assert flags
    first = flags[0].frame - 10
    assert first - BEGINS <= 10 + 2 / speed
    for flag in flags[:5]:
        assert flag.level is Level.WARN and flag.score > flag.limit
        assert flag.first is not None and 10 + BEGINS - 6 <= flag.first < flag.frame
        assert flag.region is not None
        top, below, left, right = flag.region
        assert top <= 12.5 * BLOCK < below
        judged = flag.frame - 10 - 4  # the view that four later ones have confirmed
        assert left <= (speed * (judged - BEGINS) + 0.5) * BLOCK <= right
    assert "floating particle" in flags[0].advice


def test_it_is_flagged_in_most_of_the_views_that_show_it() -> None:
    flags = only(Blobs(120, depth=crossing(2.0)))
    marked = {row for flag in flags for row in range(flag.first or flag.frame, flag.frame + 1)}
    shown = range(10 + BEGINS + 2, 10 + BEGINS + COLS // 2)
    assert len(marked.intersection(shown)) > 0.9 * len(shown)


@pytest.mark.parametrize(
    "change",
    [
        lambda view, image: image + blob(12, 63.5 + 60 * np.cos(view * STEP - 1.5), 0.75, 0.5),  # turns at the rim
        lambda view, image: image + 0.3 * (np.arange(COLS) == 50),  # a ring
        lambda view, image: image + 0.03 * (view % 2),  # the beam flickers
    ],
    ids=["rim", "ring", "flicker"],
)
def test_what_stays_or_turns_is_none(change: Any) -> None:
    assert only(Blobs(90, depth=change)) == []


def test_zingers_are_none() -> None:
    rng = np.random.default_rng(8)

    def zingers(view: int, light: NDArray[np.float64]) -> NDArray[np.float64]:
        rows, cols = rng.integers(0, 32, 2), rng.integers(0, COLS, 2)
        light[rows, cols] += rng.exponential(5_000, 2)
        return light

    assert only(Blobs(200, counts=zingers)) == []


def test_a_jump_of_the_sample_is_none() -> None:
    scan = Blobs(90)
    scan.depth = lambda view, image: scan.line_integrals(view, (0.0, 1.0)) if view >= 50 else image
    assert only(scan) == []


def test_uneven_angles_are_left_alone() -> None:
    scan = Blobs(60, depth=crossing(2.0), step=float(np.radians(77)))
    assert only(scan) == []


def test_steps_of_any_size_overflow_nothing() -> None:
    with np.errstate(over="raise", invalid="raise"):
        assert only(Blobs(20, step=1e300)) == []
