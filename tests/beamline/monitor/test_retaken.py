"""Frames whose neighbour in the file is not their neighbour in angle: no check compares them, true alarms stay."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from beamline.monitor.check import Level
from beamline.monitor.watch import usual_step
from drivers.base.frame import Frame, FrameKind
from tests.beamline.monitor.conftest import STEP
from tests.slow_cases import others_slow

FIRST = 10  # the row of view 0
Discs = tuple[tuple[float, ...], ...]
ROD: Discs = ((0.0, 0.0, 30.0, 0.01), (15.0, 0.0, 3.0, 0.15))
"""A dense rod far from the axis: from other sides other columns are dark."""
NARROW: Discs = ((0.0, 0.0, 30.0, 0.02), (8.0, 5.0, 2.5, 0.2))
EVEN: Discs = ((0.0, 0.0, 30.0, 0.02), *((x, 0.0, 6.0, 0.1) for x in (20.0, 10.0, -20.0, -10.0)))


def black(frame: Frame, first: int = 20, n: int = 4) -> Frame:
    frame.counts[first : first + n] = 200
    return frame


@pytest.mark.parametrize(
    ("discs", "views"),
    others_slow(
        [
            (ROD, [79, 40, 20, 10]),
            (ROD, [2, 3, 4, 5, 6, 7]),
            (EVEN, range(2, 70, 6)),  # at even steps that are none of the scan
            (NARROW, [2, 30, 60]),
        ],
        2,
    ),
)
def test_views_taken_again_raise_no_alarm(fake: Any, discs: Discs, views: Sequence[int]) -> None:
    frames = fake.references() + fake.views(80, discs=discs) + fake.again(views, FIRST, discs=discs)
    found = [flag for flag in fake.flags(frames, step=STEP) if flag.level is not Level.INFO]
    assert [(flag.check, flag.frame) for flag in found if flag.frame >= FIRST + 80] == []


def test_a_second_pass_raises_no_alarm(fake: Any) -> None:
    """Interlaced: each pass begins where the first one began."""
    frames = fake.references()
    for first in range(3):
        for i in range(first, 150, 3):
            frames += fake.views(1, i)
    steps = [frame.angle for frame in frames if frame.kind is FrameKind.PROJECTION]
    found = fake.flags(frames, step=usual_step(np.array(steps)), period=None)
    assert [flag for flag in found if flag.level is not Level.INFO] == []


def test_a_beam_that_is_lost_in_views_taken_again_is_an_alarm(fake: Any) -> None:
    frames = fake.references() + fake.views(60) + fake.again([3, 40], FIRST, light=0.3) + fake.again([20], FIRST)
    found = [flag.frame for flag in fake.flags(frames, step=STEP) if flag.check == "lost"]
    assert found == [FIRST + 60, FIRST + 61]


def test_a_band_in_views_that_follow_one_another_again_is_an_alarm(fake: Any) -> None:
    frames = fake.references() + fake.views(60) + fake.again(range(5, 15), FIRST)
    black(frames[FIRST + 30])
    black(frames[FIRST + 66])
    found = [flag.frame for flag in fake.flags(frames, step=STEP) if flag.check == "bands"]
    assert found == [FIRST + 30, FIRST + 66]
