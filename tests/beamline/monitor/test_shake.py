"""A sample that shakes is named with its size across and down; one that does not is never said to."""

from __future__ import annotations

import re

import numpy as np
import pytest

from beamline.monitor.check import Flag, Level
from beamline.monitor.checks import CHECKS
from beamline.monitor.motion import MotionCheck
from tests.beamline.monitor.blobs import BLOCK, Blobs
from tests.slow_cases import others_slow

SPOTLESS = [check for check in CHECKS if check.name != "pixels"]  # these scans have previews and no pixels


def shaking(
    across: float, down: float, views: int = 150, seed: int = 3, creep: float = 0.0, step: float = np.pi / 300
) -> list[Flag]:
    """The flags of a scan whose views stand beside the sample's way, standard deviations in pixels; `creep` pixels a
    view."""
    places = np.random.default_rng(seed).normal(size=(views, 2)) * (down, across)
    places[:, 1] += creep * np.arange(views)
    scan = Blobs(views, step=step, seed=seed)
    scan.depth = lambda view, image: scan.line_integrals(view, (places[view, 0] / BLOCK, places[view, 1] / BLOCK))
    return scan.flags(SPOTLESS, step=step)


@pytest.mark.parametrize(
    ("across", "down", "seed"), others_slow([(0.4, 0.9, 0), (1.3, 0.35, 2), (0.65, 0.65, 1), (0.65, 0.65, 7)], 2)
)
def test_a_shake_is_named_with_its_size_and_a_way_that_exists(across: float, down: float, seed: int) -> None:
    flags = [flag for flag in shaking(across, down, seed=seed) if flag.level is not Level.INFO]
    assert [(flag.check, flag.level) for flag in flags] == [("motion", Level.WARN)]
    told = [float(size) for size in re.findall(r"stand ([\d.]+) px across and ([\d.]+) px down", flags[0].advice)[0]]
    assert told == pytest.approx([across, down], rel=0.35)
    assert "`beamline recon --calibrate shifts`" in flags[0].advice


@pytest.mark.parametrize("direction", [(0.6, 0.0), (0.0, 0.6)])
def test_the_other_direction_stays_small(direction: tuple[float, float]) -> None:
    (flag,) = (flag for flag in shaking(*direction) if flag.check == "motion")
    told = [float(size) for size in re.findall(r"stand ([\d.]+) px across and ([\d.]+) px down", flag.advice)[0]]
    assert min(told) < 0.15 < 0.4 < max(told)


@pytest.mark.parametrize(
    ("seed", "step", "creep"), others_slow([(0, 0.004, 0.0), (2, 0.03, -0.1), (1, 0.01, 0.02), (3, 0.03, 0.0)], 2)
)
def test_a_sample_that_turns_and_creeps_does_not_shake(seed: int, step: float, creep: float) -> None:
    assert not [flag for flag in shaking(0, 0, seed=seed, creep=creep, step=step) if "shakes" in flag.advice]


def test_a_jump_is_no_shake() -> None:
    scan = Blobs(150, step=0.01)
    scan.depth = lambda view, image: scan.line_integrals(view, (0.0, 1.0 if view > 80 else 0.0))
    flags = [flag for flag in scan.flags([MotionCheck()], step=0.01) if flag.check == "motion"]
    assert [flag.level for flag in flags] == [Level.ALARM]


def test_a_shake_that_begins_later_is_told_once() -> None:
    places = np.random.default_rng(1).normal(size=(240, 2)) * 0.2
    places[:120] = 0
    scan = Blobs(240, step=0.01)
    scan.depth = lambda view, image: scan.line_integrals(view, tuple(places[view]))
    flags = [flag for flag in scan.flags([MotionCheck()], step=0.01) if flag.level is Level.WARN]
    assert 1 <= len(flags) <= 2 and flags[0].frame - 10 < 170
