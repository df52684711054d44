"""A pixel that is dark in every flat is dead; shadows, noise and what is dark in one flat only are not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from beamline.monitor.check import Flag, Level
from beamline.monitor.pixels import PixelsCheck
from drivers.base.frame import Frame


def only(fake: Any, frames: list[Frame]) -> list[Flag]:
    return fake.flags(frames, checks=[PixelsCheck()])  # type: ignore[no-any-return]


def scan(fake: Any, dead: list[tuple[int, int]], flats: int = 5) -> list[Frame]:
    frames: list[Frame] = fake.darks() + fake.flats(flats) + fake.views(5)
    for frame in frames:
        for place in dead:
            frame.counts[place] = 0
    return frames


@pytest.mark.parametrize("flats", [1, 5])
def test_a_few_dead_pixels_are_a_fact_that_is_said_once_with_their_places(fake: Any, flats: int) -> None:
    (flag,) = only(fake, scan(fake, [(0, 0), (33, 95)], flats))
    assert (flag.level, flag.frame, flag.region) == (Level.INFO, 5 + flats, (0, 34, 0, 96))
    assert flag.score == pytest.approx(2 / (64 * 96))
    assert "some: 2, at (row, column) (0, 0), (33, 95)." in flag.advice


def test_many_are_a_warning(fake: Any) -> None:
    (flag,) = only(fake, scan(fake, [(row, 8 * row % 96) for row in range(20)]))
    assert flag.level is Level.WARN and flag.score > flag.limit


def test_what_is_dark_in_one_flat_only_and_the_shadow_of_a_slit_are_none(fake: Any) -> None:
    frames = scan(fake, [])
    frames[6].counts[20, 20] = 0
    for frame in frames[5:]:
        frame.counts[:18] = np.minimum(frame.counts[:18], 205)  # its edge is within a block
    assert only(fake, frames) == []


def with_hole(frame: Frame, value: float, cols: slice) -> Frame:
    counts = frame.counts.astype(np.float32)
    counts[:, cols] = value
    return replace(frame, counts=counts)  # type: ignore[arg-type]  # a file may hold such


def test_views_with_pixels_that_hold_no_number_are_flagged_unless_the_darks_have_them_too(fake: Any) -> None:
    frames = fake.references() + fake.views(6)
    frames[12] = with_hole(frames[12], np.nan, slice(None))
    frames[14] = with_hole(frames[14], np.inf, slice(3, 4))
    assert [(f.frame, f.level, f.score) for f in only(fake, frames)] == [
        (12, Level.ALARM, 1.0),
        (14, Level.WARN, pytest.approx(1 / 96)),
    ]
    masked = [with_hole(frame, np.nan, slice(3, 4)) for frame in fake.references() + fake.views(3)]
    assert only(fake, masked) == []
