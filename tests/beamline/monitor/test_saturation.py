"""Saturated pixels are flagged by their fraction; hot ones and a single cosmic ray are not."""

from __future__ import annotations

from typing import Any

import pytest

from beamline.monitor.check import Flag, Level
from drivers.frame import Frame

SATURATION, PIXELS = 65535, 64 * 96


def burn(frames: list[Frame], n: int) -> list[Frame]:
    for frame in frames:
        frame.counts.ravel()[:n] = SATURATION
    return frames


def only(flags: list[Flag]) -> list[Flag]:
    return [f for f in flags if f.check == "saturation"]


@pytest.mark.parametrize(("n", "level"), [(3, Level.WARN), (6, Level.WARN), (7, Level.ALARM), (3000, Level.ALARM)])
def test_saturated_pixels_are_flagged(bench: Any, n: int, level: Level) -> None:
    flags = only(bench.watch(bench.references() + burn(bench.views(1), n)))
    assert len(flags) == 1
    assert flags[0].level is level
    assert flags[0].score == pytest.approx(n / PIXELS)
    assert "exposure" in flags[0].advice


def test_a_pixel_or_two_are_a_cosmic_ray(bench: Any) -> None:
    assert only(bench.watch(bench.references() + burn(bench.views(2), 2))) == []


def test_pixels_that_are_hot_without_light_do_not_count(bench: Any) -> None:
    frames = burn(bench.darks(), 100) + burn(bench.flats(), 100) + burn(bench.views(2), 100)
    assert only(bench.watch(frames)) == []


def test_saturated_flats_are_flagged(bench: Any) -> None:
    assert len(only(bench.watch(bench.darks() + burn(bench.flats(2), 50)))) == 2
