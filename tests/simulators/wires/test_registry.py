"""The simulated controllers that there are: by name, with options as text; what cannot be meant is refused."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import pytest
import serial

from drivers.clock import Clock, SystemClock
from drivers.stages.registry import STAGES
from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.pm16c.wire import PM16CController
from simulators.wires.registry import WIRES, stand_alone
from simulators.wires.serial_url import SCHEME
from simulators.wires.wire import Wire


def ask(wire: Wire, request: bytes) -> bytes:
    wire.receive(request + b"\r\n")
    return wire.transmit()


@pytest.mark.parametrize("kind", sorted(WIRES))
def test_every_kind_can_be_built_and_has_its_clock(kind: str) -> None:
    clock = VirtualClock()
    wire = stand_alone(kind, clock)
    assert wire.clock is clock
    wire.receive(b"\r\n")
    wire.transmit()


def test_options_reach_the_device() -> None:
    wire = stand_alone("pm16c?channel=3&counts_per_turn=720&home_at=none&stall_at=55", VirtualClock(start=0.0))
    assert isinstance(wire, PM16CController)
    assert wire.box.channels["3"].motor is wire.box.sample
    for command in (b"REM", b"RTE3115", b"ABS3+90"):
        ask(wire, command)
    wire.clock.sleep(60.0)
    assert ask(wire, b"PS?3") == b"+0000055\r\n"
    assert ask(wire, b"FDHP3") == b""
    assert ask(wire, b"ERRF?") == b"01\r\n"


class Colour(StrEnum):
    RED = "red"
    GREEN = "green"


@dataclass(frozen=True)
class Nested:
    e: float | None = None
    f: frozenset[int] = frozenset()
    g: Colour = Colour.RED


@dataclass(frozen=True)
class Everything:
    """A build with an option of every type."""

    a: int = 0
    b: float = 0.0
    c: str = ""
    d: bool = False
    nested: Nested = Nested()

    def __post_init__(self) -> None:
        if self.a < 0:
            raise ValueError("a is negative")

    @classmethod
    def matching(cls, settings: object) -> Everything:
        return cls()

    def controller(self, clock: Clock, line: TriggerLine) -> Any:
        return self


@pytest.fixture
def everything(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(WIRES, "everything", Everything)


def test_options_are_read_by_their_type(everything: None) -> None:
    every: Any = stand_alone("everything?a=-0&b=1e-3&c=x%20y&d=Yes&e=2&g=green", VirtualClock())
    assert every == Everything(0, 1e-3, "x y", True, Nested(2.0, g=Colour.GREEN))
    other: Any = stand_alone("everything?d=0&e=None&c=", VirtualClock())
    assert other == Everything()


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("nothing", "no simulated device 'nothing'; there are .*pm16c"),
        ("", "no simulated device"),
        ("everything?z=1", "no option 'z'; it has a, b, c, d, e, g$"),
        ("everything?f=1", "no option 'f'"),
        ("everything?clock=1", "no option 'clock'"),
        ("everything?a=1.5", "a=1.5 of everything cannot be read"),
        ("everything?a=none", "cannot be read"),
        ("everything?d=maybe", "true or false"),
        ("everything?g=blue", "g=blue of everything cannot be read"),
        ("everything?a=1&a=2", "twice"),
        ("everything?a", "bad query field"),
        ("everything?a=-1", "cannot be built.*a is negative"),
        ("pm16c?channel=16", "cannot be built|no channel"),
        ("pm16c?counts_per_turn=0", "cannot be built"),
        ("pi_gcs?counts_per_turn=0", "cannot be built"),
        ("zaber?counts_per_turn=0", "cannot be built"),
        ("zaber?firmware=new", "cannot be built"),
    ],
)
def test_what_cannot_be_meant_is_refused_and_named(everything: None, name: str, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        stand_alone(name, VirtualClock())


# as ports


def test_a_kind_opens_as_a_port_with_options_of_its_own() -> None:
    with (
        serial.serial_for_url("sim://pm16c?channel=2&stall_at=7", timeout=1.0) as one,
        serial.serial_for_url("sim://pm16c?channel=3", timeout=1.0) as other,
    ):
        one.write(b"REM\r\n")
        for port, answer in ((one, b"R4\r\n"), (other, b"L4\r\n")):
            port.write(b"STQ?\r\n")
            assert port.read_until(b"\r\n") == answer
        one.write(b"STQ?\r\n")
        one.reset_input_buffer()
        assert one.in_waiting == 0


def test_a_port_that_was_closed_is_the_same_device_when_it_is_opened_again() -> None:
    url = "sim://pm16c?channel=4"
    with serial.serial_for_url(url, timeout=1.0) as port:
        port.write(b"REM\r\n")
    with serial.serial_for_url(url, timeout=1.0) as port:
        port.write(b"STQ?\r\n")
        assert port.read_until(b"\r\n") == b"R4\r\n"


@pytest.mark.parametrize("name", ["nobody", "nobody?x=1", "pm16c?nothing=1", "pm16c?channel=x"])
def test_a_port_that_cannot_be_says_why(name: str) -> None:
    with pytest.raises(serial.SerialException, match="could not open port sim://"):
        serial.serial_for_url(SCHEME + name)


def test_a_device_by_itself_runs_on_the_systems_clock() -> None:
    assert isinstance(stand_alone("pm16c", SystemClock()).clock, SystemClock)


# beside the drivers


def test_every_stage_has_its_simulated_controller() -> None:
    assert WIRES.keys() == STAGES.keys()
