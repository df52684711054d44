"""PI GCS 2.0 driver on a disturbed line: lost bytes are noticed, and the message says what moved."""

from __future__ import annotations

import math
import re

import pytest

from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.protocols import TriggerTrain
from drivers.testing.stages.bench import LONG, SPEED
from tests.drivers.stages.pi_gcs_rig import Rig
from tests.messages import refused


def test_a_move_that_arrived_and_was_then_let_go_has_not_arrived() -> None:
    rig = Rig()
    stage = rig.open()
    stage.start_move(math.radians(5), math.radians(30))
    rig.clock.sleep(10.0)
    rig.say("SVO 1 0")
    with refused(DeviceError):
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
        with refused(DeviceError):
            stage.arm(train)
    stage.close()


@pytest.fixture
def rig() -> Rig:
    return Rig()


# commands that do not arrive, or arrive otherwise


def test_a_target_that_lost_a_digit_is_noticed(rig: Rig) -> None:
    stage = rig.open()
    rig.replace("MOV 1 30", "MOV 1 3")
    with refused(DeviceError):
        stage.start_move(math.radians(30), SPEED)


def test_a_stop_that_is_not_understood_is_named(rig: Rig) -> None:
    stage = rig.open()
    stage.start_move(math.radians(60), SPEED)
    rig.replace("HLT 1", "HXT 1")
    with refused(DeviceRefused):
        stage.stop()
    stage.abort()
    assert not stage.moving()


@pytest.mark.parametrize("code", [1, 17, 54, 333, 4711])
def test_a_code_after_a_command_is_given_in_words(rig: Rig, code: int) -> None:
    stage = rig.open()
    rig.spoil = lambda reply: b"%d\n" % code if reply == b"0\n" else reply
    with pytest.raises(DeviceError, match=f"error {code}, "):
        stage.disarm()


# replies


@pytest.mark.parametrize(
    ("reply", "says"),
    [
        (b"2=0.000000\n", "does not have the expected form"),
        (b"1=nan\n", "does not have the expected form"),
        (b"1=1.79769e+308\n", "does not have the expected form"),
        (b"\n", "does not have the expected form"),
        (b"1=0.000000 \n", "no whole reply within 1 s"),
        (b"1=0.000000 \n2=0.000000\n", "does not have the expected form"),
    ],
)
def test_a_spoilt_reply_is_named_and_the_next_request_is_in_step_again(rig: Rig, reply: bytes, says: str) -> None:
    """Another axis, what is no number, a line that promises another; tests/drivers/faults has what every line has."""
    stage = rig.open()
    spoilt = [reply]
    rig.spoil = lambda sound: spoilt.pop() if spoilt else sound
    before = rig.clock.now()
    with pytest.raises(DeviceError, match=rf"{says}.*Asked 'POS\? 1'.*Nothing has moved"):
        stage.position()
    assert rig.clock.now() - before < 1.2
    assert stage.position() == 0.0
    stage.start_move(math.radians(10), SPEED)
    assert math.degrees(stage.wait(LONG)) == pytest.approx(10.0)


def test_a_lost_error_reply_after_a_move_says_that_the_stage_may_be_turning(rig: Rig) -> None:
    stage = rig.open()
    stage.start_move(math.radians(5), SPEED)
    stage.wait(LONG)
    zeros = iter([b"0\n", b"0\n", b"0\n"])  # #5, ERR? before, ERR? after VEL
    rig.spoil = lambda reply: next(zeros, b"") if reply == b"0\n" else reply
    with refused(DeviceTimeout):
        stage.start_move(math.radians(60), math.radians(1))
    rig.spoil = lambda reply: reply
    assert stage.moving()
    stage.stop()
    assert not stage.moving()


def test_a_motion_error_that_came_before_a_command_is_not_laid_at_its_door() -> None:
    rig = Rig(stall_at=2500)
    stage = rig.open()
    stage.start_move(math.radians(30), SPEED)
    rig.clock.sleep(10.0)
    stage.arm(TriggerTrain(3000, 10, 3))
