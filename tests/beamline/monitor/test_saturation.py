"""Saturated pixels are flagged by their fraction; hot ones and a single cosmic ray are not."""

from __future__ import annotations

from typing import Any

import pytest

from beamline.monitor.check import Flag, Level
from drivers.base.frame import Frame

SATURATION, PIXELS = 65535, 64 * 96


def burn(frames: list[Frame], n: int) -> list[Frame]:
    """n pixels at the end of their range, in bright surroundings."""
    for frame in frames:
        frame.counts[:4] = SATURATION - 5000
        frame.counts.ravel()[:n] = SATURATION
    return frames


def only(flags: list[Flag]) -> list[Flag]:
    return [f for f in flags if f.check == "saturation"]


@pytest.mark.parametrize(("n", "level"), [(3, Level.WARN), (6, Level.WARN), (7, Level.ALARM), (3000, Level.ALARM)])
def test_saturated_pixels_are_flagged(fake: Any, n: int, level: Level) -> None:
    flags = only(fake.flags(fake.references() + burn(fake.views(1), n)))
    assert len(flags) == 1
    assert flags[0].level is level
    assert flags[0].score == pytest.approx(n / PIXELS)
    assert "exposure" in flags[0].advice


def test_a_pixel_or_two_are_no_exposure_too_long(fake: Any) -> None:
    assert only(fake.flags(fake.references() + burn(fake.views(2), 2))) == []


def test_zingers_that_saturate_are_no_exposure_too_long(fake: Any) -> None:
    frames = fake.references() + fake.views(3)
    for at in (7, 30, 55, 80):
        frames[-2].counts[20:22, at] = SATURATION
    assert only(fake.flags(frames)) == []


def test_pixels_that_are_hot_without_light_do_not_count(fake: Any) -> None:
    frames = burn(fake.darks(), 100) + burn(fake.flats(), 100) + burn(fake.views(2), 100)
    assert only(fake.flags(frames)) == []


def test_saturated_flats_are_flagged(fake: Any) -> None:
    assert len(only(fake.flags(fake.darks() + burn(fake.flats(2), 50)))) == 2


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_views_after_saturated_ones_are_not_taken_for_dim(fake: Any, share: float) -> None:
    frames = fake.references() + fake.views(24)
    row = len(frames) - 12
    for frame in frames[row : row + 4]:
        frame.counts[: int(share * len(frame.counts))] = SATURATION
    assert {flag.frame for flag in fake.flags(frames) if flag.level is Level.ALARM} == set(range(row, row + 4))
