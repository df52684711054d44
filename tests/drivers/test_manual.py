"""Manual devices ask the operator once for each change, and believe nothing that was not confirmed."""

from __future__ import annotations

import pytest

from drivers.base.protocols import SampleMover, Shutter
from drivers.manual import ManualSampleMover, ManualShutter


def test_the_shutter_asks_for_each_change_and_not_again() -> None:
    asked: list[str] = []
    shutter: Shutter = ManualShutter(asked.append)
    assert not shutter.is_open()
    shutter.open()
    shutter.open()
    assert shutter.is_open()
    shutter.close()
    shutter.close()
    assert not shutter.is_open()
    assert asked == ["Open the beam shutter.", "Close the beam shutter."]


def test_an_unknown_shutter_is_closed_by_hand_before_darks() -> None:
    asked: list[str] = []
    ManualShutter(asked.append).close()
    assert asked == ["Close the beam shutter."]


def test_the_sample_is_moved_out_and_back_once() -> None:
    asked: list[str] = []
    mover: SampleMover = ManualSampleMover(asked.append)
    mover.back()
    mover.out()
    mover.out()
    mover.back()
    assert len(asked) == 2


def test_what_the_operator_did_not_confirm_did_not_happen() -> None:
    def refuse(request: str) -> None:
        raise KeyboardInterrupt

    shutter = ManualShutter(refuse)
    with pytest.raises(KeyboardInterrupt):
        shutter.open()
    assert not shutter.is_open()
