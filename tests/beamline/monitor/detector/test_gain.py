"""A step of the light is flagged in the view of the step, with its size; a drift, fog and motion are not."""

from __future__ import annotations

import numpy as np
import pytest

from beamline.monitor.check import Flag, Level
from beamline.monitor.detector.gain import GainCheck
from tests.beamline.monitor.blobs import COLS, Blobs


def only(scan: Blobs) -> list[Flag]:
    return scan.flags([GainCheck()])


@pytest.mark.parametrize(("share", "level"), [(0.02, Level.WARN), (-0.02, Level.WARN), (0.3, Level.ALARM)])
def test_a_step_is_flagged_once_with_its_size(share: float, level: Level) -> None:
    flags = only(Blobs(60, counts=lambda view, light: light * (1 + share * (view >= 30))))
    assert [(flag.frame, flag.level) for flag in flags] == [(40, level)]
    assert flags[0].score == pytest.approx(share, rel=0.05)


def test_a_single_dim_view_is_two_steps() -> None:
    flags = only(Blobs(60, counts=lambda view, light: light * (1 - 0.05 * (view == 30))))
    assert [(flag.frame, round(flag.score, 2)) for flag in flags] == [(40, -0.05), (41, 0.05)]


def test_drift_top_up_and_half_a_percent_are_no_step() -> None:
    def light(view: int, image: np.ndarray) -> np.ndarray:
        return image * np.exp(-view / 500) * (1 + 0.005 * (view >= 40))

    assert only(Blobs(80, counts=light)) == []


def test_fog_is_no_step() -> None:
    def fog(view: int, light: np.ndarray) -> np.ndarray:
        return light * (1 + 0.3 * np.exp(-0.5 * ((np.arange(COLS) - 128 + 8 * (view - 40)) / 20) ** 2))

    assert only(Blobs(80, counts=fog)) == []
