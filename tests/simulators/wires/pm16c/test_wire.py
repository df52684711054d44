"""Simulated PM16C on its wire: the published dialogue byte by byte, motion, trigger output and the home switch."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from simulators.wires.pm16c.box import ms_per_1000_pps
from tests.simulators.pm16c_host import Wire
from tests.simulators.wires.dialogue import play, played


@pytest.fixture
def wire() -> Wire:
    return Wire()


SEARCH = "SPDH01000; SHP?0 -> NO H.P; FDHP0; ~ 30; SHP?0 -> NO H.P; STS0? -> ??{0}*; ~ 0.1; SHP?0 -> {1}; "
SEARCH += "~ 60; PS?0 -> {2}; GTHP0; ~; PS?0 -> {1}"
DIALOGUES: dict[str, tuple[dict[str, Any], str]] = {
    "a search passes the switch, remembers it and stands v squared over 2a beyond": (
        {"home_at": 30_000}, SEARCH.format("P", "+0030000", "+0030050")
    ),
    "the same backwards": ({"home_at": -30_000}, SEARCH.format("N", "-0030000", "-0030050")),
    "a new search forgets the old one and a move does not": (
        {"home_at": 500}, "SPDH01000; FDHP0; ~; ABS0+20000; ~; SHP?0 -> +0000500; FDHP0; SHP?0 -> NO H.P"
    ),
    "a limit between here and the switch ends the search": (
        {"home_at": 30_000},
        "SPDH01000; FL0+500; SETLS010000000; FDHP0; ~; STS0? -> R0S020+0000500; SHP?0 -> NO H.P",
    ),
    "the past is not turned by later moves": ({}, "ABS0+100000; ~; ABS0+0; ~; at 0.5 -> 1250; at -1 -> 0"),
    "nor by a preset": ({}, "ABS0+100000; ~; PS0-5; at 0.5 -> 1250"),
    "a preset needs a motor that stands and is not armed": (
        {},
        "train 100 200 10; PS0+7; PS?0 -> +0000000; TMGC0; ABS0+10000; PS0+7; ~ 60; PS?0 -> +0010000; "
        "ERRC; PS0+2147483648; ERRF? -> 01",
    ),
    "ready drops when the start point is passed though pulses go on": (
        {}, "train 5000 50000 5000; ABS0+60000; ~ 0.99; TMGR?0 -> YES; ~ 0.02; TMGR?0 -> NO; ~ 60; # 10"
    ),
    "it cannot be armed from inside or beyond": (
        {},
        "train 0 100 10; TMGR?0 -> NO; ERRF? -> 01; ERRC; train -5 100 10; TMGR?0 -> NO; ERRF? -> 01; ERRC; "
        "train 5 -100 10; TMGR?0 -> NO; ERRF? -> 01",
    ),
    "nor switched off or without a position controller": (
        {}, "TMGM00; train 10 100 10; TMGR?0 -> NO; TMGM05; SETCH4567; TMGR0; TMGR?0 -> NO"
    ),
    "settings of an armed trigger are not taken": (
        {},
        "train 1000 9000 1000; TMGI0500; TMGM03; TMGS0+2000; TMGI?0 -> 0001000; TMGM?0 -> 2; TMGS?0 -> +0001000; "
        "ERRF? -> 01",
    ),
    "at 10 000 pps, 10 pulses last 1 ms: of 1 ms pulses only the first rise is an edge, of 100 us all are": (
        {},
        "ABS0-30000; ~; TMGM05; train 0 1000 10; ABS0+30000; ~; # 1; ABS0-30000; ~; "
        "TMGM04; train 0 1000 10; ABS0+30000; ~; # 102",
    ),
    "only the channel on position controller A reaches the cable": (
        {}, "SETCH10--; train 100 1000 100; ABS0+2000; ~; @"
    ),
    "a fast stop takes away the pulses to come and lost ones never come": (
        {"lost": {1}}, "train 10000 90000 10000; ABS0+100000; ~ 5; ESTP0; ~; @ 10000 30000 40000"
    ),
    "more pulses than it can work out are refused at once": (
        {}, "train 1 200001 1; TMGR?0 -> NO; ERRF? -> 01; train 1 200000 1; TMGR?0 -> YES"
    ),
    "replies have the published form": (
        {},
        "VER? -> *PM16C-04XDL-SIMULATED; SETCH? -> 0123; PS?0 -> +0000000; STQ? -> R4; STS0? -> R0S000+0000000; "
        "STS7? -> R7S---+0000000; SPD?0 -> HSPD; SPDH?0 -> 0010000; RTE?0 -> 024; ERR? -> NO ERROR; ERRF? -> 00",
    ),
    "power-on trigger settings are the published ones": (
        {}, "TMGM?5 -> 5; TMGS?5 -> +0001000; TMGE?5 -> +0010000; TMGI?5 -> 0000200; TMGR?5 -> NO"
    ),
    "positions have a sign and at least seven digits": (
        {}, "ABS0-135; ~; PS?0 -> -0000135; SPDH05000000; RTE0115; ABS0+2147483647; ~; PS?0 -> +2147483647"
    ),
    "settings need remote and remote needs standing motors": (
        {},
        "LOC; ABS0+100; SPDH0500; STQ? -> L4; SPDH?0 -> 0010000; ERRF? -> 01; ERRC; REM; ABS0+100000; LOC; "
        "STQ? -> R3; ERRF? -> 01",
    ),
    "channels swap places on the position controllers": (
        {}, "SETCHB---; SETCH? -> B123; SETCH1---; SETCH? -> 1B23; SETCH-0-1; SETCH? -> 3021"
    ),
    "a moving motor takes no second move and no settings": (
        {}, "ABS0+10000; ABS0-10000; ERRF? -> 02; ERRC; RTE0050; ERRF? -> 01; ~ 60; PS?0 -> +0010000"
    ),
    "a target beyond the counter is a bad ABS": ({}, "ABS0+2147483648; ERR? -> BAD ABS COMMAND"),
    "all stops stop all": (
        {},
        "ABS0+100000; ABS5-100000; ~ 2; ASSTP; ~; STQ? -> R4; PS?0 -> +002*; PS?5 -> -00*; "
        "ABS0+100000; ABS5-100000; ~ 2; AESTP; ~; STQ? -> R4",
    ),
    "digital limits hold only while they are switched on": (
        {},
        "FL0+500; BL0-50; ABS0+1000; ~; PS?0 -> +0001000; ABS0+0; ~; SETLS010000000; ABS0+1000; ~; "
        "STS0? -> R0S020+0000500; ABS0+600; ~; STS0? -> R0S020+0000500; ABS0-1000; ~; STS0? -> R0S020-0000050; "
        "PS?0 -> -0000050; ABS0+10; ~; STS0? -> R0S000+0000010",
    ),
}  # fmt: skip


@played(DIALOGUES)
def test_it_answers_and_moves_as_the_manual_says(build: dict[str, Any], said: str) -> None:
    play(Wire(**build), said)


def test_a_stop_at_the_instant_of_a_pulse_neither_loses_nor_repeats_one() -> None:
    for k in range(8):
        wire = Wire()
        wire.train(10_000, 20_000, 1000)
        wire.tell("ABS0+40000")
        for _ in range(k):
            wire.clock.sleep(wire.line.next_after(wire.clock.now()).time - wire.clock.now())  # type: ignore[union-attr]
        wire.run("ESTP0" if k % 2 else "SSTP0")
        wire.run("ABS0+40000")
        assert wire.places() == list(range(10_000, 20_001, 1000))


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
    for command in ("SSTP0", "ABS0+0", f"ABS0{sign * 40_000:+d}"):
        wire.run(command)
    assert wire.places() == [sign * (start + k * interval) for k in range((end - start) // interval + 1)]
    assert wire.ask("TMGR?0") == "NO"


# bytes and lines


def test_a_line_without_its_end_is_not_answered_yet(wire: Wire) -> None:
    wire.box.receive(b"SPD?0\r")
    assert wire.box.transmit() == b""
    wire.box.receive(b"\n")
    assert wire.box.transmit() == b"HSPD\r\n"


UNKNOWN = b"\r\nHELLO\r\nver?\r\nPS?G\r\nABS0\r\nABS0+1.5\r\nSPDH05000001\r\nRTE0116\r\n\xff\x00\r\n VER?\r\nTMGI00"


@pytest.mark.parametrize("line", UNKNOWN.split(b"\r\n"))
def test_an_unknown_command_sets_the_command_error_and_gives_no_reply(wire: Wire, line: bytes) -> None:
    wire.box.receive(line + b"\r\n")
    assert wire.box.transmit() == b""
    play(wire, "ERRF? -> 01; ERR? -> COMMAND ERROR; ERRC; ERRF? -> 00")


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


def test_stops_are_taken_in_local_too(wire: Wire) -> None:
    wire.tell("ABS0+100000")
    wire.box.box.remote = False
    play(wire, "~ 3; ESTP0; STS0? -> ??S*")


def test_rate_codes_are_preferred_numbers_from_1000_down_to_16_thousandths() -> None:
    values = [ms_per_1000_pps(code) for code in range(116)]
    assert [values[code] for code in (0, 1, 24, 48, 72, 96, 115)] == [1000, 910, 100, 10, 1.0, 0.1, 0.016]
    assert values == sorted(values, reverse=True)
