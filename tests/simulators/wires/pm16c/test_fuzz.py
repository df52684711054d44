"""Fuzz of the simulated PM16C: no bytes stop it, and stops and queries are always understood afterwards."""

from __future__ import annotations

import re
import time

from hypothesis import given
from hypothesis import strategies as st

from tests.drivers.fuzz import received, replies
from tests.simulators.pm16c_host import Wire

COMMANDS = [
    f"{command}\r\n".encode()
    for command in (
        "VER?", "SETCH?", "SETCH3210", "PS?0", "PS0+100", "SPD?0", "SPDH0100", "SPDH0", "RTE0115", "FL0+100", "BL0-100",
        "SETLS010000000", "STS0?", "STSF?", "STQ?", "ERR?", "ERRF?", "TMGM03", "TMGS0+100", "TMGE0+2147483647",
        "TMGI01", "TMGR0", "TMGR?0", "TMGC0", "REM", "LOC", "SSTP0", "ESTP0", "ASSTP", "AESTP", "ERRC",
        "ABS0+2147483647", "ABS0-999999999999", "REL0+90000", "FDHP0", "GTHP0", "SHP?0",
    )
]  # fmt: skip
REPLY = rb"[\x20-\x7e]+"


@given(st.lists(st.tuples(received(COMMANDS), st.sampled_from([0.0, 0.1, 100.0])), max_size=12))
def test_fuzz_whatever_it_receives_it_answers_on(story: list[tuple[bytes, float]]) -> None:
    wire = Wire()
    begun = time.perf_counter()
    for lines in replies(wire.box, story, b"\r\n"):
        assert all(re.fullmatch(REPLY, line) for line in lines)
    wire.box.receive(b"\r\n")
    wire.box.transmit()
    wire.tell("AESTP")
    assert re.fullmatch(r"[RL]4", wire.ask("STQ?"))
    assert re.fullmatch(r"[+-]\d{7,10}", wire.ask("PS?0"))
    assert time.perf_counter() - begun < 30.0
