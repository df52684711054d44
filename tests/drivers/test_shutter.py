"""A shutter on an output: signals, waiting times, and its state if the output does not respond."""

from __future__ import annotations

import pytest

from drivers.base.errors import DeviceError, DeviceRefused
from drivers.base.protocols import Shutter
from drivers.in_beam import OutputShutter
from simulators.devices.clock import VirtualClock
from tests.messages import refused


class Line:
    """An output: `tells` whether it can be read, `stuck` the level that it keeps whatever is set."""

    name = "output 1"

    def __init__(self, tells: bool = True, stuck: bool | None = None, fails: bool = False) -> None:
        self.level, self.tells, self.stuck, self.fails = False, tells, stuck, fails
        self.levels: list[bool] = []

    def set(self, high: bool) -> None:
        if self.fails:
            raise DeviceError("box", "no reply")
        self.levels.append(high)
        self.level = high if self.stuck is None else self.stuck

    def get(self) -> bool | None:
        return self.level if self.tells else None


@pytest.mark.parametrize("tells", [True, False])
@pytest.mark.parametrize("open_high", [True, False])
def test_polarity_and_travel(tells: bool, open_high: bool) -> None:
    line, clock = Line(tells), VirtualClock(0.0)
    shutter: Shutter = OutputShutter(line, clock, open_high=open_high, settle=0.25)
    if not tells:
        assert not shutter.is_open()  # nobody counts on beam that was not asked for
    shutter.open()
    assert (line.levels, shutter.is_open(), clock.now()) == ([open_high], True, 0.25)
    shutter.open()
    assert (line.levels, clock.now()) == ([open_high], 0.25)
    shutter.close()
    assert (line.levels, shutter.is_open(), clock.now()) == ([open_high, not open_high], False, 0.5)
    shutter.close()  # it goes out again
    assert (line.levels[2:], clock.now()) == ([not open_high], 0.75)


def test_an_output_that_does_not_hold_is_reported() -> None:
    shutter = OutputShutter(Line(stuck=False), VirtualClock(0.0))
    with refused(DeviceError):
        shutter.open()
    assert not shutter.is_open()


def test_a_shutter_that_hangs_open_is_never_called_closed() -> None:
    shutter = OutputShutter(Line(stuck=True), VirtualClock(0.0))
    shutter.open()
    for _ in range(2):
        with refused(DeviceError):
            shutter.close()
        assert shutter.is_open()


def test_after_a_failure_nothing_is_believed() -> None:
    line = Line(tells=False)
    shutter = OutputShutter(line, VirtualClock(0.0), settle=1.0)
    shutter.open()
    line.fails = True
    with refused(DeviceError):
        shutter.close()
    assert not shutter.is_open()
    line.fails = False
    shutter.open()
    assert line.levels == [True, True]  # sent again: what the failed close did is not known


def test_changes_by_another_program_are_noticed() -> None:
    line = Line()
    shutter = OutputShutter(line, VirtualClock(0.0))
    shutter.open()
    line.level = False
    assert not shutter.is_open()
    shutter.open()
    assert line.levels == [True, True]


@pytest.mark.parametrize("settle", [-1.0, float("nan"), float("inf")])
def test_settling_must_be_a_time(settle: float) -> None:
    with pytest.raises(DeviceRefused, match="settling time"):
        OutputShutter(Line(), VirtualClock(0.0), settle=settle)
