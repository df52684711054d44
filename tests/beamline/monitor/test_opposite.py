"""Opposite and repeated projections reveal the axis, shifts and changes of the sample."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.monitor.check import Flag, Level
from beamline.monitor.digest import FrameDigest
from beamline.monitor.opposite import OppositeCheck
from beamline.plan.plan import interlaced
from drivers.base.frame import Frame, FrameKind
from tests.beamline.monitor.blobs import BLOCK, COLS, Blobs
from tests.slow_cases import others_slow

STEP = np.radians(2)
MIDDLE = (COLS * BLOCK - 1) / 2
Place = Callable[[int], tuple[float, float]]
"""Pixels (down, across) by which the sample is shifted in a view."""


class Moved(Blobs):
    """The sample shifted, and larger by a factor about the axis, from view to view."""

    def __init__(self, views: int, place: Place = lambda view: (0, 0), size: Callable[[int], float] = lambda view: 1):
        self.place, self.size = place, size
        super().__init__(views, step=STEP)

    def line_integrals(self, view: int, shift: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float64]:
        radius, phase = self.at
        self.at = radius * self.size(view), phase
        down, across = self.place(view)
        found = super().line_integrals(view, (down / BLOCK, across / BLOCK))
        self.at = radius, phase
        return found


def only(scan: Blobs, **known: object) -> list[Flag]:
    return scan.flags([OppositeCheck()], **known)


@pytest.mark.slow
@pytest.mark.parametrize("axis", [6.8])
def test_the_axis_of_a_sample_that_only_turns_is_found_and_said_where_it_is_stated_elsewhere(axis: float) -> None:
    scan = Moved(100, lambda view: (0, axis))
    assert only(scan) == []
    assert only(Moved(100, lambda view: (0, axis)), axis_col=MIDDLE + axis + 0.5) == []
    (flag,) = only(Moved(100, lambda view: (0, axis)), axis_col=MIDDLE + axis - 5)
    assert (flag.level, flag.frame) == (Level.INFO, 10 + 90)
    assert flag.score == pytest.approx(5, abs=0.1)


def test_a_sample_that_sank_is_flagged_by_its_view_from_the_other_side() -> None:
    flags = only(Moved(96, lambda view: (1.2 * (view > 50), 0)))
    assert [flag.frame for flag in flags] == [100, 103]  # 5 degrees are between the views that are kept
    assert all(flag.level is Level.WARN for flag in flags)
    assert [flag.score for flag in flags] == pytest.approx([1.2, 1.2], abs=0.15)
    assert "px vertically" in flags[0].advice


def test_a_shift_across_shows_between_two_pairs() -> None:
    flags = only(Moved(110, lambda view: (0, 2.0 * (view >= 100))))
    assert flags and flags[0].frame == 10 + 102
    assert flags[0].score == pytest.approx(2, abs=0.2)


def test_a_sample_that_shrank_is_flagged() -> None:
    flags = only(Moved(96, size=lambda view: 1 - 0.03 * (view > 50)))
    assert {flag.frame for flag in flags} == {100, 103}
    assert "shrank" in flags[0].advice


def test_a_view_taken_again_shows_a_shift() -> None:
    scan = Moved(190, lambda view: (0, 1.5 * (view > 150)))
    flags = [flag for flag in only(scan) if flag.frame >= 190]
    assert flags and "at the same angle" in flags[0].advice and flags[0].frame == 10 + 180
    assert flags[0].score == pytest.approx(1.5, abs=0.2)


def test_a_steady_scan_of_a_turn_and_more_raises_no_flag() -> None:
    assert only(Moved(200, lambda view: (0, 6.8))) == []


def test_in_a_cone_it_stands_aside_and_says_so_once() -> None:
    (flag,) = only(Moved(100), cone=True)
    assert (flag.level, flag.frame) == (Level.INFO, 10) and "cone" in flag.advice


class Wide(Moved):
    """A sample twice as wide as the field, at these angles."""

    def __init__(self, turns: NDArray[np.float64], place: Place) -> None:
        super().__init__(len(turns), place)
        self.step, self.turns = 1.0, turns
        radius, phase = self.at
        self.at = 2 * radius, phase

    def line_integrals(self, view: int, shift: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float64]:
        radius, phase = self.at
        self.at = radius, phase + self.turns[view] - view
        found = super().line_integrals(view, shift)
        self.at = radius, phase
        return found

    def _frame(
        self, kind: FrameKind, row: int, light: NDArray[np.float64], angle: float = np.nan
    ) -> tuple[Frame, FrameDigest]:
        return super()._frame(kind, row, light, angle if np.isnan(angle) else float(self.turns[int(angle)]))


@pytest.mark.slow
def test_a_wide_sample_in_passes_raises_no_flag_while_its_neighbours_are_far_and_shows_a_shift_later() -> None:
    """From one view of the first pass to the next, 4.5 degrees on, the field shows other matter."""
    flags = only(Wide(interlaced(320, 8)[:200], lambda view: (6.0 * (view >= 170), 0)))
    assert flags and min(flag.frame for flag in flags) >= 10 + 170
    assert [flag.score for flag in flags] == pytest.approx([6] * len(flags), abs=0.5)


@pytest.mark.parametrize("jump", others_slow([0, 6]))
def test_a_far_step_still_shows_a_jump_that_is_larger_than_what_it_may_miss(jump: int) -> None:
    """Half a turn in one pass: the first view is compared with the last one, a step before it on the other side."""
    flags = only(Wide(np.arange(200) * np.pi / 200, lambda view: (jump * (view >= 100), 0)))
    assert [round(flag.score) for flag in flags] == [jump] * bool(jump)
