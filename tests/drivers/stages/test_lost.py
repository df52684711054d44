"""Controllers that do not answer to settings: a lost or changed command is noticed at once."""

from __future__ import annotations

import math
from typing import Any

import pytest

from drivers.base.errors import DeviceError
from drivers.base.protocols import TriggerTrain
from drivers.testing.stages.bench import LONG, SPEED
from tests.drivers import pm16c_rig
from tests.drivers.stages import pi_gcs_rig

NOT_TAKEN = "did not accept a setting.*{}.*Nothing has moved"
LOST = [
    *(("pm16c", "open", lost, "", lost) for lost in ("RTE", "SETCH")),
    *(("pm16c", "move", lost, "", r"SPD\w+|ABS") for lost in ("SPDHB2500", "SPDHB", "ABSB")),
    *(("pm16c", "arm", lost, "", NOT_TAKEN.format(lost + "B")) for lost in ("TMGM", "TMGS", "TMGE", "TMGI", "TMGR")),
    ("pm16c", "disarm", "TMGC", "", "TMGCB"),
    *(("pm16c", "search", lost, "", lost) for lost in ("TMGC", "SPDH", "FDHP")),
    *(("pm16c", "end of a search", lost, "", lost) for lost in ("GTHP", "PSB")),
    *(("pi_gcs", "open", lost, "", NOT_TAKEN.format(lost)) for lost in ("ACC 1 60", "DEC 1 60", "SVO 1 1")),
    *(("pi_gcs", "move", lost, "", f"did not accept a setting.*{lost}") for lost in ("VEL 1 20", "MOV 1 30")),
    *(
        ("pi_gcs", "arm", sent, arrives, rf"{sent}.*Nothing has moved")
        for sent, arrives in (
            ("CTO 2 3 0", ""), ("CTO 2 7 1", "CTO 2 7 0"), ("CTO 2 1 0.5", "CTO 2 1 0."), ("TRO 2 1", ""),
            ("CTO 2 1 0.5", "CTO 2 1 0.51"), ("CTO 2 8 1", ""), ("CTO 2 9 10.75", "CTO 2 9 10.7"),
            ("CTO 2 8 1", "CTO 1 8 1"),
        )
    ),
    ("pi_gcs", "disarm", "TRO 2 0", "", "TRO 2 0"),
    ("pi_gcs", "end of a search", "FRF 1", "", r"\(no reason given\).*has not found its reference"),
]  # fmt: skip
"""Controller, what is done, the command that is lost, what arrives instead, and what the error says."""


@pytest.mark.parametrize(("kind", "act", "lost", "arrives", "says"), LOST, ids=lambda text: str(text) or "nothing")
def test_a_command_lost_on_the_way_is_noticed_and_nothing_moves_or_is_emitted(
    kind: str, act: str, lost: str, arrives: str, says: str
) -> None:
    rig: Any = pm16c_rig.Rig(home_at=2500)
    if kind == "pi_gcs":
        rig = pi_gcs_rig.Rig(referenced=act != "end of a search")

    def lose() -> None:
        rig.lose(lost) if kind == "pm16c" else rig.replace(lost, arrives)

    if act == "open":
        lose()
        with pytest.raises(DeviceError, match=says):
            rig.open()
        return
    bench = rig.bench()
    stage, train = bench.stage, TriggerTrain(100, 10, 3) if kind == "pm16c" else bench.train(1.0, 0.5, 20)
    rig.say("SPDLB") if kind == "pm16c" else rig.say("CTO 2 3 2", "CTO 2 8 77", "CTO 2 1 9")
    if act in ("disarm", "search"):
        stage.arm(train)
    if act == "end of a search" and kind == "pm16c":
        stage.start_home()
    lose()
    if act == "end of a search" and kind == "pi_gcs":
        stage.start_home()
    calls = {
        "move": lambda: stage.start_move(math.radians(30), SPEED if kind == "pm16c" else 2 * SPEED),
        "arm": lambda: stage.arm(train),
        "disarm": stage.disarm,
        "search": stage.start_home,
        "end of a search": lambda: stage.wait(LONG),
    }
    with pytest.raises(DeviceError, match=says):
        calls[act]()
    assert not stage.moving()
    if act in ("move", "search"):
        assert stage.position() == 0.0
    if act == "arm":
        bench.go(20.0)
        assert bench.pulses() == []
