"""Settings that a stage's driver changes: restored at the end."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any
from uuid import uuid4

import pytest

from drivers.base.protocols import RotationStage
from drivers.stages.epics.stage import EpicsSettings, EpicsStage
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.wire import register
from tests.drivers.soft_ioc import TickingClock, record_of
from tests.drivers.stages.epics.test_conformance import USUAL
from tests.drivers.stages.flat_settings import flat
from tests.drivers.stages.rigs import RIGS

SLOW, FAST = math.radians(0.5), math.radians(20)


class EpicsRig:
    def __init__(self) -> None:
        self.clock = TickingClock()
        self.controller = record_of(self.clock, TriggerLine(self.clock))
        self.url = register(f"epics-{uuid4().hex}", self.controller)

    def open(self) -> EpicsStage:
        return EpicsStage(self.url, flat(EpicsSettings, **USUAL), self.clock)


def _zaber(rig: Any) -> dict[str, Any]:
    return {**rig.controller.device.axis.settings, "checksums": rig.controller.device.checksums}


def _pi(rig: Any) -> dict[str, Any]:
    axis = rig.controller.box.axis
    return {"velocity": axis.velocity, "acceleration": axis.acceleration, "deceleration": axis.deceleration}


def _pm16c(rig: Any) -> dict[str, Any]:
    box = rig.controller.box
    channel = box.channels["B"]
    return {
        "speeds": dict(channel.speeds),
        "selected": channel.selected,
        "rate": channel.rate,
        "mapped": box.mapped,
        "remote": box.remote,
    }


def _epics(rig: Any) -> dict[str, Any]:
    return {name: rig.controller.state[name] for name in (".VELO", ".ACCL")}


KINDS: dict[str, tuple[Callable[[], Any], Callable[[Any], dict[str, Any]]]] = {
    "zaber": (RIGS["zaber"], _zaber),
    "pi_gcs": (RIGS["pi_gcs"], _pi),
    "pm16c": (RIGS["pm16c"], _pm16c),
    "epics": (EpicsRig, _epics),
}
every_kind = pytest.mark.parametrize(("rig_of", "settings"), KINDS.values(), ids=KINDS)


def _moved(stage: RotationStage, degrees: float, speed: float) -> None:
    stage.start_move(math.radians(degrees), speed)
    stage.wait(600)


@every_kind
def test_an_orderly_end_leaves_them_as_they_were(rig_of: Any, settings: Any) -> None:
    rig = rig_of()
    before = settings(rig)
    stage = rig.open()
    _moved(stage, 5, SLOW)
    assert settings(rig) != before
    stage.close()
    assert settings(rig) == before
