"""PM16C-04XD driver on a disturbed line: what got lost is noticed, and what (has not) moved is said."""

from __future__ import annotations

import math

import pytest

from drivers.base.errors import DeviceError, DeviceTimeout
from drivers.base.protocols import TriggerTrain
from drivers.testing.stages.bench import SPEED
from tests.drivers.pm16c_rig import QUERIES_TO_OPEN, Rig


@pytest.fixture
def rig() -> Rig:
    return Rig()


# lost commands


@pytest.mark.parametrize("lost", ["RTE", "SETCH"])
def test_a_setting_lost_on_the_way_is_noticed_at_opening(rig: Rig, lost: str) -> None:
    rig.lose(lost)
    with pytest.raises(DeviceError, match=lost):
        rig.open()


@pytest.mark.parametrize("lost", ["SPDHB2500", "SPDHB", "ABSB"])
def test_a_command_lost_on_the_way_is_noticed_before_a_move_counts_as_begun(rig: Rig, lost: str) -> None:
    stage = rig.open()
    rig.say("SPDLB")
    rig.lose(lost)
    with pytest.raises(DeviceError, match=r"SPD\w+|ABS"):
        stage.start_move(math.radians(30), SPEED)
    assert not stage.moving()
    assert stage.position() == 0.0


@pytest.mark.parametrize("lost", ["TMGM", "TMGS", "TMGE", "TMGI", "TMGR"])
def test_a_trigger_setting_lost_on_the_way_is_noticed_and_nothing_is_emitted(rig: Rig, lost: str) -> None:
    bench = rig.bench()
    rig.lose(lost)
    with pytest.raises(DeviceError, match=f"was not taken.*{lost}B.*Nothing has moved"):
        bench.stage.arm(TriggerTrain(100, 10, 3))
    bench.go(20.0)
    assert bench.pulses() == []


def test_a_disarm_lost_on_the_way_is_noticed(rig: Rig) -> None:
    stage = rig.open()
    stage.arm(TriggerTrain(100, 10, 3))
    rig.lose("TMGC")
    with pytest.raises(DeviceError, match="TMGCB"):
        stage.disarm()


# lost and spoilt replies


def test_no_reply_is_a_timeout_and_the_next_request_is_in_step_again() -> None:
    rig = Rig(silent={QUERIES_TO_OPEN})
    stage = rig.open()
    before = rig.clock.now()
    with pytest.raises(DeviceTimeout, match=r"within 1 s."):
        stage.position()
    assert rig.clock.now() - before == pytest.approx(1.0, abs=0.1)
    assert stage.position() == 0.0


def test_garbage_is_named_and_the_next_request_is_in_step_again() -> None:
    rig = Rig(garbled={QUERIES_TO_OPEN})
    stage = rig.open()
    with pytest.raises(DeviceError, match=r"have the form.*position in pulses"):
        stage.position()
    assert stage.position() == 0.0
