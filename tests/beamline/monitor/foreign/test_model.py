"""Views against what a volume lets expect: differences are flagged with their place, misfits that stay are not."""

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.check import Flag, Level
from beamline.monitor.foreign.model import CALIBRATION, ModelCheck
from tests.beamline.monitor.blobs import BLOCK, COLS, ROWS, Blobs, blob

MISFIT = blob(8, 100, 3.0, 0.3)
"""What the volume lacks at a place of the detector, in all views."""


def flags(scan: Blobs) -> list[Flag]:
    """With a volume that is the sample but for MISFIT, and 2 % less light in the beam."""
    asked: list[int] = []

    def model(angle: float, cell: int) -> NDArray[np.float32]:
        asked.append(cell)
        return (scan.line_integrals(round(angle / scan.step)) - MISFIT + 0.02).astype(np.float32)

    found = scan.flags([ModelCheck()], model=model)
    assert set(asked) == {BLOCK}
    return found


def test_a_view_like_its_render_raises_no_flag() -> None:
    assert flags(Blobs(60)) == []


def test_what_is_in_some_views_only_is_flagged_with_its_place() -> None:
    there = blob(20, 50, 1.5, 0.1)
    found = flags(Blobs(60, depth=lambda view, image: image + there * (40 <= view < 43)))
    assert [flag.frame for flag in found] == [50, 51, 52]
    for flag in found:
        assert flag.level is Level.WARN and flag.score > 0 and flag.region is not None
        top, below, first, last = flag.region
        assert top <= 20 * BLOCK < below <= 28 * BLOCK and first <= 50 * BLOCK < last and last - first <= 12 * BLOCK


def test_less_absorption_is_said_as_such() -> None:
    gone = blob(20, 64, 1.5, 0.08)
    found = flags(Blobs(50, depth=lambda view, image: image - gone * (view == 30)))
    assert [flag.frame for flag in found] == [40]
    assert found[0].score < 0 and "absorb less" in found[0].advice


def test_without_a_volume_and_in_the_first_views_it_says_nothing() -> None:
    there = np.ones((ROWS, COLS)) * blob(20, 50, 1.5, 0.5)
    assert Blobs(30, depth=lambda view, image: image + there * (view == 20)).flags([ModelCheck()]) == []
    assert flags(Blobs(30, depth=lambda view, image: image + there * (view == CALIBRATION - 2))) == []
