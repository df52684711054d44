"""The beam check reads the light at the edges against the flats, and does not mistake the sample for a lost beam."""

from __future__ import annotations

from typing import Any

import pytest

from beamline.monitor.beam import Beam
from beamline.monitor.check import Flag, Level

WIDE = ((0.0, 0.0, 80.0, 0.004),)  # a disc wider than the detector: no air anywhere


def only(flags: list[Flag]) -> list[Flag]:
    return [f for f in flags if f.check == "beam"]


@pytest.mark.parametrize(
    ("light", "level", "limit", "word"),
    [
        (0.95, Level.WARN, 0.02, "less light"),
        (1.05, Level.WARN, 0.02, "more light"),
        (0.80, Level.ALARM, 0.10, "ring current"),
        (0.20, Level.ALARM, 0.50, "beam is lost"),
        (0.0, Level.ALARM, 0.50, "beam is lost"),
    ],
)
def test_a_changed_beam_is_flagged_with_its_size(
    fake: Any, light: float, level: Level, limit: float, word: str
) -> None:
    frames = fake.references() + fake.views(10) + fake.views(4, first=10, light=light)
    flags = only(fake.flags(frames))
    assert [f.view for f in flags] == [20, 21, 22, 23]
    for flag in flags:
        assert flag.level is level
        assert flag.limit == limit
        assert flag.score == pytest.approx(1 - light, abs=0.01)
        assert word in flag.advice


@pytest.mark.parametrize("light", [0.99, 1.01])
def test_a_percent_is_no_finding(fake: Any, light: float) -> None:
    assert only(fake.flags(fake.references() + fake.views(10) + fake.views(10, first=10, light=light))) == []


def test_a_beam_lost_before_the_first_view(fake: Any) -> None:
    flags = only(fake.flags(fake.references() + fake.views(3, light=0.0)))
    assert [f.level for f in flags] == [Level.ALARM] * 3


def test_a_beam_that_fell_before_the_first_view_is_noted_and_then_compared_with_itself(fake: Any) -> None:
    frames = fake.references() + fake.views(12, light=0.7) + fake.views(2, first=12, light=0.5)
    flags = only(fake.flags(frames))
    assert [(f.view, f.level) for f in flags] == [(10, Level.WARN), (22, Level.ALARM), (23, Level.ALARM)]
    assert "70% of the flats" in flags[0].advice
    assert flags[1].score == pytest.approx(1 - 0.5 / 0.7, abs=0.01)


def test_a_sample_that_covers_both_edges_is_said_once_and_the_beam_still_watched(fake: Any) -> None:
    frames = fake.references() + fake.views(20, discs=WIDE) + fake.views(1, first=20, light=0.85, discs=WIDE)
    flags = only(fake.flags(frames))
    assert [f.view for f in flags] == [10, 30]
    assert "covers both edges" in flags[0].advice
    assert flags[1].level is Level.ALARM


def test_flats_are_compared_with_the_flats_before(fake: Any) -> None:
    flags = only(fake.flags(fake.references() + fake.views(10) + fake.flats(2, light=0.9)))
    assert [f.view for f in flags] == [20]  # the second of the new group is like the first
    assert flags[0].score == pytest.approx(0.1, abs=0.01)


def test_without_flats_the_first_views_are_the_reference(fake: Any) -> None:
    flags = only(fake.flags(fake.darks() + fake.views(10) + fake.views(1, first=10, light=0.8)))
    assert [f.view for f in flags] == [15]


def test_limits_can_be_set(fake: Any) -> None:
    frames = fake.references() + fake.views(10) + fake.views(1, first=10, light=0.95)
    assert only(fake.flags(frames, checks=[Beam(warn=0.08)])) == []
