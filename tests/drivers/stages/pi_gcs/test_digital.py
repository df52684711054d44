"""The digital outputs of a PI controller beside the one of the trigger pulses, over the simulated wire."""

from __future__ import annotations

import math

import pytest

from drivers.base.errors import DeviceRefused
from drivers.stages.pi_gcs.settings import PiGcsSettings
from drivers.stages.pi_gcs.stage import PiGcsStage
from drivers.stages.settings import StageFigures
from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.pi_gcs.wire import PiGcsBuild
from simulators.wires.serial_url import register
from tests.drivers.stages.flat_settings import flat


def test_an_output_is_set_and_not_read_back() -> None:
    clock = VirtualClock()
    wire = flat(PiGcsBuild, output=2, counts_per_turn=360_000).controller(clock, TriggerLine(clock))
    settings = PiGcsSettings(StageFigures(360_000, 1.0, 2.0, -math.pi, math.pi), trigger_line=2)
    stage = PiGcsStage(register("pi-digital", wire), settings, clock)
    output = stage.digital_output(3)
    assert output.name == "stage output 3"
    output.set(True)
    assert wire.box.levels == {1: False, 2: False, 3: True, 4: False}
    assert output.get() is None
    output.set(False)
    assert not wire.box.levels[3]
    with pytest.raises(DeviceRefused, match="output 2 gives"):
        stage.digital_output(2)
    with pytest.raises(DeviceRefused, match="DIO ended with"):
        stage.digital_output(9).set(True)
    stage.close()
