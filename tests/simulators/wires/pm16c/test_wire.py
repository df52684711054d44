"""Simulated PM16C on its wire: the published dialogue byte by byte, and motion against closed forms."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.wires.pm16c.box import ms_per_1000_pps
from tests.simulators.pm16c_host import ACCELERATION, SPEED, TURN, Wire


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


def test_four_motors_at_once_and_no_more(wire: Wire) -> None:
    wire.tell(*(f"ABS{channel}+100000" for channel in "01234"))
    assert (wire.ask("STQ?"), wire.ask("ERRF?"), wire.ask("ERR?")) == ("R0", "02", "MCC06 BUSY ERROR")
    assert wire.ask("STS4?") == "R4S---+0000000"


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


def test_a_move_is_a_trapezoid_in_pulses(wire: Wire) -> None:
    """1 s up to 10 000 pps over 5000 pulses, cruise, 1 s down."""
    wire.tell("ABS0+100000")
    bits = []
    for seconds, expected in ((0.5, 1250), (0.5, 5000), (5.0, 55_000), (4.5, 98_750), (0.5, 100_000)):
        wire.clock.sleep(seconds)
        assert int(wire.ask("PS?0")) == pytest.approx(expected, abs=1)
        bits.append(wire.ask("STS0?")[4:6])
    assert bits == ["03", "03", "03", "03", "00"]
    assert wire.line.angle_at(wire.clock.now()) == pytest.approx(2 * math.pi * 100_000 / TURN)


def test_the_angle_of_the_past_is_remembered_through_later_moves(wire: Wire) -> None:
    wire.run("ABS0+100000")
    wire.run("ABS0+0")
    assert wire.line.angle_at(0.5) == pytest.approx(2 * math.pi * 1250 / TURN)
    assert wire.line.angle_at(-1.0) == 0.0


def test_a_slow_stop_takes_v_squared_over_2a_and_a_fast_one_nothing(wire: Wire) -> None:
    wire.tell("ABS0+100000")
    wire.clock.sleep(3.0)
    wire.run("SSTP0")
    assert int(wire.ask("PS?0")) == pytest.approx(25_000 + 5_000, abs=1)
    assert wire.ask("STS0?")[3:6] == "040"
    wire.tell("ABS0+100000")
    wire.clock.sleep(3.0)
    wire.run("ESTP0")
    assert int(wire.ask("PS?0")) == pytest.approx(30_000 + 25_000, abs=1)
    assert wire.ask("STS0?")[3:6] == "080"


@given(st.floats(0.001, 12.0), st.sampled_from([-1, 1]))
def test_a_slow_stop_always_ends_on_a_whole_pulse_before_the_target(after: float, sign: int) -> None:
    wire = Wire()
    wire.tell(f"ABS0{sign * 100_000:+d}")
    wire.clock.sleep(after)
    before = int(wire.ask("PS?0"))
    wire.run("SSTP0")
    stopped = int(wire.ask("PS?0"))
    assert sign * before <= sign * stopped <= 100_000
    assert sign * (stopped - before) <= SPEED**2 / (2 * ACCELERATION) + 2
    assert wire.box.box.sample.move.end <= after + SPEED / ACCELERATION + 1e-6
    assert wire.line.angle_at(wire.clock.now()) == pytest.approx(stopped * 2 * math.pi / TURN, rel=1e-12)


def test_a_stop_at_the_very_start_stands(wire: Wire) -> None:
    wire.run("ABS0+1000", "SSTP0")
    assert wire.ask("PS?0") == "+0000000"


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


def test_a_stall_stands_short_with_the_emergency_bit() -> None:
    wire = Wire(stall_at=777)
    wire.run("ABS0+1000")
    assert wire.ask("STS0?") == "R0S080+0000777"
