"""A motor that moves the sample reaches its two positions, finds out where it is, and reports what stopped it."""

from __future__ import annotations

import math
from uuid import uuid4

import pytest

from drivers.base.errors import DeviceError, DeviceRefused
from drivers.base.protocols import SampleMover
from drivers.in_beam import INSIDE, OUTSIDE, PlacedStage, StagePlaces, StageSampleMover
from drivers.stages.epics.stage import EpicsSettings, EpicsStage
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.epics.wire import MotorRecord
from simulators.wires.wire import register
from tests.drivers.soft_ioc import TickingClock, record_of
from tests.drivers.stages.epics.test_conformance import USUAL
from tests.drivers.stages.flat_settings import flat

PLACES = StagePlaces({INSIDE: math.radians(1), OUTSIDE: math.radians(41)}, math.radians(10), "the sample did not move")


class Rig:
    def __init__(self, **build: int) -> None:
        self.clock = TickingClock()
        self.record: MotorRecord = record_of(self.clock, TriggerLine(self.clock), **build)
        stage = EpicsStage(register(f"epics-{uuid4().hex}", self.record), flat(EpicsSettings, **USUAL), self.clock)
        self.checks, self.aborts_after = 0, 10**9
        mover = StageSampleMover(PlacedStage(stage, PLACES, self.clock, "sample mover"))
        mover.watch(self._check)
        self.mover: SampleMover = mover

    def _check(self) -> None:
        self.checks += 1
        if self.checks > self.aborts_after:
            raise KeyboardInterrupt

    @property
    def place(self) -> float:
        """deg."""
        return self.record.motor.position() / 1000


def test_it_goes_out_and_back_and_stays_where_it_is() -> None:
    rig = Rig()
    for move, place in ((rig.mover.out, 41), (rig.mover.back, 1)):
        move()
        assert rig.place == place
        arrived, checks = rig.clock.now(), rig.checks
        move()
        assert (rig.place, rig.clock.now(), rig.checks) == (place, arrived, checks)


def test_a_sample_that_a_person_moved_meanwhile_is_moved_back() -> None:
    rig = Rig()
    rig.mover.back()
    rig.record.write(".VAL", 30.0)
    rig.clock.sleep(60)
    rig.mover.back()
    assert rig.place == 1


def test_a_switch_on_the_way_is_told_as_the_samples() -> None:
    rig = Rig(switch_at=20_000)
    said = "^sample mover: the sample did not move out of the beam: stage: it stopped short"
    with pytest.raises(DeviceError, match=said):
        rig.mover.out()


def test_a_motor_that_is_moving_is_refused_and_told() -> None:
    rig = Rig()
    rig.record.write(".VAL", 90.0)
    with pytest.raises(DeviceRefused, match="while it moves"):
        rig.mover.back()


def test_an_abort_on_the_way_stops_the_motor() -> None:
    rig = Rig()
    rig.aborts_after = 10
    with pytest.raises(KeyboardInterrupt):
        rig.mover.out()
    stood = rig.place
    rig.clock.sleep(60)
    assert rig.place == stood < 20
