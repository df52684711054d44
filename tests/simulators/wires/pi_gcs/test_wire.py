"""Simulated PI GCS 2.0 on its wire: the captured dialogue byte by byte, error codes, motion and trigger output."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.testing.stages.bench import EmittedPulse, emitted
from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.pi_gcs.wire import PiGcsBuild
from tests.drivers.stages.flat_settings import flat
from tests.simulators.wires.dialogue import play, played

TURN = 360_000
"""A thousand counts a degree."""
VELOCITY = 10.0
ACCELERATION = 20.0


class Wire:
    """A controller with servo, velocity and acceleration set, and the cable in output 1."""

    def __init__(self, *, settings: dict[str, Any] | None = None, **build: Any) -> None:
        self.clock = VirtualClock(start=0.0)
        self.line = TriggerLine(self.clock)
        built = flat(PiGcsBuild, **({"counts_per_turn": TURN} | (settings or {}) | build))
        self.box = built.controller(self.clock, self.line)
        self.tell("SVO 1 1", f"VEL 1 {VELOCITY}", f"ACC 1 {ACCELERATION}", f"DEC 1 {ACCELERATION}")

    def tell(self, *commands: str) -> None:
        for command in commands:
            self.box.receive(command.encode() + b"\n")

    def raw(self, data: bytes) -> bytes:
        self.box.receive(data)
        return self.box.transmit()

    def ask(self, *commands: str) -> str:
        """The whole reply to the last command, without its LF, which must be there."""
        self.tell(*commands)
        reply = self.box.transmit()
        assert reply.endswith(b"\n")
        assert not reply.endswith(b" \n")
        return reply[:-1].decode("cp1252")

    def complains(self, *commands: str) -> int:
        """The error register after the commands, which must not have been answered."""
        self.tell(*commands)
        assert self.box.transmit() == b""
        return int(self.ask("ERR?"))

    def rest(self) -> None:
        """Let an hour pass; nothing may have been refused."""
        self.clock.sleep(3600.0)
        assert self.ask("ERR?") in ("0", "10")

    def window(self, step: str, start: str, stop: str) -> None:
        """Degrees; and switched on."""
        self.tell("TRO 1 0", "CTO 1 2 1", "CTO 1 3 0", f"CTO 1 1 {step}", f"CTO 1 8 {start}", f"CTO 1 9 {stop}")
        assert self.complains("TRO 1 1") == 0

    def run(self, *commands: str) -> None:
        """Give commands and let an hour pass."""
        self.tell(*commands)
        self.rest()

    def pulses(self) -> list[EmittedPulse]:
        return emitted(self.line, self.clock)

    def at(self, time: float) -> float:
        """Degrees."""
        return math.degrees(self.line.angle_at(time))

    def places(self) -> list[float]:
        """Where the pulses were, in degrees."""
        return [round(math.degrees(pulse.angle), 6) for pulse in self.pulses()]


@pytest.fixture
def wire() -> Wire:
    return Wire()


RAMP = VELOCITY**2 / (2 * ACCELERATION)
"""degrees: 2.5."""


def crossing(degrees: float) -> float:
    """When a long move from 0 passes there: √(2s/a) in the ramp, then v/a + (s - ramp)/v."""
    if degrees <= RAMP:
        return math.sqrt(2 * degrees / ACCELERATION)
    return VELOCITY / ACCELERATION + (degrees - RAMP) / VELOCITY


# Replies: 0xb0 and 0xb1 are ° and ± in the controller's code page.
DIALOGUES: dict[str, tuple[dict[str, Any], str]] = {
    "turning round inside the window goes on giving pulses until it is left": (
        {}, "window 1 2 5.5; MOV 1 4.5; ~; MOV 1 2.5; ~; MOV 1 9; ~; MOV 1 3; ~; @ 2 3 4 3 4 5"
    ),
    "leaving backwards ends it and coming again begins anew": (
        {}, "window 1 2 5.5; MOV 1 3.5; ~; MOV 1 0; ~; MOV 1 4.5; ~; @ 2 3 2 2 3 4"
    ),
    "switched on inside the window it counts from where it stands": (
        {}, "MOV 1 2.2; ~; window 1 2 5.5; MOV 1 9; ~; @ 3.2 4.2 5.2"
    ),
    "switched off, in another mode or on another output there is nothing": (
        {},
        "window 1 2 5.5; TRO 1 0; MOV 1 9; ~; @; MOV 1 0; ~; window 1 2 5.5; CTO 1 3 2; MOV 1 9; ~; @; MOV 1 0; "
        "TRO 1 0; CTO 2 1 1; CTO 2 8 2; CTO 2 9 5.5; TRO 2 1; ~; MOV 1 9; ~; @; TRO? -> 1=0 /2=1 /3=0 /4=0",
    ),
    "at 10 degrees/s a step of 0.01 takes 1 ms: pulses that are longer merge": (
        {"pulse_width": 1.001e-3}, "window 0.01 5 6.005; MOV 1 20; ~; # 1"
    ),
    "and shorter ones do not": ({"pulse_width": 0.999e-3}, "window 0.01 5 6.005; MOV 1 20; ~; # 101"),
    "lost pulses are missing and no others": ({"lost": {0, 3}}, "window 1 2 7.5; MOV 1 20; ~; @ 3 4 6 7"),
    "a motion error ends the pulses": ({"stall_at": 4500}, "window 1 2 7.5; MOV 1 20; ~ 60; @ 2 3 4"),
    "replies have the documented form": (
        {},
        "~ 0.1; *IDN? -> *Physik Instrumente*C-863.12*; CSV? -> 2.0; SAI? -> 1; SAI? ALL -> 1; POS? 1 -> 1=0.000000; "
        "POS? -> 1=0.000000; SVO? 1 -> 1=1; FRF? 1 -> 1=1; VEL? 1 -> 1=10.000000; SPA? 1 0xE -> 1 0xE=360000.000000; "
        "SPA? 1 15 -> 1 0xF=360.000000; CTO? 1 3 -> 1 3=0; TRO? 1 -> 1=0; \x04 -> 0x9002",
    ),
    "the last error wins": ({}, "MOV 1 9999; XYZ; ERR? -> 2"),
    "acceleration and deceleration are two things: up 0.5 s and 2.5 degrees, down 2 s and 10 degrees": (
        {}, "DEC 1 5; MOV 1 30; ~ 4.249; \x05 -> 1; ~ 0.002; \x05 -> 0; at 2.25 -> 20; at 3.25 -> 27.5"
    ),
    "a relative move goes from the last target": ({}, "MOV 1 3; ~; MVR 1 -4.5; ~; POS? 1 -> 1=-1.500000"),
    "the position read is one servo cycle old": (
        {"servo_period": 0.01}, "MOV 1 100; ~ 2; POS? 1 -> 1=17.400000"
    ),
    "a stage without switches says so": (
        {"reference_switch": False, "limit_switches": False},
        "TRS? 1 -> 1=0; LIM? 1 -> 1=0; FRF 1; ERR? -> 31; FNL 1; ERR? -> 32; FPL 1; ERR? -> 32",
    ),
    **{
        f"a reference move finds the true zero: {command}": (
            {"referenced": False, "found_at": -4.0, "low": -20, "high": 30},
            f"POS? 1 -> 1=0.000000; at 0 -> -4; {command} 1; \x05 -> 1; \x07 -> °; FRF? 1 -> 1=0; \x04 -> 0x[4-7c-f]*; "
            f"~ 60; \x05 -> 0; \x07 -> ±; FRF? 1 -> 1=1; POS? 1 -> 1={at}.000000; at 60 -> {at}",
        )
        for command, at in (("FRF", 0), ("FNL", -20), ("FPL", 30))
    },
}  # fmt: skip


@played(DIALOGUES)
def test_it_answers_and_moves_as_documented(build: dict[str, Any], said: str) -> None:
    play(Wire(**build), said)


def test_where_low_is_active_the_line_rises_when_a_pulse_ends() -> None:
    wire = Wire(pulse_width=1e-3)
    wire.tell("CTO 1 7 0")
    wire.window("1", "5", "7.5")
    wire.run("MOV 1 20")
    assert [pulse.time for pulse in wire.pulses()] == pytest.approx([crossing(at) + 1e-3 for at in (5, 6, 7)])
    assert wire.places() == [5.01, 6.01, 7.01]


@given(way=st.lists(st.integers(-9000, 9000), min_size=1, max_size=6), step=st.integers(50, 3000))
def test_without_a_window_pulses_are_a_step_apart_and_as_many_as_the_way_has(way: list[int], step: int) -> None:
    """Independent: walk the way count by count and fire whenever the last pulse is a step away."""
    wire = Wire()
    wire.window(f"{step / 1000}", "0", "0")
    here = last = 0
    expected = []
    for target in way:
        wire.run(f"MOV 1 {target / 1000}")
        for at in range(here, target, 1 if target > here else -1):
            at += 1 if target > here else -1
            if abs(at - last) == step:
                last = at
                expected.append(at / 1000)
        here = target
    assert wire.places() == expected


# bytes and lines


def test_control_bytes_act_at_once_even_within_a_line(wire: Wire) -> None:
    wire.clock.sleep(0.1)
    assert wire.raw(b"\x05") == b"0\n"
    assert wire.raw(b"\x04") == b"0x9002\n"
    assert wire.raw(b"\x07") == b"\xb1\n"
    assert wire.raw(b"MOV 1 \x0520\n\x05") == b"0\n1\n"
    assert wire.raw(b"\x18\x05") == b"0\n"
    assert wire.ask("ERR?") == "10"


def test_carriage_returns_case_and_empty_lines_do_not_matter(wire: Wire) -> None:
    assert wire.raw(b"\n\r\n  \nmov 1 2.5\r\nMov? 1\n") == b"1=2.500000\n"
    assert wire.ask("ERR?") == "0"


def test_replies_take_their_time() -> None:
    wire = Wire(settings={"latency": 0.004})
    assert wire.raw(b"CSV?\n") == b""
    wire.clock.sleep(0.0039)
    assert wire.box.transmit() == b""
    wire.clock.sleep(0.0002)
    assert wire.box.transmit() == b"2.0\n"


def test_replies_can_be_spoilt_on_their_way() -> None:
    wire = Wire(settings={"spoil": lambda number, reply: b"" if number == 1 else reply + b"?" * number})
    assert [wire.raw(b"CSV?\n") for _ in range(3)] == [b"2.0\n", b"", b"2.0\n??"]


# the error register


@pytest.mark.parametrize(
    ("command", "code"),
    [
        ("XYZ?", 2), ("MOO 1 1", 2), ("POS? 2", 15), ("MOV 2 1", 15), ("MOV 1", 24), ("MOV 1 1 1 2", 24),
        ("MOV 1 ten", 25), ("MOV 1 1_0", 25), ("MOV 1 nan", 25), ("MOV 1 720.1", 7), ("MOV 1 1e9", 7), ("VEL 1 721", 8),
        ("VEL 1 0", 8), ("ACC 1 -1", 17), ("SVO 1 2", 17), ("SPA? 1 0x99", 54), ("SPA 1 0xE 5", 60), ("CTO 5 1 1", 36),
        ("CTO 1 11 1", 54), ("CTO 1 7 2", 17), ("CTO 1 3 4", 17), ("CTO 1 1 0", 17), ("CTO 1 2 2", 15), ("TRO 1", 24),
        ("CTO 1 3 0 1 1 0.1", 24), ("TRO 1 2", 17), ("MOV 1 " + "1" * 260, 3), ("HLT 1", 10), ("STP", 10), ("\x18", 10),
    ],
)  # fmt: skip
def test_a_wrong_command_only_sets_the_error_register_once(wire: Wire, command: str, code: int) -> None:
    assert wire.complains(command) == code
    assert wire.ask("ERR?") == "0"
    assert wire.raw(b"\x05") == b"0\n"
    assert wire.ask("POS? 1") == "1=0.000000"
