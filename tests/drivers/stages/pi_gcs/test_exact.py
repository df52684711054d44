"""PI GCS 2.0 driver: what adds up over many pulses, and a servo that does not hold."""

from __future__ import annotations

import math
import re

import pytest

from drivers.base.errors import DeviceError
from drivers.base.protocols import TriggerTrain
from tests.drivers.stages.pi_gcs_rig import Rig


def test_a_move_that_arrived_and_was_then_let_go_has_not_arrived() -> None:
    rig = Rig()
    stage = rig.open()
    stage.start_move(math.radians(5), math.radians(30))
    rig.clock.sleep(10.0)
    rig.say("SVO 1 0")
    with pytest.raises(DeviceError, match="the servo is off"):
        stage.wait(60.0)
    stage.close()


@pytest.mark.parametrize(
    ("pulses", "decimals", "taken"), [(900, 6, True), (20, 3, True), (900, 3, False), (900, 2, False)]
)
def test_a_step_that_the_controller_rounds_is_taken_only_if_the_train_is_not_pulled_apart(
    pulses: int, decimals: int, taken: bool
) -> None:
    """A count is 0.0054931640625 degrees; 19 of them are 0.1043701171875, which in 3 decimals misses 0.07 counts."""
    rig = Rig(counts_per_turn=1 << 16)

    def spoil(reply: bytes) -> bytes:
        if not rig.heard.endswith(b"CTO? 2 1\n"):
            return reply
        return re.sub(rb"=(.*)", lambda match: f"={float(match[1]):.{decimals}f}".encode(), reply)

    rig.spoil = spoil
    stage = rig.open(counts_per_turn=1 << 16)
    train = TriggerTrain(100, 19, pulses)
    if taken:
        stage.arm(train)
    else:
        with pytest.raises(DeviceError, match="setting was not taken"):
            stage.arm(train)
    stage.close()
