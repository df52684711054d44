"""Fuzz of the simulated Zaber stage: no bytes stop it, its lines are whole, the next sound command is understood."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from tests.drivers.fuzz import received, replies
from tests.drivers.zaber_rig import Rig

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


@given(st.lists(st.tuples(received(COMMANDS), st.floats(0.0, 3.0)), max_size=12))
def test_fuzz_whatever_it_receives_it_answers_on(story: list[tuple[bytes, float]]) -> None:
    rig = Rig()
    for _ in replies(rig.controller, story, b"\r\n"):
        pass
    rig.controller.receive(b"\n")
    rig.controller.transmit()
    rig.say("/1 0 set comm.alert 0", "/1 0 set comm.checksum 0", "/1 1 estop")
    rig.controller.transmit()
    assert rig.say("/1 0 get version") == "7.38"
    assert not rig.controller.device.axis.moving(rig.clock.now())
