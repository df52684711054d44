"""A band: only some rows lose intensity. A beam that dims all rows, or a rotating sample, is not a band."""

from collections.abc import Callable
from typing import Any

import pytest

from beamline.monitor.check import Flag, Level
from drivers.base.frame import Frame


def only(flags: list[Flag]) -> list[Flag]:
    return [f for f in flags if f.check == "bands"]


def black(frame: Frame, first: int, n: int) -> Frame:
    frame.counts[first : first + n] = 200
    return frame


@pytest.mark.parametrize(("n", "loss"), [(1, 0.25), (2, 0.5), (4, 1.0), (16, 1.0)])
def test_black_rows_are_flagged_with_their_place(fake: Any, n: int, loss: float) -> None:
    frames = fake.references() + fake.views(10)
    black(frames[18], 20, n)
    flags = only(fake.flags(frames))
    assert [(f.frame, f.level) for f in flags] == [(18, Level.ALARM)]
    assert flags[0].score == pytest.approx(loss, abs=0.02)
    assert flags[0].region == (20, 20 + max(n, 4), 0, 96)


def test_a_band_that_stays_is_flagged_until_it_is_old_news(fake: Any) -> None:
    frames = fake.references() + fake.views(40)
    for view in frames[20:]:
        black(view, 8, 4)
    flags = only(fake.flags(frames))
    assert [f.frame for f in flags] == list(range(20, 40))


@pytest.mark.parametrize("band", [False, True])
def test_a_sample_with_an_upper_and_a_lower_edge_is_no_band(fake: Any, band: bool) -> None:
    """Half of the rows get a fifth of the light, always: the rows of a frame are compared with their own past."""
    frames = fake.references() + fake.views(20)
    for view in frames[10:]:
        view.counts[32:] = 200 + (view.counts[32:].clip(200) - 200) // 5
    if band:
        black(frames[25], 40, 4)
    assert [f.frame for f in only(fake.flags(frames))] == [25] * band


@pytest.mark.parametrize("first", [0, 17, 92])
def test_black_columns_are_flagged_as_long_as_they_last_with_their_place(fake: Any, first: int) -> None:
    frames = fake.references() + fake.views(30)
    for view in frames[25:32]:
        view.counts[:, first : first + 2] = 200
    flags = only(fake.flags(frames))
    assert [f.frame for f in flags] == list(range(25, 32))
    assert all(f.region is not None and f.region[2] <= first < f.region[3] <= first + 8 for f in flags)
    assert "columns" in flags[0].advice


def test_a_bright_band_is_one_too(fake: Any) -> None:
    frames = fake.references() + fake.views(20)
    frames[25].counts[12:16] *= 2
    flags = only(fake.flags(frames))
    assert [f.frame for f in flags] == [25]
    assert flags[0].score < 0


def dimming(fake: Any) -> list[Frame]:
    return fake.references() + fake.views(10) + fake.views(10, first=10, light=0.5)


def jumping_angles(fake: Any) -> list[Frame]:
    return sum((fake.views(1, first=i * 137 % 180) for i in range(20)), fake.references())


def zingers_in_a_column(fake: Any) -> list[Frame]:
    views = fake.views(30)
    for i, view in enumerate(views[10:]):
        view.counts[[i % 64, i % 50 + 7], 30 + i] = 60000
    return fake.references() + views


def an_edge_that_passes(fake: Any) -> list[Frame]:
    views = fake.views(40, discs=())
    for i, view in enumerate(views):
        view.counts[:, 90 - 2 * i :] = 200 + (view.counts[:, 90 - 2 * i :].clip(200) - 200) // 3
    return fake.references() + views


@pytest.mark.parametrize("frames", [dimming, jumping_angles, zingers_in_a_column, an_edge_that_passes])
def test_other_changes_are_no_band(fake: Any, frames: Callable[[Any], list[Frame]]) -> None:
    assert only(fake.flags(frames(fake), period=None)) == []
