"""What the beam does not reach is said with the flats; a sample that goes on beyond the field, in the first views."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from beamline.monitor.check import Flag, Level
from beamline.monitor.field import FieldOfViewCheck
from drivers.base.frame import FrameKind
from tests.beamline.monitor.blobs import BLOCK, COLS, ROWS, Blobs
from tests.beamline.monitor.conftest import COLS as FAKE_COLS
from tests.beamline.monitor.conftest import ROWS as FAKE_ROWS


def only(scan: Blobs) -> list[Flag]:
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


def test_of_many_shadows_four_are_named(fake: Any) -> None:
    light = fake.expected(None)
    for first in range(0, FAKE_COLS, 16):
        light[:, first : first + 4] = 0
    flats = [fake.frame(FrameKind.FLAT, light) for _ in range(5)]
    (flag,) = fake.flags([*fake.darks(), *flats], checks=[FieldOfViewCheck()])
    assert "columns 48 ... 51, and 2 more" in flag.advice


def test_a_profile_and_a_line_in_the_shadow_of_a_slit_are_no_shadow(fake: Any) -> None:
    light = fake.expected(None) * np.linspace(0.3, 1.0, FAKE_COLS)
    light[0] = 0
    flats = [fake.frame(FrameKind.FLAT, light) for _ in range(5)]
    assert fake.flags([*fake.darks(), *flats], checks=[FieldOfViewCheck()]) == []


@pytest.mark.parametrize(("first", "sides"), [(0, "left"), (COLS - 8, "right")])
def test_a_sample_beyond_the_field_is_a_fact_about_the_scan(first: int, sides: str) -> None:
    wide = np.zeros((ROWS, COLS))
    wide[:, first : first + 8] = 0.4
    (flag,) = only(Blobs(30, depth=lambda view, image: image + wide))
    assert flag.level is Level.INFO and flag.score == pytest.approx(0.4, abs=0.1) and sides in flag.advice
    assert flag.region is not None and abs(flag.region[2] - first * BLOCK) < 8 * BLOCK
    assert "beside the rotation axis" not in flag.advice
    (flag,) = only(Blobs(30, depth=lambda view, image: image + wide * (view > 12)))
    assert "beside the rotation axis" in flag.advice and sides in flag.advice


def test_a_sample_within_the_field_and_a_beam_that_drifts_by_5_percent_are_none() -> None:
    assert only(Blobs(30, counts=lambda view, light: 0.95 * light)) == []
