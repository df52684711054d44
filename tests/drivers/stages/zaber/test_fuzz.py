"""Fuzz of the Zaber driver: whatever the device seems to say, calls end in time, with DeviceError at worst.

A damaged reply often has the id that is waited for and the checksum of what it became: these two must not be all that
keeps junk out.
"""

from __future__ import annotations

import re

from hypothesis import given
from hypothesis import strategies as st

from drivers.stages.zaber.packet import lrc
from tests.drivers.fuzz import FuzzedWire, Pieces, plans
from tests.drivers.stages.fuzz_laws import (
    CALLS,
    Call,
    Fuzzed,
    every_call_ends_in_time_and_the_stage_can_be_used_again,
    opening_opens_or_says_why,
)
from tests.drivers.zaber_rig import REPLIES_TO_OPEN, Rig

HEAD, SEAL = b"@ID", b"~"
"""Stand for device, axis and id of the reply that is waited for, and for the checksum of what is before it."""
NUMBERS = ("0", "1", "360000", "-100000", "7.38", "9" * 12, "9" * 400)
DATA = (*NUMBERS, "BADDATA", "AGAIN", "2 WR FS", "01 NI", "d d d d d d", "e 5 d d d d")
SAMPLES = [
    b" ".join((HEAD, answer, data.encode())) + SEAL + b"\r\n"
    for answer in (b"OK IDLE --", b"OK BUSY WR", b"OK IDLE FS", b"RJ IDLE --")
    for data in DATA
] + [b"@01 1 98 OK IDLE -- 0~\r\n", b"!01 1 IDLE --\r\n", b"#01 0 trigger 1\r\n", b"/1 1 16 get pos\r\n"]


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


class Undecoded(Rig):
    """A rig that takes any bytes."""

    def receive(self, data: bytes) -> None:
        self.controller.receive(data)


ZABER = Fuzzed(
    Undecoded,
    REPLIES_TO_OPEN,
    disarmed=lambda rig: rig.say("/1 0 trigger show") == "d d d d d d",
    wire=Knowing,
)


@given(plans(SAMPLES))
def test_fuzz_opening_opens_or_says_why(plan: list[Pieces | None]) -> None:
    opening_opens_or_says_why(ZABER, plan)


@given(plans(SAMPLES), st.lists(st.sampled_from(CALLS), min_size=1, max_size=8))
def test_fuzz_every_call_ends_in_time_and_the_stage_can_be_used_again(
    plan: list[Pieces | None], calls: list[Call]
) -> None:
    every_call_ends_in_time_and_the_stage_can_be_used_again(ZABER, plan, calls)
