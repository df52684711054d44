"""Every stage: a line that fails during a move, and a start after a program that died."""

from __future__ import annotations

import math
from contextlib import nullcontext

import pytest

from drivers.base.errors import DeviceRefused, DeviceTimeout
from drivers.testing.stages.bench import LONG, SPEED
from simulators.wires.wire import register
from tests.drivers.stages.rig import NAMES, StageRig
from tests.drivers.stages.rigs import RIGS, RigOf, every_stage


class Deaf:
    """A cable on which, while `dead`, nothing comes back; what is sent arrives."""

    def __init__(self, rig: StageRig) -> None:
        self.clock, self._rig = rig.clock, rig
        self.dead = False

    def receive(self, data: bytes) -> None:
        self._rig.receive(data)

    def transmit(self) -> bytes:
        data = self._rig.transmit()
        return b"" if self.dead else data


@pytest.mark.parametrize("hard", [False, True], ids=["stop", "abort"])
@every_stage
def test_a_line_that_dies_during_a_move_is_said_lets_a_stop_out_and_does_not_keep_the_port(
    rig_of: RigOf, hard: bool
) -> None:
    rig = rig_of()
    line = Deaf(rig)
    rig.url = register(next(NAMES), line)
    stage = rig.open()
    stage.start_move(math.radians(60), math.radians(1))
    line.dead = True
    with pytest.raises(DeviceTimeout, match="may be turning"):
        stage.wait(LONG)
    rig.clock.sleep(1.0)
    unasked = hard and rig_of is not RIGS["pi_gcs"]  # others do not look whether an abort was heard
    with nullcontext() if unasked else pytest.raises(DeviceTimeout):
        (stage.abort if hard else stage.stop)()
    rig.clock.sleep(2.0)
    stands_at = rig.line.angle_at(rig.clock.now())
    assert 0.0 < stands_at < math.radians(30)
    rig.clock.sleep(10.0)
    assert rig.line.angle_at(rig.clock.now()) == stands_at
    line.dead = False
    assert not stage.moving()
    line.dead = True
    stage.close()
    line.dead = False
    rig.open().close()


@every_stage
def test_opening_a_moving_stage_is_refused_and_lets_it_move(rig_of: RigOf) -> None:
    rig = rig_of()
    rig.open().start_move(math.radians(60), SPEED)
    rig.url = register(next(NAMES), rig)  # the program is gone, the controller is not
    with pytest.raises(DeviceRefused, match="while it moves"):
        rig.open()
    rig.clock.sleep(60.0)
    assert math.degrees(rig.line.angle_at(rig.clock.now())) == pytest.approx(60.0)
    rig.open().close()


@every_stage
def test_a_train_that_a_crashed_program_armed_gives_no_pulse(rig_of: RigOf) -> None:
    rig = rig_of()
    bench = rig.bench()
    bench.stage.arm(bench.train(1.0, 1.0, 5))
    rig.url = register(next(NAMES), rig)  # the program is gone, the controller is not
    bench = rig.bench()
    bench.go(20.0)
    assert bench.pulses() == []
    bench.stage.arm(bench.train(21.0, 1.0, 3))
    bench.go(30.0)
    assert len(bench.pulses()) == 3
    bench.stage.close()
