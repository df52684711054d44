"""Simulated PI GCS 2.0 on its wire: the captured dialogue byte by byte, error codes, motion against closed forms."""

from __future__ import annotations

import math

import pytest

from tests.simulators.pi_gcs_host import Wire


@pytest.fixture
def wire() -> Wire:
    return Wire()


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
