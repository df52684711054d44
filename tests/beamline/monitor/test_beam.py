"""Intensity in air is compared with the flats and with earlier projections; a drift is reported once."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

from beamline.monitor.beam import PATIENCE, BeamCheck
from beamline.monitor.change import SampleChange
from beamline.monitor.check import Flag, Level, ScanContext
from beamline.monitor.digest import digest as frame_digest
from beamline.monitor.view import grid_of, view_of
from drivers.base.frame import Frame, FrameKind
from tests.beamline.monitor.blobs import STEP, Blobs


def only(flags: list[Flag]) -> list[Flag]:
    return [f for f in flags if f.check == "beam"]


def drifting(light: Any, views: int = 120, **more: Any) -> list[Flag]:
    return Blobs(views, counts=lambda view, image: image * light(view), **more).flags([BeamCheck()])


@pytest.mark.parametrize("rate", [-5e-4, 5e-4])
def test_a_drift_against_the_flats_is_said_when_it_reaches_the_limit_and_twice_the_limit(rate: float) -> None:
    flags = drifting(lambda view: 1 + rate * view)
    assert [(f.level, f.limit) for f in flags] == [(Level.WARN, 0.02), (Level.INFO, 0.02)]
    assert abs(flags[1].score) > 2 * abs(flags[0].score)
    assert flags[0].frame - 10 == pytest.approx(0.02 / abs(rate), abs=10)
    assert flags[0].score == pytest.approx(-rate * (flags[0].frame - 10), abs=0.003)
    assert f"{'darker' if rate < 0 else 'brighter'} than in the flats" in flags[0].advice


def test_a_drift_that_went_and_comes_again_is_said_again() -> None:
    flags = drifting(lambda view: 1 - 0.03 * abs(np.sin(view * np.pi / 60)))
    assert [f.level for f in flags] == [Level.WARN] * 2


def test_a_dip_is_an_alarm_in_each_of_its_views_and_not_after_it() -> None:
    flags = drifting(lambda view: 0.8 if 40 <= view < 47 else 1.0)
    assert [(f.frame - 10, f.level) for f in flags] == [(view, Level.ALARM) for view in range(40, 47)]
    assert flags[0].score == pytest.approx(0.2, abs=0.01)


def test_a_dip_that_stays_becomes_normal() -> None:
    flags = drifting(lambda view: 1.0 if view < 40 else 0.8)
    assert [f.frame - 10 for f in flags if f.level is Level.ALARM] == list(range(40, 40 + PATIENCE))
    assert [f.level for f in flags if f.frame > 50 + PATIENCE] in ([], [Level.INFO])


def test_a_sample_that_covers_all_is_said_once_and_dips_are_still_seen() -> None:
    flags = drifting(lambda view: 1.0 if view < 60 else 0.8, 70, depth=lambda view, image: image + 0.5)
    assert [(f.level, f.frame - 10) for f in flags] == [(Level.INFO, 0)] + [(Level.ALARM, i) for i in range(60, 70)]
    assert "covers the whole frame" in flags[0].advice


def test_a_sample_that_covers_the_edges_does_not_hide_air_above_it() -> None:
    tall = np.zeros((32, 1))
    tall[16:] = 0.5
    flags = drifting(lambda view: 1 - 5e-4 * view, depth=lambda view, image: image * (tall > 0) + tall)
    assert [f.level for f in flags] == [Level.WARN, Level.INFO]


def test_flats_are_compared_with_the_flats_before(fake: Any) -> None:
    flags = only(fake.flags(fake.references() + fake.views(10) + fake.flats(2, light=0.9)))
    assert [f.frame for f in flags] == [20]  # the second of the new group is like the first
    assert flags[0].score == pytest.approx(0.1, abs=0.01)


def test_without_flats_dips_are_seen(fake: Any) -> None:
    flags = only(fake.flags(fake.darks() + fake.views(20) + fake.views(1, first=20, light=0.8)))
    assert [f.frame for f in flags] == [25]


def told(gains: Iterable[float], light: Iterable[float]) -> list[int]:
    """Views with a dip, where the fit says these gains and the image has this light."""
    flat = np.full((8, 16), 1000.0, np.float32)
    grid, check, rows = grid_of(flat.shape, 4, 0 * flat, flat), BeamCheck(), list[int]()
    state, digest = check.start(), frame_digest(np.ones((32, 64), np.uint16), 65535, 4)
    for row, (gain, left) in enumerate(zip(gains, light, strict=True)):
        view = view_of(flat * np.float32(0.5 * left), grid, row, row * STEP, 1.0)
        change = SampleChange(gain, 0.0, 0.0, 0.0, 0 * flat, 0.01) if row else None
        frame = Frame(np.ones((32, 64), np.uint16), FrameKind.PROJECTION, row, row, row, row * STEP, row, 0.05)
        seen = check.look(state, frame, digest, ScanContext(65535, 2048, grid=grid, view=view, change=change))
        state, rows = seen.state, rows + ([row] if seen.flag and seen.flag.level is Level.ALARM else [])
    return rows


def test_errors_of_one_sign_are_no_dip_while_the_light_of_the_views_is_level() -> None:
    rng = np.random.default_rng(7)
    assert told(np.full(200, -0.007), 1 + 0.0005 * rng.normal(size=200)) == []


@pytest.mark.parametrize("depth", [0.11, 0.2])
@pytest.mark.parametrize("lasts", [3, 10, PATIENCE])
def test_among_such_errors_a_dip_is_told_in_each_of_its_views(depth: float, lasts: int) -> None:
    light = np.where((np.arange(100) >= 40) & (np.arange(100) < 40 + lasts), 1 - depth, 1.0)
    gains = np.expm1(np.diff(np.log(light), prepend=0.0)) - 0.007
    assert told(gains, light) == list(range(40, 40 + lasts))
