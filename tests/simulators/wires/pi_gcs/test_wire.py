"""Simulated PI GCS 2.0 on its wire: the captured dialogue byte by byte, error codes, motion and trigger output."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.testing.stages.bench import EmittedPulse, emitted
from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.pi_gcs.wire import PiGcsBuild
from tests.drivers.stages.flat_settings import flat

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

    def window(self, step: str, start: str, stop: str) -> None:
        """Degrees; and switched on."""
        self.tell("TRO 1 0", "CTO 1 2 1", "CTO 1 3 0", f"CTO 1 1 {step}", f"CTO 1 8 {start}", f"CTO 1 9 {stop}")
        assert self.complains("TRO 1 1") == 0

    def run(self, *commands: str) -> None:
        """Give commands and let an hour pass; none of them may be refused."""
        self.tell(*commands)
        self.clock.sleep(3600.0)
        assert self.ask("ERR?") in ("0", "10")

    def pulses(self) -> list[EmittedPulse]:
        return emitted(self.line, self.clock)

    def degrees(self) -> list[float]:
        """Where the pulses were."""
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


def test_turning_round_inside_the_window_goes_on_giving_pulses_until_it_is_left(wire: Wire) -> None:
    """Out to 4.5 (pulses at 2, 3, 4), back to 2.5 (3), forwards again (4, 5), then out past the stop: none more."""
    wire.window("1", "2", "5.5")
    wire.run("MOV 1 4.5")
    wire.run("MOV 1 2.5")
    wire.run("MOV 1 9")
    wire.run("MOV 1 3")
    assert wire.degrees() == [2, 3, 4, 3, 4, 5]


def test_leaving_backwards_ends_it_and_coming_again_begins_anew(wire: Wire) -> None:
    wire.window("1", "2", "5.5")
    wire.run("MOV 1 3.5")
    wire.run("MOV 1 0")
    wire.run("MOV 1 4.5")
    assert wire.degrees() == [2, 3, 2, 2, 3, 4]


def test_switched_on_inside_the_window_it_counts_from_where_it_stands(wire: Wire) -> None:
    wire.run("MOV 1 2.2")
    wire.window("1", "2", "5.5")
    wire.run("MOV 1 9")
    assert wire.degrees() == [3.2, 4.2, 5.2]


def test_switched_off_or_in_another_mode_or_on_another_output_there_is_nothing(wire: Wire) -> None:
    wire.window("1", "2", "5.5")
    wire.tell("TRO 1 0")
    wire.run("MOV 1 9")
    wire.run("MOV 1 0")
    wire.window("1", "2", "5.5")
    wire.tell("CTO 1 3 2")
    wire.run("MOV 1 9")
    wire.run("MOV 1 0", "TRO 1 0", "CTO 2 1 1", "CTO 2 8 2", "CTO 2 9 5.5", "TRO 2 1")
    wire.run("MOV 1 9")
    assert wire.degrees() == []
    assert wire.ask("TRO?") == "1=0 \n2=1 \n3=0 \n4=0"


def test_pulses_that_run_into_each_other_merge() -> None:
    """At 10 degrees/s a step of 0.01 degrees takes 1 ms, as long as a pulse is held."""
    wire = Wire(pulse_width=1.001e-3)
    wire.window("0.01", "5", "6.005")
    wire.run("MOV 1 20")
    assert len(wire.pulses()) == 1
    wire = Wire(pulse_width=0.999e-3)
    wire.window("0.01", "5", "6.005")
    wire.run("MOV 1 20")
    assert len(wire.pulses()) == 101


def test_where_low_is_active_the_line_rises_when_a_pulse_ends() -> None:
    wire = Wire(pulse_width=1e-3)
    wire.tell("CTO 1 7 0")
    wire.window("1", "5", "7.5")
    wire.run("MOV 1 20")
    assert [pulse.time for pulse in wire.pulses()] == pytest.approx([crossing(at) + 1e-3 for at in (5, 6, 7)])
    assert wire.degrees() == [5.01, 6.01, 7.01]


def test_lost_pulses_are_missing_and_no_others() -> None:
    wire = Wire(lost={0, 3})
    wire.window("1", "2", "7.5")
    wire.run("MOV 1 20")
    assert wire.degrees() == [3, 4, 6, 7]


def test_a_motion_error_ends_the_pulses() -> None:
    wire = Wire(stall_at=4500)
    wire.window("1", "2", "7.5")
    wire.tell("MOV 1 20")
    wire.clock.sleep(60.0)
    assert wire.degrees() == [2, 3, 4]


@settings(max_examples=60)
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
    assert wire.degrees() == expected


# bytes and lines


def test_replies_have_the_documented_form(wire: Wire) -> None:
    wire.clock.sleep(0.1)
    assert "Physik Instrumente" in wire.ask("*IDN?")
    assert "C-863.12" in wire.ask("*IDN?")
    assert wire.ask("CSV?") == "2.0"
    assert wire.ask("SAI?") == wire.ask("SAI? ALL") == "1"
    assert wire.ask("POS? 1") == wire.ask("POS?") == "1=0.000000"
    assert wire.ask("SVO? 1") == "1=1"
    assert wire.ask("FRF? 1") == "1=1"
    assert wire.ask("VEL? 1") == "1=10.000000"
    assert wire.ask("SPA? 1 0xE") == "1 0xE=360000.000000"
    assert wire.ask("SPA? 1 15") == "1 0xF=360.000000"
    assert wire.ask("CTO? 1 3") == "1 3=0"
    assert wire.ask("TRO? 1") == "1=0"
    assert wire.raw(b"\x04") == b"0x9002\n"


def test_replies_of_several_lines_end_with_space_and_line_feed_but_for_the_last(wire: Wire) -> None:
    assert wire.raw(b"TRO?\n") == b"1=0 \n2=0 \n3=0 \n4=0\n"


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


def test_the_last_error_wins(wire: Wire) -> None:
    assert wire.complains("MOV 1 9999", "XYZ") == 2


# moves


def test_acceleration_and_deceleration_are_two_things(wire: Wire) -> None:
    """Up 0.5 s and 2.5 degrees, down 2 s and 10 degrees, between them 17.5 degrees: 4.25 s in all."""
    wire.tell("DEC 1 5", "MOV 1 30")
    wire.clock.sleep(4.249)
    assert wire.raw(b"\x05") == b"1\n"
    wire.clock.sleep(0.002)
    assert wire.raw(b"\x05") == b"0\n"
    assert math.degrees(wire.line.angle_at(2.25)) == pytest.approx(20.0)
    assert math.degrees(wire.line.angle_at(3.25)) == pytest.approx(27.5)


def test_a_relative_move_goes_from_the_last_target(wire: Wire) -> None:
    wire.run("MOV 1 3")
    wire.run("MVR 1 -4.5")
    assert wire.ask("POS? 1") == "1=-1.500000"


def test_the_position_read_is_one_servo_cycle_old() -> None:
    wire = Wire(servo_period=0.01)
    wire.tell("MOV 1 100")
    wire.clock.sleep(2.0)
    assert wire.ask("POS? 1") == "1=17.400000"


# reference and faults


@pytest.mark.parametrize(("command", "at"), [("FRF 1", 0.0), ("FNL 1", -20.0), ("FPL 1", 30.0)])
def test_a_reference_move_finds_the_true_zero(command: str, at: float) -> None:
    wire = Wire(referenced=False, found_at=-4.0, low=-20, high=30)
    assert wire.ask("POS? 1") == "1=0.000000"
    assert math.degrees(wire.line.angle_at(0.0)) == pytest.approx(-4.0)
    wire.tell(command)
    assert (wire.raw(b"\x05"), wire.raw(b"\x07"), wire.ask("FRF? 1")) == (b"1\n", b"\xb0\n", "1=0")
    assert int(wire.raw(b"\x04"), 16) & 1 << 14
    wire.clock.sleep(60.0)
    assert (wire.raw(b"\x05"), wire.raw(b"\x07"), wire.ask("FRF? 1")) == (b"0\n", b"\xb1\n", "1=1")
    assert wire.ask("POS? 1") == f"1={at:.6f}"
    assert math.degrees(wire.line.angle_at(wire.clock.now())) == pytest.approx(at)


def test_a_stage_without_switches_says_so() -> None:
    wire = Wire(reference_switch=False, limit_switches=False)
    assert (wire.ask("TRS? 1"), wire.ask("LIM? 1")) == ("1=0", "1=0")
    assert [wire.complains(command) for command in ("FRF 1", "FNL 1", "FPL 1")] == [31, 32, 32]
