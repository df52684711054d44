"""Field of view: pixels without beam, a sample wider than the field, and what enters or leaves it."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from beamline.monitor.check import Flag, Level
from beamline.monitor.field import FieldOfViewCheck, PixelsCheck
from drivers.base.frame import Frame, FrameKind
from tests.beamline.monitor.blobs import BLOCK, COLS, ROWS, Blobs
from tests.beamline.monitor.conftest import COLS as FAKE_COLS
from tests.beamline.monitor.conftest import ROWS as FAKE_ROWS
from tests.slow_cases import others_slow


def of_field(scan: Blobs) -> list[Flag]:
    return scan.flags([FieldOfViewCheck()])


@pytest.mark.parametrize(
    ("shadow", "region", "named"),
    [
        ((slice(None), slice(0, 16)), (0, FAKE_ROWS, 0, 16), "columns 0 ... 15"),
        ((slice(None), slice(60, FAKE_COLS)), (0, FAKE_ROWS, 60, FAKE_COLS), "columns 60 ... 95"),
        ((slice(48, FAKE_ROWS), slice(None)), (48, FAKE_ROWS, 0, FAKE_COLS), "rows 48 ... 63"),
    ],
)
def test_a_shadow_in_the_flats_is_said_once_with_its_place(fake: Any, shadow: Any, region: Any, named: str) -> None:
    light = fake.expected(None)
    light[shadow] = 0
    flats = [fake.frame(FrameKind.FLAT, light) for _ in range(5)]
    (flag,) = fake.flags([*fake.darks(), *flats], checks=[FieldOfViewCheck()])
    assert (flag.level, flag.frame, flag.region) == (Level.WARN, flats[0].index, region)
    assert flag.score == pytest.approx(light[light == 0].size / light.size)
    assert named in flag.advice


def test_flats_without_beam_are_said_in_a_sentence_and_not_by_bands(fake: Any) -> None:
    (flag,) = fake.flags([*fake.darks(), *fake.flats(5, light=0.0)], checks=[FieldOfViewCheck()])
    assert (flag.level, flag.score) == (Level.WARN, 1.0)
    assert "shutter" in flag.advice and "rows" not in flag.advice


@pytest.mark.parametrize(("first", "sides"), [(0, "left"), (COLS - 8, "right")])
def test_a_sample_beyond_the_field_is_a_fact_about_the_scan(first: int, sides: str) -> None:
    wide = np.zeros((ROWS, COLS))
    wide[:, first : first + 8] = 0.4
    (flag,) = of_field(Blobs(30, depth=lambda view, image: image + wide))
    assert flag.level is Level.INFO and flag.score == pytest.approx(0.4, abs=0.1) and sides in flag.advice
    assert flag.region is not None and abs(flag.region[2] - first * BLOCK) < 8 * BLOCK
    assert "Centre the sample on the rotation axis" not in flag.advice
    (flag,) = of_field(Blobs(30, depth=lambda view, image: image + wide * (view > 12)))
    assert "Centre the sample on the rotation axis" in flag.advice and sides in flag.advice


def of_pixels(fake: Any, frames: list[Frame]) -> list[Flag]:
    return fake.flags(frames, checks=[PixelsCheck()])


def with_dead_pixels(fake: Any, dead: list[tuple[int, int]], flats: int = 5) -> list[Frame]:
    frames: list[Frame] = fake.darks() + fake.flats(flats) + fake.views(5)
    for frame in frames:
        for place in dead:
            frame.counts[place] = 0
    return frames


@pytest.mark.parametrize("flats", [1, 5])
def test_a_few_dead_pixels_are_a_fact_that_is_said_once_with_their_places(fake: Any, flats: int) -> None:
    (flag,) = of_pixels(fake, with_dead_pixels(fake, [(0, 0), (33, 95)], flats))
    assert (flag.level, flag.frame, flag.region) == (Level.INFO, 5 + flats, (0, 34, 0, 96))
    assert flag.score == pytest.approx(2 / (64 * 96))
    assert "Dead pixels: 2, at (row, column) (0, 0), (33, 95)." in flag.advice


def test_many_are_a_warning(fake: Any) -> None:
    (flag,) = of_pixels(fake, with_dead_pixels(fake, [(row, 8 * row % 96) for row in range(20)]))
    assert flag.level is Level.WARN and flag.score > flag.limit


def test_what_is_dark_in_one_flat_only_and_the_shadow_of_a_slit_are_none(fake: Any) -> None:
    frames = with_dead_pixels(fake, [])
    frames[6].counts[20, 20] = 0
    for frame in frames[5:]:
        frame.counts[:18] = np.minimum(frame.counts[:18], 205)  # its edge is within a block
    assert of_pixels(fake, frames) == []


def with_hole(frame: Frame, value: float, cols: slice) -> Frame:
    counts = frame.counts.astype(np.float32)
    counts[:, cols] = value
    return replace(frame, counts=counts)  # type: ignore[arg-type]  # a file may hold such


def test_views_with_pixels_that_hold_no_number_are_flagged_unless_the_darks_have_them_too(fake: Any) -> None:
    frames = fake.references() + fake.views(6)
    frames[12] = with_hole(frames[12], np.nan, slice(None))
    frames[14] = with_hole(frames[14], np.inf, slice(3, 4))
    assert [(f.frame, f.level, f.score) for f in of_pixels(fake, frames)] == [
        (12, Level.ALARM, 1.0),
        (14, Level.WARN, pytest.approx(1 / 96)),
    ]
    masked = [with_hole(frame, np.nan, slice(3, 4)) for frame in fake.references() + fake.views(3)]
    assert of_pixels(fake, masked) == []


SAMPLE = ((0.0, 0.0, 30.0, 0.02), (10.0, 5.0, 8.0, 0.05), (-12.0, 3.0, 6.0, 0.05))


def total(discs: Sequence[tuple[float, ...]]) -> float:
    """Area of each disc times its attenuation: the integral of the projection, from every side."""
    return sum(np.pi * radius**2 * attenuation for _, _, radius, attenuation in discs)


def test_a_floater_is_flagged_from_its_third_view_with_its_mass(fake: Any) -> None:
    floater = (5.0, -20.0, 5.0, 0.08)
    with_floater = (*SAMPLE, floater)
    frames = fake.references() + fake.views(20) + fake.views(6, first=20, discs=with_floater)
    flags = fake.of("mass", frames)
    assert [f.frame for f in flags] == [32, 33, 34, 35]
    assert flags[0].level is Level.WARN
    assert flags[0].score == pytest.approx(total([floater]) / total(SAMPLE), rel=0.15)
    assert "entered" in flags[0].advice


NO_CHANGE: dict[str, Callable[[Any], list[Frame]]] = {
    "in two views": lambda fake: fake.references() + fake.views(20) + fake.views(2, 20, discs=()) + fake.views(5, 22),
    "3 % of the light": lambda fake: fake.references() + fake.views(20) + fake.views(10, first=20, light=0.97),
    "truncated": lambda fake: fake.references() + fake.views(90, discs=((40.0, 0.0, 30.0, 0.03),)),
    "no flats": lambda fake: fake.darks() + fake.views(20) + fake.views(5, first=20, discs=()),
    "empty": lambda fake: fake.references() + fake.views(100, discs=()),
}


@pytest.mark.parametrize("frames", others_slow(NO_CHANGE.values(), 2), ids=NO_CHANGE)
def test_no_mass_entered_or_left(fake: Any, frames: Callable[[Any], list[Frame]]) -> None:
    assert fake.of("mass", frames(fake)) == []


@pytest.mark.slow
@pytest.mark.parametrize("lost", others_slow([0.09, 0.3], 1))
def test_thin_matter_that_passes_the_edges_is_no_mass_that_left_while_the_beam_weakens(fake: Any, lost: float) -> None:
    beside = (*SAMPLE, (0.0, 41.0, 5.0, 0.006), (0.0, -41.0, 5.0, 0.006))  # in both edges at 90°
    frames = fake.references()
    frames += [fake.views(1, first=i, light=1 - lost * i / 180, discs=beside)[0] for i in range(180)]
    assert fake.of("mass", frames) == []


@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_a_sample_that_falls_off_its_holder_while_the_beam_weakens(fake: Any, lost: float) -> None:
    frames = fake.references()
    frames += [fake.views(1, first=i, light=1 - lost * i / 90)[0] for i in range(90)]
    frames += fake.views(4, first=90, discs=(), light=1 - lost)
    flags = fake.of("mass", frames)
    assert [f.frame for f in flags] == [102, 103] and "left" in flags[0].advice
    assert flags[0].score == pytest.approx(-1, abs=0.05)
