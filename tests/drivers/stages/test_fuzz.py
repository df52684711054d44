"""Fuzzing every stage driver: whatever the controller answers, calls end in time, with a DeviceError at worst."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.base.errors import DeviceError
from drivers.base.protocols import RotationStage, TriggerTrain
from drivers.stages.zaber.axis import lrc
from simulators.wires.wire import register
from tests.drivers import pm16c_rig, zaber_rig
from tests.drivers.fuzz import FuzzedWire, Pieces, allowed, plans
from tests.drivers.stages import pi_gcs_rig
from tests.drivers.stages.rig import NAMES, StageRig
from tests.slow_cases import others_slow

TIMEOUT = 0.2
LONG = 2.0
WITHIN = 60.0
"""s; far more than all queries of a call can take, each of which ends by its timeout."""
AFTER = 10.0
"""s; by then all has come that was on its way."""
Call = Callable[[RotationStage], Any]
CALLS: list[Call] = [
    lambda stage: stage.position(),
    lambda stage: stage.moving(),
    lambda stage: stage.start_move(math.radians(20), math.radians(20)),
    lambda stage: stage.start_home(),
    lambda stage: stage.wait(LONG),
    lambda stage: stage.arm(TriggerTrain(stage.to_counts(math.radians(2)), stage.to_counts(math.radians(0.1)), 20)),
    lambda stage: stage.disarm(),
    lambda stage: stage.stop(),
    lambda stage: stage.abort(),
]


@dataclass(frozen=True)
class Fuzzed:
    """A driver whose controller's replies are fuzzed.

    Attributes:
        rig: makes its controller.
        samples: words of the controller.
        replies_to_open: how many come before the stage is open, all sound.
        disarmed: that no trigger is armed, by the controller itself.
        counts: where the controller itself is by its own counter; else the driver's counts are the true angle's.
        wire: puts the pieces of a plan in the place of replies.
    """

    rig: Callable[[], StageRig]
    samples: Sequence[bytes]
    replies_to_open: int
    disarmed: Callable[[Any], bool]
    counts: Callable[[Any], int] | None = None
    wire: Callable[[Any, Sequence[Pieces | None]], FuzzedWire] = FuzzedWire


# A damaged reply of a Zaber often has the id that is waited for and the checksum of what it became: these two must not
# be all that keeps junk out.
HEAD, SEAL = b"@ID", b"~"
"""Stand for device, axis and id of the reply that is waited for, and for the checksum of what is before it."""
NUMBERS = ("0", "1", "360000", "-100000", "7.38", "9" * 12, "9" * 400)
DATA = (*NUMBERS, "BADDATA", "AGAIN", "2 WR FS", "01 NI", "d d d d d d", "e 5 d d d d")
ZABER = [
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


class Undecoded(zaber_rig.Rig):
    """A rig that takes any bytes."""

    def receive(self, data: bytes) -> None:
        self.controller.receive(data)


PM16C = [
        b"1.50 17-04-01 PM16C-04XDL-SIMULATED\r\n", b"RBS000+0000000\r\n", b"RBP007+0000100\r\n",
        b"RBS040-0000100\r\n", b"RBS---+2147483647\r\n", b"B123\r\n", b"+0000000\r\n", b"-0000135\r\n",
        b"0002500\r\n", b"017\r\n", b"HSPD\r\n", b"YES\r\n", b"NO\r\n", b"NO H.P\r\n", b"R4\r\n", b"NO ERROR\r\n",
        b"00000000\r\n", b"STOPB\r\n",
    ]  # fmt: skip
PI_GCS = [
        b"(c)2026 Physik Instrumente (PI) GmbH & Co. KG, C-863.12, 0, 1.2.1.0\n", b"2.0\n", b"0\n", b"1\n", b"5\n",
        b"10\n", b"1024\n", b"1=0\n", b"1=1\n", b"1=-12.500000\n", b"1=1.79769e+308\n", b"1 0xE=90000.000000\n",
        b"1=1.5000 \n2=-3.2500\n", b"2 8=0.000000\n", b"2=1\n", b"0x9005\n", b"\xb0\n", b"\xb1\n",
    ]  # fmt: skip
FUZZED = {
    "pm16c": Fuzzed(
        lambda: pm16c_rig.Rig(home_at=300),
        PM16C,
        pm16c_rig.QUERIES_TO_OPEN,
        disarmed=lambda rig: rig.say("TMGR?B") == "NO",
        counts=lambda rig: rig.controller.box.sample.position(),
    ),
    # *IDN? CSV? ERR? SAI? #5 ERR? SPA? SPA? ERR? TRO? SVO? ERR? SVO? ERR? ACC? ERR? DEC? TMN? TMX?
    "pi_gcs": Fuzzed(pi_gcs_rig.Rig, PI_GCS, 22, disarmed=lambda rig: not rig.controller.box.outputs[2].on),
    "zaber": Fuzzed(
        Undecoded,
        ZABER,
        zaber_rig.REPLIES_TO_OPEN,
        disarmed=lambda rig: rig.say("/1 0 trigger show") == "d d d d d d",
        wire=Knowing,
    ),
}


def opened(rig: StageRig, wire: FuzzedWire) -> RotationStage | DeviceError:
    rig.url = register(next(NAMES), wire)
    return allowed(lambda: rig.open(timeout=TIMEOUT), rig.clock, WITHIN)


@pytest.mark.parametrize("kind", others_slow(FUZZED))
@given(data=st.data())
def test_fuzz_opening_opens_or_says_why(kind: str, data: st.DataObject) -> None:
    """And once the line is sound it opens."""
    fuzzed = FUZZED[kind]
    plan = data.draw(plans(fuzzed.samples))
    rig = fuzzed.rig()
    wire = fuzzed.wire(rig.controller, plan)
    stage = opened(rig, wire)
    if isinstance(stage, DeviceError):
        wire.end()
        rig.clock.sleep(AFTER)
        stage = allowed(lambda: rig.open(timeout=TIMEOUT), rig.clock, WITHIN)
        assert not isinstance(stage, DeviceError)
    stage.close()


@pytest.mark.parametrize("kind", others_slow(FUZZED))
@given(data=st.data(), calls=st.lists(st.sampled_from(CALLS), min_size=1, max_size=8))
def test_fuzz_every_call_ends_in_time_and_the_stage_can_be_used_again(
    kind: str, data: st.DataObject, calls: list[Call]
) -> None:
    """Once the line is sound it can be stopped, disarmed, searches its reference, and moves to whole counts."""
    fuzzed = FUZZED[kind]
    plan = data.draw(plans(fuzzed.samples))
    rig = fuzzed.rig()
    sound: list[Pieces | None] = [None] * fuzzed.replies_to_open
    wire = fuzzed.wire(rig.controller, sound + plan)
    stage = opened(rig, wire)
    assert not isinstance(stage, DeviceError)
    assert wire.replies == fuzzed.replies_to_open
    for call in calls:
        result = allowed(lambda: call(stage), rig.clock, WITHIN)  # noqa: B023
        assert isinstance(result, None | bool | int | float | DeviceError)
    wire.end()
    rig.clock.sleep(AFTER)
    for _ in range(3):  # what had come before, its remains, and then the stop itself
        stopped = allowed(stage.stop, rig.clock, WITHIN)
    assert not isinstance(stopped, DeviceError)
    where = rig.line.angle_at(rig.clock.now())
    assert stage.to_counts(stage.position()) == (
        stage.to_counts(where) if fuzzed.counts is None else fuzzed.counts(rig)
    )
    rig.clock.sleep(AFTER)
    assert rig.line.angle_at(rig.clock.now()) == where
    stage.disarm()
    assert fuzzed.disarmed(rig)
    stage.start_home()
    stage.wait(WITHIN)
    stage.start_move(math.radians(1), math.radians(20))
    degree = stage.limits.counts_per_turn // 360
    assert stage.to_counts(stage.wait(LONG)) == degree
    assert stage.to_counts(stage.position()) == degree
    stage.close()
