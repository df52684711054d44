"""Simulated Zaber on its wire: packets by published test vectors, settings, motion, and the rules of triggers."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from tests.drivers.stages.flat_settings import flat
from tests.drivers.zaber_vectors import VECTORS
from tests.simulators.wires.zaber.host import SPEED, TURN, Wire
from tests.simulators.wires.zaber.triggers import Triggers
from tests.simulators.wires.zaber.wire import Command, Fault, PacketReader, ZaberBuild, frame, lrc


@pytest.fixture
def wire() -> Wire:
    return Wire()


PULSE = "io set do 1 1 schedule 1 0"


def set_up(wire: Wire, condition: str, action: str = PULSE, number: int = 1, enable: str = "enable") -> None:
    wire.do(f"trigger {number} when {condition}", f"trigger {number} action a {action}", f"trigger {number} {enable}")


# distances


@given(st.integers(1, 4000), st.integers(-500, 500))
def test_pulse_times_are_those_of_the_closed_form(distance: int, start: int) -> None:
    wire = Wire()
    wire.run(f"move abs {start}")
    set_up(wire, f"1 dist {distance}", enable="enable 40", action="io set do 1 1 schedule 0.001 0")
    begun = wire.clock.now()
    wire.run("move rel 100000")
    ramp = SPEED / wire.acceleration
    way = 0.5 * SPEED * ramp
    for k, pulse in enumerate(wire.pulses(), 1):
        gone = k * distance
        left = 100_000 - gone
        if gone < way:
            expected = math.sqrt(2 * gone / wire.acceleration)
        elif left >= way:
            expected = ramp + (gone - way) / SPEED
        else:
            expected = 100_000 / SPEED + ramp - math.sqrt(2 * left / wire.acceleration)
        assert pulse.time - begun == pytest.approx(expected, abs=1e-9)
        assert pulse.angle == pytest.approx((start + gone) * 2 * math.pi / TURN)
    assert len(wire.pulses()) == min(40, 100_000 // distance)


def test_a_distance_is_counted_both_ways_from_the_last_fire(wire: Wire) -> None:
    set_up(wire, "1 dist 500")
    wire.run("move abs 700")
    wire.run("move abs -100")
    wire.run("move abs 20")
    assert wire.counts() == [500, 0]


def test_a_count_disables_it_and_is_told(wire: Wire) -> None:
    set_up(wire, "1 dist 500", enable="enable 3")
    assert wire.data("trigger show") == "3 d d d d d"
    wire.do("move abs 9000")
    wire.clock.sleep(0.22)
    assert wire.data("trigger show") == "1 d d d d d"
    wire.clock.sleep(60.0)
    assert wire.data("trigger show") == "d d d d d d"
    assert wire.counts() == [500, 1000, 1500]


def test_without_a_count_it_goes_on_until_disabled(wire: Wire) -> None:
    set_up(wire, "1 dist 500")
    wire.run("move abs 1200")
    assert wire.data("trigger show") == "e d d d d d"
    wire.run("trigger 1 disable", "move abs 5000")
    assert wire.counts() == [500, 1000]


# comparisons


@pytest.mark.parametrize(
    ("condition", "edges"),
    [
        ("1 pos >= 300", [300]),
        ("1 pos <= 300", [0, 300]),
        ("1 encoder.pos <= -200", [-200]),
    ],
)
def test_a_comparison_fires_when_it_turns_true(wire: Wire, condition: str, edges: list[int]) -> None:
    """From 0 to 1000, to -1000 and back to 0."""
    set_up(wire, condition, "io set do 1 1 schedule 0.001 0")
    wire.run("move abs 1000")
    wire.run("move abs -1000")
    wire.run("move abs 0")
    assert wire.counts() == edges


def test_triggers_that_set_each_other_off_come_to_an_end(wire: Wire) -> None:
    wire.do("trigger 1 when 1 pos >= 10", "trigger 2 when 1 pos >= 10")
    wire.do("trigger 1 action a trigger 2 enable 1", "trigger 2 action a trigger 1 enable 1", "trigger 1 enable 1")
    wire.run("move abs 1000")
    assert wire.data("get pos", axis=1) == "1000"


# outputs, time, inputs, settings


def test_a_scheduled_value_comes_after_its_time_and_a_new_one_cancels_it(wire: Wire) -> None:
    wire.do("io set do 1 1 schedule 20 0")
    wire.clock.sleep(0.019)
    assert wire.data("io get do 1") == "1"
    wire.clock.sleep(0.002)
    assert wire.data("io get do") == "0 0 0 0"
    wire.do("io set do 1 1 schedule 20 0", "io set do 1 1")
    wire.clock.sleep(1.0)
    assert wire.data("io get do 1") == "1"
    assert [round(pulse.time, 6) for pulse in wire.pulses()] == [0.0, 0.021]


def test_pulses_wider_than_their_distance_in_time_merge(wire: Wire) -> None:
    set_up(wire, "1 dist 500", "io set do 1 1 schedule 60 0")
    wire.run("move abs 90000")
    assert len(wire.pulses()) < 90


def test_predicted_edges_happen() -> None:
    """The copy that looks ahead leaves the triggers as they are."""
    wire = Wire()
    set_up(wire, "1 dist 300", "io set do 1 t", enable="enable 7")
    wire.do("move abs 5000")
    triggers: Triggers = wire.box.device.triggers
    predicted = triggers.predicted(60.0)
    assert triggers.edges == []
    for _ in range(100):
        wire.clock.sleep(0.013)
        wire.tell("/1")
    assert triggers.edges == predicted
    assert len(predicted) == 7


# packets


@pytest.mark.parametrize("packet", VECTORS)
def test_checksums_are_the_published_ones(packet: str) -> None:
    body, _, checksum = packet[1:].partition(":")
    assert lrc(body.encode()) == checksum
    assert frame(packet[0] + body, checksum=True) == packet.encode() + b"\r\n"


@pytest.mark.parametrize(
    ("packet", "command"),
    [
        (b"/", Command(0, 0, "", ())),
        (b"/1", Command(1, 0, "", ())),
        (b"/2 1:7D", Command(2, 1, "", ())),
        (b"/0 0 5:2B", Command(0, 0, "5", ())),
        (b"/get maxspeed:49", Command(0, 0, "", ("get", "maxspeed"))),
        (b"/1 1 19 move abs 1000:E6", Command(1, 1, "19", ("move", "abs", "1000"))),
        (b"/1 0 -- get pos", Command(1, 0, "--", ("get", "pos"))),
        (b"/1 2 3 4 5", Command(1, 2, "3", ("4", "5"))),
    ],
)
@pytest.mark.parametrize("end", [b"\n", b"\r", b"\r\n"])
def test_numbers_at_the_start_are_address_axis_and_id(packet: bytes, command: Command, end: bytes) -> None:
    assert PacketReader().feed(packet + end) == [command]


@pytest.mark.parametrize(
    "packet", [b"/1:00", b"/1:C", b"/1:", b"x/1", b"/1 \xff", b"1 home", b"@01 1 OK", b"/1 " + b"w " * 40]
)
def test_a_packet_that_is_damaged_gets_no_answer_and_the_next_one_does(wire: Wire, packet: bytes) -> None:
    wire.box.receive(packet + b"\n")
    assert wire.box.transmit() == b""
    assert wire.ask("/1 1") == "@01 1 OK IDLE -- 0"


def test_words_and_ids_out_of_bounds_are_refused(wire: Wire) -> None:
    assert wire.ask("/1 0 7 " + "w" * 51) == "@01 0 7 RJ IDLE -- LONGWORD"
    assert wire.ask("/1 0 100 home") == "@01 0 RJ IDLE -- BADMESSAGEID"


VOCABULARY = """
    trigger 1 2 3 6 7 when action a b io set do di dist pos >= <= == 100 2000 -50 encoder abs time enable disable
    print schedule 0 t none move rel vel stop estop home show get maxspeed = += driver warnings clear cont echo tools
