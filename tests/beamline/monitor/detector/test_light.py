"""An intensity step is flagged in its projection with its size; zingers are counted; nothing else is reported."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from beamline.monitor.check import Flag, Level
from beamline.monitor.detector.light import VIEWS, GainCheck, ZingersCheck
from beamline.monitor.digest import digest
from beamline.monitor.view import Spots, spots_of
from drivers.base.frame import Frame
from tests.beamline.monitor.blobs import COLS, Blobs, Change


def of_gain(scan: Blobs) -> list[Flag]:
    return scan.flags([GainCheck()])


@pytest.mark.parametrize(("share", "level"), [(0.02, Level.WARN), (-0.02, Level.WARN), (0.3, Level.ALARM)])
def test_a_step_is_flagged_once_with_its_size(share: float, level: Level) -> None:
    flags = of_gain(Blobs(60, counts=lambda view, light: light * (1 + share * (view >= 30))))
    assert [(flag.frame, flag.level) for flag in flags] == [(40, level)]
    assert flags[0].score == pytest.approx(share, rel=0.05)


def drift_and_half_a_percent(view: int, light: np.ndarray) -> np.ndarray:
    return light * np.exp(-view / 500) * (1 + 0.005 * (view >= 40))


def fog(view: int, light: np.ndarray) -> np.ndarray:
    return light * (1 + 0.3 * np.exp(-0.5 * ((np.arange(COLS) - 128 + 8 * (view - 40)) / 20) ** 2))


@pytest.mark.parametrize("counts", [drift_and_half_a_percent, fog])
def test_other_changes_of_the_light_are_no_step(counts: Change) -> None:
    assert of_gain(Blobs(80, counts=counts)) == []


SATURATION, BIN = 65535, 4


def spots(frame: Frame, before: Frame) -> Spots:
    return spots_of(frame, digest(frame.counts, SATURATION, BIN), digest(before.counts, SATURATION, BIN), None, 65535)


def struck(frame: Frame, n: int, charge: int, rng: np.random.Generator) -> None:
    """Adds n spots of one pixel, in preview blocks of their own."""
    rows, cols = frame.counts.shape[0] // BIN, frame.counts.shape[1] // BIN
    for at in rng.choice(rows * cols, n, replace=False):
        row, col = BIN * (at // cols) + rng.integers(BIN), BIN * (at % cols) + rng.integers(BIN)
        frame.counts[row, col] = min(int(frame.counts[row, col]) + charge, SATURATION)


@pytest.mark.parametrize("n", [0, 1, 7, 40])
@pytest.mark.parametrize("charge", [20_000, 60_000])
def test_every_spot_is_counted_with_its_saturated_pixels(
    fake: Any, n: int, charge: int, rng: np.random.Generator
) -> None:
    before, frame = fake.views(2)
    struck(frame, n, charge, rng)
    saturated = int((frame.counts == SATURATION).sum())
    assert spots(frame, before) == Spots(n, saturated)


def only(fake: Any, frames: Sequence[Frame]) -> list[Flag]:
    return [flag for flag in fake.flags(frames) if flag.check in ("zingers", "saturation")]


def test_they_are_said_once_and_warned_of_where_there_are_many_and_never_saturation(
    fake: Any, rng: np.random.Generator
) -> None:
    limit = ZingersCheck().warn * 64 * 96  # less than one
    frames = fake.references() + fake.views(VIEWS + 3)
    struck(frames[-2], 30, 60_000, rng)
    flags = only(fake, frames)
    assert [(flag.check, flag.level, flag.frame) for flag in flags] == [("zingers", Level.WARN, len(frames) - 2)]
    assert flags[0].score == pytest.approx(30 / (64 * 96)) and limit < 1


def test_a_few_are_a_fact(fake: Any, rng: np.random.Generator) -> None:
    frames = fake.references() + fake.views(VIEWS + 5)
    struck(frames[14], 2, 20_000, rng)
    struck(frames[19], 3, 20_000, rng)
    flags = fake.flags(frames, checks=[ZingersCheck(warn=1.0)])
    assert [(flag.level, flag.frame) for flag in flags] == [(Level.INFO, 9 + VIEWS)]
    assert flags[0].score == pytest.approx(5 / VIEWS / (64 * 96)) and "5 zingers" in flags[0].advice
