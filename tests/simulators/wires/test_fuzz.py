"""Fuzz of the simulated controllers: no bytes stop them, their lines are whole, and a sound one is understood then."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.wires.wire import BytesWire
from tests.drivers import zaber_rig
from tests.drivers.fuzz import received, replies
from tests.drivers.stages import pi_gcs_rig
from tests.simulators.pm16c_host import Wire

Story = list[tuple[bytes, float]]
PI_GCS = [
    b"*IDN?\n", b"ERR?\n", b"SVO 1 1\n", b"SVO 1 0\n", b"FRF 1\n", b"FNL 1\n", b"MOV 1 10.5\n", b"MVR 1 -1e0\n",
    b"VEL 1 20\n", b"ACC 1 9\n", b"SPA 1 0xB 5\n", b"SPA? 1 0xE\n", b"CTO 1 1 0.1\n", b"CTO 1 8 1\n", b"CTO 1 9 0.5\n",
    b"CTO 1 3 0\n", b"CTO? 1 9\n", b"TRO 1 1\n", b"TRO?\n", b"POS?\n", b"HLT 1\n", b"STP\n",
    b"\x03", b"\x04", b"\x05", b"\x07", b"\x18",
]  # fmt: skip
PM16C = [
    f"{command}\r\n".encode()
    for command in (
        "VER?", "SETCH?", "SETCH3210", "PS?0", "PS0+100", "SPD?0", "SPDH0100", "SPDH0", "RTE0115", "FL0+100", "BL0-100",
        "SETLS010000000", "STS0?", "STSF?", "STQ?", "ERR?", "ERRF?", "TMGM03", "TMGS0+100", "TMGE0+2147483647",
        "TMGI01", "TMGR0", "TMGR?0", "TMGC0", "REM", "LOC", "SSTP0", "ESTP0", "ASSTP", "AESTP", "ERRC",
        "ABS0+2147483647", "ABS0-999999999999", "REL0+90000", "FDHP0", "GTHP0", "SHP?0",
    )
]  # fmt: skip

Box = Callable[[], BytesWire]


@pytest.mark.parametrize(
    ("box", "asked", "answer"),
    [
        (
            lambda: pi_gcs_rig.Rig(wire={"latency": 0.0}).controller,
            b"POS? 1\nCSV?\n\x05TRO?\n",
            b"1=0.000000\n2.0\n0\n1=0 \n2=0 \n3=0 \n4=0\n",
        ),
        (lambda: Wire().box, b"PS?0\r\nSTQ?\r\nSPD?0\r\n", b"+0000000\r\nR4\r\nHSPD\r\n"),
        (
            lambda: zaber_rig.Rig().controller,
            b"/1 1 1\n/1 0 2 get version\r\n/1 1 3 get pos\r",
            b"@01 1 1 OK IDLE -- 0\r\n@01 0 2 OK IDLE -- 7.38\r\n@01 1 3 OK IDLE -- 0\r\n",
        ),
    ],
    ids=["pi_gcs", "pm16c", "zaber"],
)
@given(sizes=st.lists(st.integers(1, 9), max_size=14))
def test_bytes_may_come_in_pieces_of_any_size(box: Box, asked: bytes, answer: bytes, sizes: list[int]) -> None:
    controller = box()
    for size in sizes:
        controller.receive(asked[:size])
        asked = asked[size:]
    controller.receive(asked)
    assert controller.transmit() == answer


@given(st.lists(st.tuples(received(PI_GCS), st.floats(0.0, 3.0)), max_size=12))
def test_fuzz_pi_gcs_answers_on_and_stays_within_its_travel(story: Story) -> None:
    rig = pi_gcs_rig.Rig(low=-30.0, high=30.0)
    for _ in replies(rig.controller, story, b"\n"):
        assert abs(math.degrees(rig.line.angle_at(rig.clock.now()))) <= 30.0
    rig.say("", "")
    assert rig.say("CSV?") == "2.0"
    assert rig.say("POS? 1").startswith("1=")
    rig.say(b"\x18", "ERR?")
    assert rig.say("ERR?") == "0"


@given(st.lists(st.tuples(received(PM16C), st.sampled_from([0.0, 0.1, 100.0])), max_size=12))
def test_fuzz_pm16c_answers_on_and_understands_a_stop(story: Story) -> None:
    wire = Wire()
    begun = time.perf_counter()
    for lines in replies(wire.box, story, b"\r\n"):
        assert all(re.fullmatch(rb"[\x20-\x7e]+", line) for line in lines)
    wire.box.receive(b"\r\n")
    wire.box.transmit()
    wire.tell("AESTP")
    assert re.fullmatch(r"[RL]4", wire.ask("STQ?"))
    assert re.fullmatch(r"[+-]\d{7,10}", wire.ask("PS?0"))
    assert time.perf_counter() - begun < 30.0
