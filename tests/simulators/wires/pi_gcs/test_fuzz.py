"""Fuzz of the simulated PI GCS 2.0: no bytes stop it, its lines are whole, and it stays within its travel."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from tests.drivers.fuzz import received, replies
from tests.drivers.stages.pi_gcs_rig import Rig

COMMANDS = [
    b"*IDN?\n", b"ERR?\n", b"SVO 1 1\n", b"SVO 1 0\n", b"FRF 1\n", b"FNL 1\n", b"MOV 1 10.5\n", b"MVR 1 -1e0\n",
    b"VEL 1 20\n", b"ACC 1 9\n", b"SPA 1 0xB 5\n", b"SPA? 1 0xE\n", b"CTO 1 1 0.1\n", b"CTO 1 8 1\n", b"CTO 1 9 0.5\n",
    b"CTO 1 3 0\n", b"CTO? 1 9\n", b"TRO 1 1\n", b"TRO?\n", b"POS?\n", b"HLT 1\n", b"STP\n",
    b"\x03", b"\x04", b"\x05", b"\x07", b"\x18",
]  # fmt: skip


@given(st.lists(st.tuples(received(COMMANDS), st.floats(0.0, 3.0)), max_size=12))
def test_fuzz_whatever_it_receives_it_answers_on(story: list[tuple[bytes, float]]) -> None:
    rig = Rig(low=-30.0, high=30.0)
    for _ in replies(rig.controller, story, b"\n"):
        assert abs(math.degrees(rig.line.angle_at(rig.clock.now()))) <= 30.0
    rig.say("", "")
    assert rig.say("CSV?") == "2.0"
    assert rig.say("POS? 1").startswith("1=")
    rig.say(b"\x18", "ERR?")
    assert rig.say("ERR?") == "0"
