"""Floaters: an object that crosses the field faster than the sample rotates is found; the sample itself never is."""

import math
import re
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.monitor import watch
from beamline.monitor.check import Flag, Level, ScanContext
from beamline.monitor.foreign.floater import FloaterCheck
from beamline.monitor.foreign.track import SLOWEST
from tests.beamline.monitor.blobs import BLOCK, COLS, STEP, Blobs, blob, unchanged

BEGINS = 40


def only(scan: Blobs) -> list[Flag]:
    return scan.flags([FloaterCheck()])


def crossing(speed: float, depth: float = 0.05, row: float = 12.0, size: float = 0.75) -> Any:
    """A crumb that enters at the left edge in view BEGINS, blocks a view."""

    def change(view: int, image: NDArray[np.float64]) -> NDArray[np.float64]:
        return image + blob(row, speed * (view - BEGINS), size, depth) if view >= BEGINS - 5 else image

    return change


def raised(scan: Blobs) -> list[tuple[int, Flag]]:
    """The flags, each with the view at which it was raised."""
    monitor, found = watch.start(ScanContext(65535, 32 * COLS * BLOCK**2, 0.1), [FloaterCheck()]), []
    for frame, digest in scan.frames():
        monitor, flags = watch.look(monitor, frame, digest)
        found += [(frame.index - 10, flag) for flag in flags]
    return found


def least_views(speed: float) -> float:
    """Five steps in which it moves by SLOWEST, and the neighbour after the last; it needs 2 blocks to enter."""
    views = 2 ** max(0, math.ceil(math.log2(SLOWEST / speed)))
    return 7 * views + 2 / speed


@pytest.mark.parametrize("speed", [0.6, 1.0, 2.0, 4.0])
def test_a_faint_crumb_that_crosses_is_found_in_a_few_steps_and_where_it_is(speed: float) -> None:
    flags = raised(Blobs(90, depth=crossing(speed)))
    assert flags
    assert flags[0][0] - BEGINS <= least_views(speed)
    assert flags[0][1].first is not None and flags[0][1].first >= 10 + BEGINS - 6
    for _, flag in flags:
        assert flag.level is Level.WARN and flag.score > flag.limit
        for frame, (top, below, left, right) in flag.regions().items():
            assert top <= 12.5 * BLOCK < below
            col = speed * (frame - 10 - BEGINS) + 0.5
            assert left <= max(0.0, col + 1) * BLOCK and (col - 1) * BLOCK <= right
    assert "Find the particle and blow it off" in flags[0][1].advice


@pytest.mark.parametrize("sign", [-1, 1])
def test_its_speed_direction_and_rows_are_said(sign: int) -> None:
    def change(view: int, image: NDArray[np.float64]) -> NDArray[np.float64]:
        col = 64 + sign * (2.0 * (view - BEGINS) - 64)
        return image + blob(20, col, 0.75, 0.05)

    flag = only(Blobs(110, depth=change))[-1]
    speed = float(re.search(r"([0-9.]+) px per projection to the", flag.advice).group(1))  # type: ignore[union-attr]
    assert speed == pytest.approx(2.0 * BLOCK, rel=0.05)
    assert ("right" if sign > 0 else "left") in flag.advice
    rows = re.search(r"rows (\d+) \.\.\. (\d+),", flag.advice)
    assert rows is not None and 18 * BLOCK <= int(rows[1]) <= 20 * BLOCK <= int(rows[2]) < 23 * BLOCK


@pytest.mark.parametrize("away", [1.5, 2.2])
def test_a_crumb_on_the_holder_is_found_from_one_and_a_half_half_fields_on(away: float) -> None:
    """It turns with the stage: 1.1 to 3 times as fast as the rim of the sample."""
    radius = away * COLS / 2
    scan = Blobs(
        500, depth=lambda view, image: image + blob(12, 63.5 + radius * np.sin((view - 200) * STEP), 1.0, 0.05)
    )
    flags = only(scan)
    assert flags
    for flag in flags:
        for frame, (_, _, left, right) in flag.regions().items():
            col = 63.5 + radius * np.sin((frame - 210) * STEP)
            assert left - 3 * BLOCK <= col * BLOCK <= right + 3 * BLOCK


def test_it_is_flagged_in_most_of_the_views_that_show_it() -> None:
    flags = only(Blobs(120, depth=crossing(2.0)))
    marked = {row for flag in flags for row in range(flag.first or flag.frame, flag.frame + 1)}
    shown = range(10 + BEGINS + 2, 10 + BEGINS + COLS // 2)
    assert len(marked.intersection(shown)) > 0.9 * len(shown)


@pytest.mark.parametrize(
    "change",
    [
        unchanged,
        lambda view, image: image + blob(12, 63.5 + 60 * np.cos(view * STEP - 1.5), 0.75, 0.5),  # turns at the rim
        lambda view, image: image + 0.3 * (np.arange(COLS) == 50),  # a ring
        lambda view, image: image + 0.03 * (view % 2),  # the beam flickers
        lambda view, image: image + blob(12, 3.0 * (view - BEGINS), 0.75, 0.3 * (view % 3 == 0)),  # chance texture
        lambda view, image: Blobs().line_integrals(view, (0.0, 1.0)) if view >= 50 else image,
    ],
    ids=["nothing", "rim", "ring", "flicker", "texture", "jump"],
)
def test_what_stays_or_turns_is_none(change: Any) -> None:
    assert only(Blobs(90, depth=change)) == []


def test_zingers_and_what_is_seen_at_uneven_angles_are_none() -> None:
    rng = np.random.default_rng(8)

    def zingers(view: int, light: NDArray[np.float64]) -> NDArray[np.float64]:
        rows, cols = rng.integers(0, 32, 2), rng.integers(0, COLS, 2)
        light[rows, cols] += rng.exponential(5_000, 2)
        return light

    assert only(Blobs(120, counts=zingers)) == []
    assert only(Blobs(60, depth=crossing(2.0), step=float(np.radians(77)))) == []
