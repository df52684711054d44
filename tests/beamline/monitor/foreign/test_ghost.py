"""Ghosts (moving shadows) cross all rows; the sample, a particle or the beam is not mistaken for one."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.monitor.check import Flag, Level
from beamline.monitor.foreign.ghost import GhostCheck, Peak, best_trail
from tests.beamline.monitor.blobs import BLOCK, COLS, Blobs, blob

BEGINS = 50


def only(scan: Blobs) -> list[Flag]:
    return scan.flags([GhostCheck()])


def fog(gain: float, speed: float, half_width: float = 30.0) -> Any:
    """A hump cos² of the light, `half_width` blocks to its foot; its middle is at the right edge in view BEGINS."""

    def change(view: int, light: NDArray[np.float64]) -> NDArray[np.float64]:
        away = (np.arange(COLS) - (COLS - speed * (view - BEGINS))) / half_width
        return light * (1 + gain * np.cos(0.5 * np.pi * np.clip(away, -1, 1)) ** 2)

    return change


def test_a_sample_that_turns_has_none() -> None:
    assert only(Blobs(150)) == []


@pytest.mark.parametrize("gain", [0.02, -0.02])
@pytest.mark.parametrize("speed", [3.0, 10.0])
def test_faint_fog_is_found_within_ten_views(gain: float, speed: float) -> None:
    flags = only(Blobs(100, counts=fog(gain, speed)))
    assert flags
    assert flags[0].frame - 10 - BEGINS <= 10
    assert flags[0].level is Level.WARN
    assert flags[0].score == pytest.approx(abs(gain), rel=0.6)
    assert flags[0].region is not None and flags[0].region[:2] == (0, 32 * BLOCK)


def test_dense_fog_is_an_alarm() -> None:
    assert Level.ALARM in {flag.level for flag in only(Blobs(80, counts=fog(1.5, 8.0)))}


@pytest.mark.parametrize(
    "change",
    [
        lambda view, light: light * (1 + 0.05 * np.sin(0.2 * view)),  # the beam
        lambda view, light: light * (1.0 if view < 60 else 0.95),
        lambda view, light: light * np.exp(-blob(12, 3.0 * (view - 50), 4.0, 0.5)),  # a large crumb
        lambda view, light: (
            light * (1 - 0.02 * np.exp(-0.5 * ((np.arange(COLS) - 60) / 12) ** 2))
        ),  # a flat that does not fit
    ],
    ids=["beam", "step", "crumb", "flat"],
)
def test_other_changes_are_none(change: Any) -> None:
    assert only(Blobs(120, counts=change)) == []


TURN = 0.016  # radians a view: the middle of the sample moves by at most a quarter of a broad column


def line(speed: float, views: range, *, col: float = 10.0, score: float = 6.0) -> list[Peak]:
    return [Peak(view, col + speed * view, score) for view in views]


@pytest.mark.parametrize(
    "peaks",
    [
        line(0.2, range(8)),  # as slow as the sample
        line(0.9, range(3)),  # too few
        line(0.9, range(0, 10, 3)),  # too rarely
        [*line(0.9, range(3)), *line(0.9, range(3, 6), col=30.0)],  # elsewhere
        [*line(0.9, range(3)), *line(0.9, range(3, 6), score=-6.0)],  # of the other sign
    ],
    ids=["slow", "few", "rare", "elsewhere", "sign"],
)
def test_other_peaks_are_none(peaks: list[Peak]) -> None:
    assert best_trail(peaks, TURN) is None
