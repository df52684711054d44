"""Fuzz of the PI GCS 2.0 driver and its stand-in: calls end in time, with nothing but DeviceError; both come back."""

from __future__ import annotations

import math
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import DeviceError
from drivers.protocols import StageStatus, TriggerTrain
from drivers.stages.pi_gcs import PiGcsStage
from simulators.serial_url import register
from tests.drivers.fuzz import FuzzedWire, Pieces, allowed, plans, received
from tests.drivers.stages.pi_gcs_rig import NAMES, Rig

TIMEOUT = 0.2
LONG = 2.0
WITHIN = 60.0
"""s; far more than all queries of a call can take, each of which ends by its timeout."""
REPLIES_TO_OPEN = 19
"""*IDN? CSV? ERR? SAI? #5 ERR? SPA? SPA? ERR? TRO? SVO? ERR? SVO? ERR? ACC? ERR? DEC? TMN? TMX?"""
SAMPLES = [
    b"(c)2026 Physik Instrumente (PI) GmbH & Co. KG, C-863.12, 0, 1.2.1.0\n",
    b"2.0\n",
    b"0\n",
    b"1\n",
    b"5\n",
    b"10\n",
    b"1024\n",
    b"1=0\n",
    b"1=1\n",
    b"1=-12.500000\n",
    b"1=1.79769e+308\n",
    b"1 0xE=90000.000000\n",
    b"1=1.5000 \n2=-3.2500\n",
    b"2 8=0.000000\n",
    b"2=1\n",
    b"0x9005\n",
    b"\xb0\n",
    b"\xb1\n",
]
COMMANDS = [
    b"*IDN?\n", b"ERR?\n", b"SVO 1 1\n", b"SVO 1 0\n", b"FRF 1\n", b"FNL 1\n", b"MOV 1 10.5\n", b"MVR 1 -1e0\n",
    b"VEL 1 20\n", b"ACC 1 9\n", b"SPA 1 0xB 5\n", b"SPA? 1 0xE\n", b"CTO 1 1 0.1\n", b"CTO 1 8 1\n", b"CTO 1 9 0.5\n",
    b"CTO 1 3 0\n", b"CTO? 1 9\n", b"TRO 1 1\n", b"TRO?\n", b"POS?\n", b"HLT 1\n", b"STP\n",
    b"\x03", b"\x04", b"\x05", b"\x07", b"\x18",
]  # fmt: skip
CALLS: list[Any] = [
    lambda stage: stage.position(),
    lambda stage: stage.status(),
    lambda stage: stage.moving(),
    lambda stage: stage.start_move(math.radians(20), math.radians(20)),
    lambda stage: stage.start_home(),
    lambda stage: stage.wait(LONG),
    lambda stage: stage.arm(TriggerTrain(500, 25, 20)),
    lambda stage: stage.disarm(),
    lambda stage: stage.stop(),
    lambda stage: stage.abort(),
]


def opened(rig: Rig, wire: FuzzedWire) -> PiGcsStage | DeviceError:
    rig.url = register(next(NAMES), wire)
    return allowed(lambda: rig.open(timeout=TIMEOUT), rig.clock, WITHIN)


@given(plans(SAMPLES))
def test_fuzz_opening_opens_or_says_why(plan: list[Pieces | None]) -> None:
    rig = Rig()
    wire = FuzzedWire(rig.controller, plan)
    stage = opened(rig, wire)
    if isinstance(stage, DeviceError):
        wire.end()
        rig.clock.sleep(10.0)
        found = allowed(lambda: rig.open(timeout=TIMEOUT), rig.clock, WITHIN)
        assert isinstance(found, PiGcsStage)
        found.close()
    else:
        stage.close()


@given(plans(SAMPLES), st.lists(st.sampled_from(CALLS), min_size=1, max_size=8))
def test_fuzz_every_call_ends_in_time_and_the_stage_can_be_used_again(
    plan: list[Pieces | None], calls: list[Any]
) -> None:
    rig = Rig()
    quiet: list[Pieces | None] = [None] * REPLIES_TO_OPEN
    wire = FuzzedWire(rig.controller, quiet + plan)
    stage = opened(rig, wire)
    assert isinstance(stage, PiGcsStage)
    assert rig.controller.replies == REPLIES_TO_OPEN
    for call in calls:
        result = allowed(lambda: call(stage), rig.clock, WITHIN)  # noqa: B023
        assert isinstance(result, None | bool | float | StageStatus | DeviceError)
    wire.end()
    rig.clock.sleep(10.0)
    for _ in range(3):  # what had come before, its remains, and then the stop itself
        stopped = allowed(stage.stop, rig.clock, WITHIN)
    assert not isinstance(stopped, DeviceError)
    assert not rig.controller.box.axis.moving()
    stage.disarm()
    assert not rig.controller.box.outputs[2].on
    stage.start_home()
    stage.wait(60.0)
    stage.start_move(math.radians(1), math.radians(20))
    assert stage.to_counts(stage.wait(LONG)) == 250
    assert stage.status().counts == 250
    stage.close()


@given(st.lists(st.tuples(received(COMMANDS), st.floats(0.0, 3.0)), max_size=12))
def test_fuzz_whatever_the_stand_in_receives_it_answers_on(story: list[tuple[bytes, float]]) -> None:
    """Its replies end with LF, its moves stay within its travel, and the next sound query is answered."""
    rig = Rig(low=-30.0, high=30.0)
    for data, seconds in story:
        rig.controller.receive(data)
        rig.clock.sleep(seconds)
        replies = rig.controller.transmit()
        assert replies == b"" or replies.endswith(b"\n")
        assert abs(math.degrees(rig.line.angle_at(rig.clock.now()))) <= 30.0
    rig.say("", "")
    assert rig.say("CSV?") == "2.0"
    assert rig.say("POS? 1").startswith("1=")
    rig.say(b"\x18", "ERR?")
    assert rig.say("ERR?") == "0"
