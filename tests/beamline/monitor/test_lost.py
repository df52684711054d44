"""Every view without light is flagged; nothing that a sample does is."""

from __future__ import annotations

import numpy as np
import pytest

from beamline.monitor.check import Flag, Level, Policy, ScanContext
from beamline.monitor.digest import digest
from beamline.monitor.lost import LostCheck, LostState
from drivers.base.frame import Frame, FrameKind
from tests.beamline.monitor.blobs import Blobs


def only(scan: Blobs) -> list[Flag]:
    return scan.flags([LostCheck()])


@pytest.mark.parametrize("left", [0.0, 0.02, 0.4])
def test_every_view_without_light_is_flagged_and_none_after(left: float) -> None:
    flags = only(Blobs(40, counts=lambda view, light: light * (left if 20 <= view < 33 else 1.0)))
    assert [flag.frame for flag in flags] == list(range(30, 43))
    assert all(flag.level is Level.ALARM for flag in flags)
    assert flags[0].score == pytest.approx(1 - left, abs=0.05)


def test_without_light_from_the_first_view_on() -> None:
    assert len(only(Blobs(6, counts=lambda view, light: 0 * light))) == 6


def test_a_view_of_one_value_was_never_written() -> None:
    dark = ScanContext(np.inf, 64, None, 0.1, light_left=0.0)
    for image, said in ((np.zeros((8, 8)), "Every pixel has one value"), (100 + np.eye(8), "The beam is lost: 100%")):
        counts = image.astype(np.uint16)
        frame = Frame(counts, FrameKind.PROJECTION, 7, 7, 7, 0.0, 0.0, 1.0)
        flag = LostCheck().look(LostState(), frame, digest(counts), dark).flag
        assert flag is not None and flag.level is Level.ALARM and flag.advice.startswith(said)


def test_a_dip_by_a_third_is_not_lost_nor_is_a_sample_that_covers_more() -> None:
    assert only(Blobs(40, counts=lambda view, light: light * (0.67 if view >= 20 else 1.0))) == []
    assert only(Blobs(40, depth=lambda view, image: image + 3.0 * (np.arange(128) < 2 * view))) == []


def test_it_alone_ends_a_scan() -> None:
    from beamline.monitor.checks import CHECKS

    assert [check.name for check in CHECKS if check.policy is not Policy.LOG] == ["lost"]
