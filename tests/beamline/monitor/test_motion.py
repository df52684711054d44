"""A jump of the sample is flagged in the view in which it happens, with its size and direction."""

from __future__ import annotations

import re

import numpy as np
import pytest

from beamline.monitor.check import Flag, Level
from beamline.monitor.motion import MotionCheck
from tests.beamline.monitor.blobs import BLOCK, Blobs
from tests.beamline.monitor.foreign.test_ghost import fog


def only(scan: Blobs) -> list[Flag]:
    return scan.flags([MotionCheck()])


def jumping(down: float, across: float, slip: int = 0) -> Blobs:
    """From view 40 on the sample is elsewhere; pixels, steps."""
    scan = Blobs(70)
    shift = down / BLOCK, across / BLOCK
    scan.depth = lambda view, image: scan.line_integrals(view + slip, shift) if view >= 40 else image
    return scan


@pytest.mark.parametrize(("down", "across"), [(1.0, 0.0), (0.0, -1.0), (-3.0, 2.0)])
def test_a_jump_is_flagged_once_with_its_size(down: float, across: float) -> None:
    flags = only(jumping(down, across))
    assert [(flag.frame, flag.level) for flag in flags] == [(50, Level.ALARM)]
    assert flags[0].score == pytest.approx(np.hypot(down, across), rel=0.15)
    signs = re.search(r"by ([+-]).* px across and ([+-]).* px down", flags[0].advice)
    assert signs is not None
    for sign, moved in zip(signs.groups(), (across, down), strict=True):
        assert moved == 0 or (moved > 0) is (sign == "+")


def test_a_slip_of_the_stage_is_counted_in_steps() -> None:
    flags = only(jumping(0, 0, slip=5))
    assert [flag.frame for flag in flags] == [50]
    assert flags[0].score == pytest.approx(5, abs=0.7)
    assert "steps more than its step" in flags[0].advice


def test_a_quarter_of_a_pixel_is_no_finding() -> None:
    assert only(jumping(0.2, 0.2)) == []


def test_vibration_raises_the_limit() -> None:
    scan = Blobs(120)
    rng = np.random.default_rng(4)
    scan.depth = lambda view, image: scan.line_integrals(view, tuple(rng.normal(0, 0.4 / BLOCK, 2)))
    assert [flag.level for flag in only(scan)] == [Level.WARN]  # it is named, and no view is a jump


GHOSTS = [(0.6, 8.0, 30.0), (0.3, 3.0, 12.0), (0.1, 15.0, 30.0), (-0.1, 8.0, 30.0), (-0.3, 15.0, 12.0)]


@pytest.mark.parametrize(("gain", "speed", "half_width"), GHOSTS)
def test_the_edges_of_a_ghost_are_no_jump(gain: float, speed: float, half_width: float) -> None:
    assert only(Blobs(80, counts=fog(gain, speed, half_width))) == []


@pytest.mark.parametrize(("gain", "speed", "half_width"), GHOSTS)
@pytest.mark.parametrize("shift", [(1.0, 0.0), (0.0, -1.0)])
def test_a_jump_behind_a_ghost_is_one(gain: float, speed: float, half_width: float, shift: tuple[float, float]) -> None:
    scan = jumping(*shift)
    ghost = fog(gain, speed, half_width)
    scan.counts = lambda view, light: ghost(view + 17, light)  # in the field from view 33 on at the latest
    assert 50 in [flag.frame for flag in only(scan)]
