"""Fuzz of the Zaber driver and its stand-in: calls end in time, with nothing but DeviceError; both come back.

A damaged reply often has the id that is waited for and the checksum of what it became: these two must not be all that
keeps junk out.
"""

from __future__ import annotations

import math
import re
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import DeviceError
from drivers.protocols import StageStatus, TriggerTrain
from drivers.stages.zaber import ZaberStage
from drivers.stages.zaber_packet import lrc
from simulators.serial_url import register
from tests.drivers.fuzz import FuzzedWire, Pieces, allowed, plans, received
from tests.drivers.zaber_rig import NAMES, REPLIES_TO_OPEN, Rig

TIMEOUT = 0.2
LONG = 2.0
WITHIN = 60.0
"""s; far more than all queries of a call can take, each of which ends by its timeout."""
HEAD, SEAL = b"@ID", b"~"
"""Stand for device, axis and id of the reply that is waited for, and for the checksum of what is before it."""
NUMBERS = ("0", "1", "360000", "-100000", "7.38", "9" * 12, "9" * 400)
DATA = (*NUMBERS, "BADDATA", "AGAIN", "2 WR FS", "01 NI", "d d d d d d", "e 5 d d d d")
SAMPLES = [
    b" ".join((HEAD, answer, data.encode())) + SEAL + b"\r\n"
    for answer in (b"OK IDLE --", b"OK BUSY WR", b"OK IDLE FS", b"RJ IDLE --")
    for data in DATA
] + [b"@01 1 98 OK IDLE -- 0~\r\n", b"!01 1 IDLE --\r\n", b"#01 0 trigger 1\r\n", b"/1 1 16 get pos\r\n"]
COMMANDS = [
    f"/1 {words}\n".encode()
    for words in (
        "", "0 get version", "1 get pos", "0 set comm.checksum 1", "0 set comm.alert 1", "1 set maxspeed 16384",
        "1 set accel 8", "1 move abs 100000", "1 move rel -500", "1 move vel 20000", "1 home", "1 stop", "1 estop",
        "0 trigger 1 when 1 dist 100", "0 trigger 2 when 1 pos >= 500", "0 trigger 1 action a io set do 1 t",
        "0 trigger 2 action b trigger 1 enable 5", "0 trigger 1 enable 9", "0 trigger 2 enable", "0 trigger show",
        "0 io set do 1 1 schedule 1 0", "0 io get do 1", "1 warnings clear", "0 1 get pos:7D",
    )
]  # fmt: skip
CALLS: list[Any] = [
    lambda stage: stage.position(),
    lambda stage: stage.status(),
    lambda stage: stage.moving(),
    lambda stage: stage.start_move(math.radians(20), math.radians(20)),
    lambda stage: stage.start_home(),
    lambda stage: stage.wait(LONG),
    lambda stage: stage.arm(TriggerTrain(5000, 500, 20)),
    lambda stage: stage.remaining_pulses(),
    lambda stage: stage.disarm(),
    lambda stage: stage.stop(),
    lambda stage: stage.abort(),
]


class Knowing(FuzzedWire):
    """Puts in what a damaged reply cannot know before: the id that is waited for, and its own checksum."""

    _head = HEAD

    def receive(self, data: bytes) -> None:
        if request := re.match(rb"/(\d) (\d \d\d) ", data):
            self._head = b"@0" + request[1] + b" " + request[2]
        super().receive(data)

    def transmit(self) -> bytes:
        data = super().transmit().replace(HEAD, self._head)
        return re.sub(rb"@([\x20-\x7d]*)~", lambda line: b"@%b:%b" % (line[1], lrc(line[1].decode()).encode()), data)


class Fuzzed(Rig):
    """A rig that takes any bytes."""

    def receive(self, data: bytes) -> None:
        self.controller.receive(data)


def opened(rig: Rig, wire: Knowing) -> ZaberStage | DeviceError:
    rig.url = register(next(NAMES), wire)
    return allowed(lambda: rig.open(timeout=TIMEOUT), rig.clock, WITHIN)


@given(plans(SAMPLES))
def test_fuzz_opening_opens_or_says_why(plan: list[Pieces | None]) -> None:
    rig = Fuzzed()
    wire = Knowing(rig.controller, plan)
    stage = opened(rig, wire)
    wire.end()
    rig.clock.sleep(10.0)
    if isinstance(stage, DeviceError):
        found = allowed(lambda: rig.open(timeout=TIMEOUT), rig.clock, WITHIN)
        assert isinstance(found, ZaberStage)
        found.close()
    else:
        stage.close()


@given(plans(SAMPLES), st.lists(st.sampled_from(CALLS), min_size=1, max_size=8))
def test_fuzz_every_call_ends_in_time_and_the_stage_can_be_used_again(
    plan: list[Pieces | None], calls: list[Any]
) -> None:
    rig = Fuzzed()
    quiet: list[Pieces | None] = [None] * REPLIES_TO_OPEN
    wire = Knowing(rig.controller, quiet + plan)
    stage = opened(rig, wire)
    assert isinstance(stage, ZaberStage)
    assert rig.controller.replies == REPLIES_TO_OPEN
    for call in calls:
        result = allowed(lambda: call(stage), rig.clock, WITHIN)  # noqa: B023
        assert isinstance(result, None | bool | int | float | StageStatus | DeviceError)
    wire.end()
    rig.clock.sleep(10.0)
    for _ in range(3):  # what had come before, its remains, and then the stop itself
        stopped = allowed(stage.stop, rig.clock, WITHIN)
    assert not isinstance(stopped, DeviceError)
    assert not rig.controller.device.axis.moving(rig.clock.now())
    stage.disarm()
    stage.start_home()
    stage.wait(60.0)
    stage.start_move(math.radians(1), math.radians(20))
    assert stage.to_counts(stage.wait(LONG)) == 1000
    assert stage.status().counts == 1000
    stage.close()


@given(st.lists(st.tuples(received(COMMANDS), st.floats(0.0, 3.0)), max_size=12))
def test_fuzz_whatever_the_stand_in_receives_it_answers_on(story: list[tuple[bytes, float]]) -> None:
    """Its lines end with CR LF, and the next sound command is understood."""
    rig = Fuzzed()
    for data, seconds in story:
        rig.controller.receive(data)
        rig.clock.sleep(seconds)
        sent = rig.controller.transmit()
        assert sent == b"" or sent.endswith(b"\r\n")
    rig.controller.receive(b"\n")
    rig.controller.transmit()
    rig.say("/1 0 set comm.alert 0", "/1 0 set comm.checksum 0", "/1 1 estop")
    rig.controller.transmit()
    assert rig.say("/1 0 get version") == "7.38"
    assert not rig.controller.device.axis.moving(rig.clock.now())
