"""Manual devices ask the operator once for each change, and again if a request was not confirmed."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from drivers.base.protocols import SampleMover, Shutter
from drivers.in_beam import Ask, ManualFilter, ManualMonochromator, ManualSampleMover, ManualShutter


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


def _shutter(ask: Ask) -> tuple[Callable[[], object], Callable[[], object]]:
    device = ManualShutter(ask)
    return device.close, device.open


def _mover(ask: Ask) -> tuple[Callable[[], object], Callable[[], object]]:
    device = ManualSampleMover(ask)
    return device.back, device.out


def _filter(ask: Ask) -> tuple[Callable[[], object], Callable[[], object]]:
    device = ManualFilter(ask)
    return lambda: device.put("none"), lambda: device.put("Al 1 mm")


def _monochromator(ask: Ask) -> tuple[Callable[[], object], Callable[[], object]]:
    device = ManualMonochromator(ask)
    return lambda: device.move_to(8.0), lambda: device.move_to(8.4)


@pytest.mark.parametrize("device", [_shutter, _mover, _filter, _monochromator])
def test_after_a_request_that_was_not_confirmed_the_state_of_before_is_asked_for_again(
    device: Callable[[Ask], tuple[Callable[[], object], Callable[[], object]]],
) -> None:
    asked: list[str] = []

    def ask(request: str) -> None:
        asked.append(request)
        if refuses:
            raise KeyboardInterrupt

    back, there = device(ask)
    refuses = False
    back()
    asked.clear()
    refuses = True
    with pytest.raises(KeyboardInterrupt):
        there()
    refuses = False
    back()
    back()
    assert len(asked) == 2
