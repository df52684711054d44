"""Simulated PM16C on its wire: the published dialogue byte by byte, motion, trigger output and the home switch."""

from __future__ import annotations

import math

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from simulators.wires.pm16c.box import ms_per_1000_pps
from tests.simulators.pm16c_host import ACCELERATION, TURN, Wire


@pytest.fixture
def wire() -> Wire:
    return Wire()


# the home switch


def searching(at: int | None) -> Wire:
    wire = Wire(home_at=at)
    wire.tell("SPDH01000")
    return wire


@pytest.mark.parametrize("at", [30_000, -30_000])
def test_a_search_passes_the_switch_remembers_it_and_stands_v_squared_over_2a_beyond(at: int) -> None:
    wire = searching(at)
    assert wire.ask("SHP?0") == "NO H.P"
    wire.tell("FDHP0")
    wire.clock.sleep(30.0)
    assert wire.ask("SHP?0") == "NO H.P"
    assert wire.ask("STS0?")[2] == ("P" if at > 0 else "N")
    wire.clock.sleep(0.1)
    assert int(wire.ask("SHP?0")) == at
    wire.clock.sleep(60.0)
    assert int(wire.ask("PS?0")) == at + math.copysign(1000**2 / (2 * ACCELERATION), at)
    wire.run("GTHP0")
    assert int(wire.ask("PS?0")) == at


def test_a_new_search_forgets_the_old_one_and_a_move_does_not() -> None:
    wire = searching(500)
    wire.run("FDHP0")
    wire.run("ABS0+20000")
    assert wire.ask("SHP?0") == "+0000500"
    wire.tell("FDHP0")
    assert wire.ask("SHP?0") == "NO H.P"


def test_a_limit_between_here_and_the_switch_ends_the_search() -> None:
    wire = searching(30_000)
    wire.tell("FL0+500", "SETLS010000000")
    wire.run("FDHP0")
    assert (wire.ask("STS0?"), wire.ask("SHP?0")) == ("R0S020+0000500", "NO H.P")


# the preset


def test_the_past_is_not_turned_by_a_preset() -> None:
    wire = Wire()
    wire.run("ABS0+100000")
    wire.tell("PS0-5")
    assert wire.line.angle_at(0.5) == pytest.approx(2 * math.pi * 1250 / TURN)


def test_a_preset_needs_a_motor_that_stands_and_is_not_armed() -> None:
    wire = Wire()
    wire.train(100, 200, 10)
    assert wire.ask("PS0+7", "PS?0") == "+0000000"
    wire.tell("TMGC0", "ABS0+10000", "PS0+7")
    wire.clock.sleep(60.0)
    assert wire.ask("PS?0") == "+0010000"
    assert wire.ask("ERRC", "PS0+2147483648", "ERRF?") == "01"


def test_a_stop_at_the_instant_of_a_pulse_neither_loses_nor_repeats_one() -> None:
    for k in range(8):
        wire = Wire()
        wire.train(10_000, 20_000, 1000)
        wire.tell("ABS0+40000")
        for _ in range(k):
            wire.clock.sleep(wire.line.next_after(wire.clock.now()).time - wire.clock.now())  # type: ignore[union-attr]
        wire.run("ESTP0" if k % 2 else "SSTP0")
        wire.run("ABS0+40000")
        assert wire.counts() == list(range(10_000, 20_001, 1000))


