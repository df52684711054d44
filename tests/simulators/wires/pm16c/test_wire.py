"""Simulated PM16C on its wire: the published dialogue byte by byte, and motion against closed forms."""

from __future__ import annotations

import math

import pytest

from simulators.wires.pm16c.box import ms_per_1000_pps
from tests.simulators.pm16c_host import TURN, Wire


@pytest.fixture
def wire() -> Wire:
    return Wire()


# bytes and lines


def test_replies_have_the_published_form(wire: Wire) -> None:
    assert wire.ask("VER?").endswith("PM16C-04XDL-SIMULATED")
    assert wire.ask("SETCH?") == "0123"
    assert wire.ask("PS?0") == "+0000000"
    assert wire.ask("STQ?") == "R4"
    assert wire.ask("STS0?") == "R0S000+0000000"
    assert wire.ask("STS7?") == "R7S---+0000000"
    assert wire.ask("SPD?0") == "HSPD"
    assert wire.ask("SPDH?0") == "0010000"
    assert wire.ask("RTE?0") == "024"
    assert wire.ask("ERR?") == "NO ERROR"
    assert wire.ask("ERRF?") == "00"


def test_power_on_trigger_settings_are_the_published_ones() -> None:
    wire = Wire()
    assert [wire.ask(f"TMG{letter}?5") for letter in "MSEIR"] == ["5", "+0001000", "+0010000", "0000200", "NO"]


def test_positions_have_a_sign_and_at_least_seven_digits(wire: Wire) -> None:
    wire.run("ABS0-135")
    assert wire.ask("PS?0") == "-0000135"
    wire.tell("SPDH05000000", "RTE0115")
    wire.run("ABS0+2147483647")
    assert wire.ask("PS?0") == "+2147483647"


def test_a_line_without_its_end_is_not_answered_yet(wire: Wire) -> None:
    wire.box.receive(b"SPD?0\r")
    assert wire.box.transmit() == b""
    wire.box.receive(b"\n")
    assert wire.box.transmit() == b"HSPD\r\n"


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"HELLO",
        b"ver?",
        b"PS?G",
        b"ABS0",
        b"ABS0+1.5",
        b"SPDH05000001",
        b"RTE0116",
        b"\xff\x00",
        b" VER?",
        b"TMGI00",
    ],
)
def test_an_unknown_command_sets_the_command_error_and_gives_no_reply(wire: Wire, line: bytes) -> None:
    wire.box.receive(line + b"\r\n")
    assert wire.box.transmit() == b""
    assert (wire.ask("ERRF?"), wire.ask("ERR?")) == ("01", "COMMAND ERROR")
    wire.tell("ERRC")
    assert wire.ask("ERRF?") == "00"


def test_an_endless_line_is_thrown_away(wire: Wire) -> None:
    wire.box.receive(b"A" * 1000)
    assert wire.ask("ERRF?") == "01"


def test_faulty_queries_are_counted_from_power_on() -> None:
    wire = Wire(silent={1}, garbled={2})
    assert wire.ask("SPD?0") == "HSPD"
    wire.tell("SPD?0")
    assert wire.box.transmit() == b""
    wire.tell("SPD?0")
    assert b"HSPD" not in wire.box.transmit()
    assert wire.ask("SPD?0") == "HSPD"


# states and refusals


def test_settings_need_remote_and_remote_needs_standing_motors(wire: Wire) -> None:
    wire.tell("LOC", "ABS0+100", "SPDH0500")
    assert (wire.ask("STQ?"), wire.ask("SPDH?0"), wire.ask("ERRF?")) == ("L4", "0010000", "01")
    wire.tell("ERRC", "REM", "ABS0+100000", "LOC")
    assert (wire.ask("STQ?"), wire.ask("ERRF?")) == ("R3", "01")


def test_stops_are_taken_in_local_too(wire: Wire) -> None:
    wire.tell("ABS0+100000")
    wire.box.box.remote = False
    wire.clock.sleep(3.0)
    wire.tell("ESTP0")
    assert wire.ask("STS0?")[2] == "S"


def test_channels_swap_places_on_the_position_controllers(wire: Wire) -> None:
    assert wire.ask("SETCHB---", "SETCH?") == "B123"
    assert wire.ask("SETCH1---", "SETCH?") == "1B23"
    assert wire.ask("SETCH-0-1", "SETCH?") == "3021"


def test_a_moving_motor_takes_no_second_move_and_no_settings(wire: Wire) -> None:
    wire.tell("ABS0+10000")
    assert wire.ask("ABS0-10000", "ERRF?") == "02"
    assert wire.ask("ERRC", "RTE0050", "ERRF?") == "01"
    wire.clock.sleep(60.0)
    assert wire.ask("PS?0") == "+0010000"


def test_a_target_beyond_the_counter_is_a_bad_abs(wire: Wire) -> None:
    assert wire.ask("ABS0+2147483648", "ERR?") == "BAD ABS COMMAND"


# motion


def test_rate_codes_are_preferred_numbers_from_1000_down_to_16_thousandths() -> None:
    values = [ms_per_1000_pps(code) for code in range(116)]
    assert [values[code] for code in (0, 1, 24, 48, 72, 96, 115)] == [1000, 910, 100, 10, 1.0, 0.1, 0.016]
    assert values == sorted(values, reverse=True)


def test_the_angle_of_the_past_is_remembered_through_later_moves(wire: Wire) -> None:
    wire.run("ABS0+100000")
    wire.run("ABS0+0")
    assert wire.line.angle_at(0.5) == pytest.approx(2 * math.pi * 1250 / TURN)
    assert wire.line.angle_at(-1.0) == 0.0


def test_all_stops_stop_all(wire: Wire) -> None:
    for stop in ("ASSTP", "AESTP"):
        wire.tell("ABS0+100000", "ABS5-100000")
        wire.clock.sleep(2.0)
        wire.run(stop)
        assert wire.ask("STQ?") == "R4"


def test_digital_limits_hold_only_while_they_are_switched_on(wire: Wire) -> None:
    wire.tell("FL0+500", "BL0-50")
    wire.run("ABS0+1000")
    assert wire.ask("PS?0") == "+0001000"
    wire.run(
        "ABS0+0",
    )
    wire.tell("SETLS010000000")
    for target, end in (("+1000", "+0000500"), ("+600", "+0000500"), ("-1000", "-0000050")):
        wire.run(f"ABS0{target}")
        assert (wire.ask("PS?0"), wire.ask("STS0?")[3:6]) == (end, "020")
    wire.run("ABS0+10")
    assert wire.ask("STS0?") == "R0S000+0000010"
