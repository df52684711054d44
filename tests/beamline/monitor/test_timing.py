"""Frames that come early or late, and triggers without a frame, are flagged; pauses that belong to the plan are not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from beamline.monitor.check import Flag, Level
from beamline.monitor.checks import bitmask

PERIOD = 0.1  # of the fake scan


def only(flags: list[Flag]) -> list[Flag]:
    return [f for f in flags if f.check == "timing"]


@pytest.mark.parametrize(("shift", "views"), [(0.2, []), (-0.2, []), (0.3, [4, 5]), (-0.3, [4, 5])])
def test_a_frame_off_its_time(fake: Any, shift: float, views: list[int]) -> None:
    frames = fake.views(8)
    frames[4] = replace(frames[4], time=frames[4].time + shift * PERIOD)
    flags = only(fake.flags(frames))
    assert [f.frame for f in flags] == views
    if flags:
        assert flags[0].score == pytest.approx(shift)
        assert flags[0].level is Level.WARN


def test_a_missing_trigger_is_told_and_is_no_fault_of_the_frame_after_it(fake: Any) -> None:
    frames = fake.views(8)
    del frames[3:5]
    flags = only(fake.flags(frames))
    assert [(f.frame, f.score, f.level) for f in flags] == [(5, 2, Level.INFO)]
    assert bitmask(flags) == 0  # a reconstruction uses it: before, it left the good view out, too


def test_a_step_scan_has_no_rhythm(fake: Any) -> None:
    frames = [replace(f, time=f.time + f.trigger**2) for f in fake.views(8)]
    assert only(fake.flags(frames, period=None)) == []


@pytest.mark.parametrize(("armed_anew", "found"), [(False, 1), (True, 0)])
def test_a_wait_before_the_camera_was_armed_anew_is_no_finding(fake: Any, armed_anew: bool, found: int) -> None:
    """As between two passes, or after a pause: the camera counts from 0 again."""
    frames = [replace(f, time=f.time + 30 * (f.trigger >= 4)) for f in fake.views(8)]
    if armed_anew:
        frames[4:] = [replace(f, framestamp=f.trigger - 4) for f in frames[4:]]
    assert len(only(fake.flags(frames))) == found


def test_triggers_whose_views_are_stored_are_not_missing(fake: Any) -> None:
    frames = fake.views(8)
    del frames[3:5]
    assert only(fake.flags(frames, stored=frozenset({3, 4}))) == []
    assert [f.score for f in only(fake.flags(frames, stored=frozenset({4, 6})))] == [1]