@settings(max_examples=50)
@given(
    start=st.integers(1, 3000), interval=st.integers(1, 700), n=st.integers(1, 40), room=st.integers(0, 699),
    sign=st.sampled_from([-1, 1]), stop_after=st.floats(0.0, 8.0)
)  # fmt: skip
def test_a_train_is_whole_whatever_way_and_wherever_it_is_interrupted(
    start: int, interval: int, n: int, room: int, sign: int, stop_after: float
) -> None:
    """Stop, go back, go on: every point once, in order, floor((end - start)/interval) + 1 of them."""
    wire = Wire()
    end = start + interval * (n - 1) + min(room, interval - 1)
    assume(sign > 0 or end > start)  # with one point only, there is no sign to turn the other way
    wire.train(sign * start, sign * end, interval)
    assert wire.ask("TMGR?0") == "YES"
    wire.tell(f"ABS0{sign * 40_000:+d}")
    wire.clock.sleep(stop_after)
    wire.run("SSTP0")
    wire.run("ABS0+0")
    wire.run(f"ABS0{sign * 40_000:+d}")
    assert wire.counts() == [sign * (start + k * interval) for k in range((end - start) // interval + 1)]
    assert wire.ask("TMGR?0") == "NO"


def test_ready_drops_when_the_start_point_is_passed_though_pulses_go_on(wire: Wire) -> None:
    wire.train(5000, 50_000, 5000)
    wire.tell("ABS0+60000")
    wire.clock.sleep(0.99)
    assert wire.ask("TMGR?0") == "YES"
    wire.clock.sleep(0.02)
    assert wire.ask("TMGR?0") == "NO"
    wire.clock.sleep(60.0)
    assert len(wire.pulses()) == 10


@pytest.mark.parametrize(("start", "end"), [(0, 100), (-5, 100), (5, -100)])
def test_it_cannot_be_armed_from_inside_or_beyond(wire: Wire, start: int, end: int) -> None:
    wire.train(start, end, 10)
    assert (wire.ask("TMGR?0"), wire.ask("ERRF?")) == ("NO", "01")


def test_it_cannot_be_armed_switched_off_or_without_a_position_controller(wire: Wire) -> None:
    wire.tell("TMGM00")
    wire.train(10, 100, 10)
    assert wire.ask("TMGR?0") == "NO"
    wire.tell("TMGM05", "SETCH4567", "TMGR0")
    assert wire.ask("TMGR?0") == "NO"


def test_settings_of_an_armed_trigger_are_not_taken(wire: Wire) -> None:
    wire.train(1000, 9000, 1000)
    wire.tell("TMGI0500", "TMGM03", "TMGS0+2000")
    assert (wire.ask("TMGI?0"), wire.ask("TMGM?0"), wire.ask("TMGS?0"), wire.ask("ERRF?")) == (
        "0001000", "2", "+0001000", "01"
    )  # fmt: skip


def test_a_width_not_shorter_than_the_interval_time_leaves_the_output_high(wire: Wire) -> None:
    """At 10 000 pps, 10 pulses last 1 ms: with 1 ms pulses only the first rise is an edge, with 100 µs all are."""
    wire.run("ABS0-30000")
    for digit, edges in (("5", 1), ("4", 101)):
        seen = len(wire.pulses())
        wire.tell(f"TMGM0{digit}")
        wire.train(0, 1000, 10)
        wire.run("ABS0+30000")
        assert len(wire.pulses()) - seen == edges
        wire.run("ABS0-30000")


def test_only_the_channel_on_position_controller_a_reaches_the_cable(wire: Wire) -> None:
    wire.tell("SETCH10--")
    wire.train(100, 1000, 100)
    wire.run("ABS0+2000")
    assert wire.counts() == []


def test_a_fast_stop_takes_away_the_pulses_to_come_and_lost_ones_never_come() -> None:
    wire = Wire(lost={1})
    wire.train(10_000, 90_000, 10_000)
    wire.tell("ABS0+100000")
    wire.clock.sleep(5.0)
    wire.run("ESTP0")
    assert wire.counts() == [10_000, 30_000, 40_000]


def test_more_pulses_than_it_can_work_out_are_refused_at_once(wire: Wire) -> None:
    wire.train(1, 200_001, 1)
    assert (wire.ask("TMGR?0"), wire.ask("ERRF?")) == ("NO", "01")
    wire.train(1, 200_000, 1)
    assert wire.ask("TMGR?0") == "YES"


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
