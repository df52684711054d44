"""The simulated controllers that there are, each on its port."""

from __future__ import annotations

import pytest
import serial

from beamline.config.stages import STAGES
from beamline.instrument.simulated import WIRES
from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.pm16c.wire import PM16CBuild, PM16CController
from simulators.wires.wire import register


def _pm16c() -> PM16CController:
    clock = VirtualClock()
    return PM16CBuild().controller(clock, TriggerLine(clock))


@pytest.mark.parametrize("kind", sorted(WIRES))
def test_every_kind_can_be_built_and_has_its_clock(kind: str) -> None:
    clock = VirtualClock()
    wire = WIRES[kind]().controller(clock, TriggerLine(clock))
    assert wire.clock is clock
    wire.receive(b"\r\n")
    wire.transmit()


def test_ports_are_apart_and_a_port_that_was_closed_is_the_same_device_when_it_is_opened_again() -> None:
    one, other = register("one", _pm16c()), register("other", _pm16c())
    with serial.serial_for_url(one, timeout=1.0) as port:
        port.write(b"REM\r\n")
    for url, answer in ((one, b"R4\r\n"), (other, b"L4\r\n")):
        with serial.serial_for_url(url, timeout=1.0) as port:
            port.write(b"STQ?\r\n")
            assert port.read_until(b"\r\n") == answer
            port.write(b"STQ?\r\n")
            port.reset_input_buffer()
            assert port.in_waiting == 0


@pytest.mark.parametrize("name", ["nobody", "pm16c", "pm16c?channel=3"])
def test_a_port_that_nobody_registered_is_refused(name: str) -> None:
    with pytest.raises(serial.SerialException, match=r"open port sim://.*port, only"):
        serial.serial_for_url("sim://" + name)


def test_every_stage_has_its_simulated_controller_or_another_s() -> None:
    assert WIRES.keys() == {kind for kind in STAGES if not STAGES[kind].Settings.stand_in}
    assert {STAGES[kind].Settings.stand_in for kind in STAGES} <= {"", *WIRES}