"""
WORDS = st.sampled_from(VOCABULARY.split())


@given(st.lists(st.lists(WORDS, max_size=9), max_size=30))
def test_any_sequence_of_its_own_words_leaves_it_answering(commands: list[list[str]]) -> None:
    wire = Wire()
    for words in commands:
        wire.tell("/1 0 " + " ".join(words), "/1 1 " + " ".join(words))
        wire.clock.sleep(0.2)
    assert wire.ask("/1 0 55 get version").startswith("@01 0 55 OK ")


def test_another_devices_packets_are_not_answered_and_everybodys_are(wire: Wire) -> None:
    assert wire.tell("/2 1 get pos") == ""
    assert wire.ask("/0 0 get comm.address") == "@01 0 OK IDLE -- 1"
    assert wire.ask("/1 2 get pos") == "@01 2 RJ IDLE -- BADAXIS"


def test_info_lines_follow_their_reply_and_an_empty_command_ends_them(wire: Wire) -> None:
    wire.do("trigger 1 when 1 dist 100", "trigger 1 action a io set do 1 t", "trigger 1 enable 5")
    assert wire.tell("/1 0 7 trigger 1 print", "/1 0 7").split("\r\n") == [
        "@01 0 7 OK IDLE -- 0",
        "#01 0 7 when 1 dist 100",
        "#01 0 7 action a io set do 1 t",
        "#01 0 7 action b none",
        "#01 0 7 enable 5",
        "@01 0 7 OK IDLE -- 0",
        "",
    ]


def test_an_alert_comes_when_a_move_ends_and_only_if_wanted(wire: Wire) -> None:
    wire.run("move abs 1000")
    assert wire.tell() == ""
    wire.do("set comm.alert 1", "move abs 0")
    assert wire.tell() == ""
    wire.clock.sleep(60.0)
    assert wire.tell() == "!01 1 IDLE --\r\n"
    assert wire.tell() == ""


# settings


def test_identity_and_settings(wire: Wire) -> None:
    told = {"device.id": "50952", "system.serial": "123456", "version": "7.38", "trigger.numactions": "2"}
    assert {setting: wire.data(f"get {setting}") for setting in told} == told
    assert wire.data("get limit.cycle.dist", axis=1) == str(TURN)
    assert wire.ask("/1 0 get deviceid") == "@01 0 RJ IDLE -- BADCOMMAND"
    assert Wire(identity="deviceid").data("get deviceid") == "50952"


@pytest.mark.parametrize(
    ("packet", "reason"),
    [
        ("/1 1 set maxspeed 0", "BADDATA"),
        ("/1 1 set maxspeed fast", "BADDATA"),
        ("/1 1 set pos 5", "BADCOMMAND"),
        ("/1 1 get version", "DEVICEONLY"),
        ("/1 1 move abs 2000000001", "BADDATA"),
        ("/1 1 move abs", "BADCOMMAND"),
        ("/1 0 trigger 7 enable", "BADDATA"),
        ("/1 0 trigger 1 enable", "BADDATA"),
        ("/1 0 trigger 1 when 1 dist 0", "BADDATA"),
        ("/1 0 trigger 1 action a fly", "BADDATA"),
        ("/1 0 io set do 5 1", "BADCOMMAND"),
    ],
)
def test_what_it_cannot_do_is_rejected_with_the_reason(wire: Wire, packet: str, reason: str) -> None:
    assert wire.ask(packet).endswith(f"RJ IDLE -- {reason}")


# motion


def test_relative_moves_and_the_ends_of_travel() -> None:
    wire = Wire(low=-3000, high=5000)
    for move, position in (("rel 700", 700), ("rel -900", -200)):
        wire.run(f"move {move}")
        assert wire.data("get pos", axis=1) == str(position)
    assert wire.ask("/1 1 move abs 5001").endswith("RJ IDLE -- BADDATA")


def test_a_move_under_way_is_not_changed(wire: Wire) -> None:
    wire.do("move abs 30000")
    assert wire.ask("/1 1 move abs 0").endswith("RJ BUSY -- STATUSBUSY")
    assert wire.ask("/1 1 home").endswith("RJ BUSY -- STATUSBUSY")


# faults on the line


def test_faults_befall_the_replies_that_they_are_set_for() -> None:
    wire = Wire(faults=dict(enumerate(Fault, 3)))
    wire.tell("/1 0 set comm.checksum 1")
    replies = {fault: wire.tell("/1 1 7 get pos") for fault in Fault}
    assert replies == {
        Fault.SILENT: "",
        Fault.WRONG_CHECKSUM: "@81 1 7 OK IDLE -- 0:35\r\n",
        Fault.TRUNCATED: "@01 1 7 OK I",
        Fault.NOISE: "\\xfe\x00@01 1 7 OK IDLE -- 0:35\r\n",
        Fault.ALERT: "!01 1 IDLE --:96\r\n@01 1 7 OK IDLE -- 0:35\r\n",
        Fault.OTHER_ID: "@01 1 42 OK IDLE -- 0:06\r\n",
        Fault.AGAIN: "@01 1 7 RJ IDLE -- AGAIN:03\r\n",
    }


class Passing(VirtualClock):
    """A clock on which a millisecond passes at every look."""

    def now(self) -> float:
        self.sleep(1e-3)
        return super().now()


def test_a_reply_that_says_idle_never_shows_a_place_on_the_way() -> None:
    """However the end of the move falls between the looks at the clock that a reply takes."""
    for late in range(40):
        clock = Passing(start=0.0)
        box = flat(ZaberBuild, counts_per_turn=TURN).controller(clock, TriggerLine(clock))
        box.receive(b"/1 1 move abs 1000\n")
        clock.sleep(late * 0.25e-3)
        reply = "BUSY"
        while "BUSY" in reply:
            box.transmit()
            box.receive(b"/1 1 get pos\n")
            reply = box.transmit().decode()
        assert reply.split()[4:] == ["--", "1000"], late
