"""A jump is flagged in its projection, a shake with its horizontal and vertical size; nothing else is flagged."""

import re

import numpy as np
import pytest

from beamline.monitor.check import Flag, Level
from beamline.monitor.checks import CHECKS
from beamline.monitor.motion import MotionCheck
from tests.beamline.monitor.blobs import BLOCK, Blobs
from tests.slow_cases import others_slow


def of_motion(scan: Blobs) -> list[Flag]:
    return scan.flags([MotionCheck()])


def jumping(down: float, across: float, slip: int = 0) -> Blobs:
    """From view 40 on the sample is elsewhere; pixels, steps."""
    scan = Blobs(70)
    shift = down / BLOCK, across / BLOCK
    scan.depth = lambda view, image: scan.line_integrals(view + slip, shift) if view >= 40 else image
    return scan


@pytest.mark.parametrize(("down", "across"), [(1.0, 0.0), (0.0, -1.0), (-3.0, 2.0)])
def test_a_jump_is_flagged_once_with_its_size(down: float, across: float) -> None:
    flags = of_motion(jumping(down, across))
    assert [(flag.frame, flag.level) for flag in flags] == [(50, Level.ALARM)]
    assert flags[0].score == pytest.approx(np.hypot(down, across), rel=0.15)
    signs = re.search(r"by ([+-]).* px horizontally and ([+-]).* px vertically", flags[0].advice)
    assert signs is not None
    for sign, moved in zip(signs.groups(), (across, down), strict=True):
        assert moved == 0 or (moved > 0) is (sign == "+")


def test_a_slip_of_the_stage_is_counted_in_steps() -> None:
    flags = of_motion(jumping(0, 0, slip=5))
    assert [flag.frame for flag in flags] == [50]
    assert flags[0].score == pytest.approx(5, abs=0.7)
    assert "between two frames the sample rotated by" in flags[0].advice


def test_vibration_raises_the_limit() -> None:
    scan = Blobs(120)
    rng = np.random.default_rng(4)
    scan.depth = lambda view, image: scan.line_integrals(view, tuple(rng.normal(0, 0.4 / BLOCK, 2)))
    assert [flag.level for flag in of_motion(scan)] == [Level.WARN]  # it is named, and no view is a jump


SPOTLESS = [check for check in CHECKS if check.name != "pixels"]  # these scans have previews and no pixels


def shaking(
    across: float, down: float, views: int = 120, seed: int = 3, creep: float = 0.0, step: float = np.pi / 300
) -> list[Flag]:
    """The flags of a scan whose views stand beside the sample's way, standard deviations in pixels; `creep` pixels a
    view."""
    places = np.random.default_rng(seed).normal(size=(views, 2)) * (down, across)
    places[:, 1] += creep * np.arange(views)
    scan = Blobs(views, step=step, seed=seed)
    scan.depth = lambda view, image: scan.line_integrals(view, (places[view, 0] / BLOCK, places[view, 1] / BLOCK))
    return scan.flags(SPOTLESS, step=step)


@pytest.mark.parametrize(("across", "down", "seed"), others_slow([(0.4, 0.9, 0), (1.3, 0.35, 2)]))
def test_a_shake_is_named_with_its_size_and_a_way_that_exists(across: float, down: float, seed: int) -> None:
    flags = [flag for flag in shaking(across, down, seed=seed) if flag.level is not Level.INFO]
    assert [(flag.check, flag.level) for flag in flags] == [("motion", Level.WARN)]
    told = [
        float(size)
        for size in re.findall(r"shakes by ([\d.]+) px horizontally and ([\d.]+) px vertically", flags[0].advice)[0]
    ]
    assert told == pytest.approx([across, down], rel=0.35)
    assert "`beamline recon --calibrate shifts`" in flags[0].advice


@pytest.mark.parametrize(("seed", "step", "creep"), others_slow([(0, 0.004, 0.0), (2, 0.03, -0.1)]))
def test_a_sample_that_turns_and_creeps_does_not_shake(seed: int, step: float, creep: float) -> None:
    assert not [flag for flag in shaking(0, 0, seed=seed, creep=creep, step=step) if "shakes" in flag.advice]


def test_a_shake_that_begins_later_is_told_once() -> None:
    places = np.random.default_rng(1).normal(size=(240, 2)) * 0.2
    places[:120] = 0
    scan = Blobs(240, step=0.01)
    scan.depth = lambda view, image: scan.line_integrals(view, tuple(places[view]))
    flags = [flag for flag in scan.flags([MotionCheck()], step=0.01) if flag.level is Level.WARN]
    assert 1 <= len(flags) <= 2 and flags[0].frame - 10 < 170
