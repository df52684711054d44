"""The digital outputs of a PI controller beside the one of the trigger pulses, over the simulated wire."""

from __future__ import annotations

import math

import pytest

from drivers.errors import DeviceRefused
from drivers.stages.pi_gcs.stage import PiGcsStage
from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.pi_gcs.wire import PiGcsController
from simulators.wires.serial_url import register


def test_an_output_is_set_and_not_read_back() -> None:
    clock = VirtualClock()
    wire = PiGcsController(clock, TriggerLine(clock), output=2, counts_per_turn=360_000)
    stage = PiGcsStage(
        register("pi-digital", wire),
        trigger_line=2,
        counts_per_turn=360_000,
        clock=clock,
        max_speed=1.0,
        acceleration=2.0,
        low=-math.pi,
        high=math.pi,
    )
    output = stage.digital_output(3)
    assert output.name == "stage output 3"
    output.set(True)
    assert wire.box.levels == {1: False, 2: False, 3: True, 4: False}
    assert output.get() is None
    output.set(False)
    assert not wire.box.levels[3]
    with pytest.raises(DeviceRefused, match="output 2 gives the trigger pulses"):
        stage.digital_output(2)
    with pytest.raises(DeviceRefused, match="DIO ended with"):
        stage.digital_output(9).set(True)
    stage.close()
