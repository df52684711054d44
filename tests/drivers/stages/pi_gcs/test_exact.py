"""PI GCS 2.0 driver: what adds up over many moves or pulses, and a servo that holds beside its target or not at all."""

from __future__ import annotations

import math
import re

import pytest

from drivers.base.errors import DeviceError
from drivers.base.protocols import TriggerTrain
from drivers.testing.stages.bench import start_move_by
from tests.drivers.stages.pi_gcs_rig import COUNTS, Rig


def shift_positions(rig: Rig, counts: int) -> None:
    """The servo holds the axis beside where it was sent to."""

    def spoil(reply: bytes) -> bytes:
        if not rig.heard.endswith(b"POS? 1\n"):
            return reply
        return f"1={float(reply.decode().split('=')[1]) + counts * 360 / COUNTS:.6f}\n".encode()

    rig.spoil = spoil


@pytest.mark.parametrize("beside", [3, -7])
def test_relative_moves_do_not_accumulate_deviations_of_the_servo(beside: int) -> None:
    rig = Rig()
    stage = rig.open()
    stage.start_move(0.0, math.radians(30))
    stage.wait(60.0)
    shift_positions(rig, beside)
    for _ in range(40):
        start_move_by(stage, math.radians(1 / 3), math.radians(30))
        stage.wait(60.0)
    assert rig.line.angle_at(rig.clock.now()) == pytest.approx(stage.to_angle(40 * 83), rel=1e-12)
    assert stage.status().counts == 40 * 83 + beside
    stage.close()


def test_a_relative_move_after_a_stop_or_a_push_starts_from_where_it_stands() -> None:
    rig = Rig()
    stage = rig.open()
    stage.start_move(math.radians(50), math.radians(30))
    rig.clock.sleep(1.0)
    stage.stop()
    here = stage.status().counts
    start_move_by(stage, stage.to_angle(100), math.radians(30))
    stage.wait(60.0)
    assert stage.status().counts == here + 100
    shift_positions(rig, 500)
    start_move_by(stage, stage.to_angle(100), math.radians(30))
    assert rig.say("MOV? 1") == f"1={(here + 700) * 360 / COUNTS:.6f}"
    stage.stop()
    stage.close()


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
