"""The simulated controllers of all stages under one roof, for tests that every driver must pass."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, Protocol

import pytest

from drivers.base.protocols import RotationStage
from drivers.testing.stages.bench import StageBench
from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from tests.drivers import pm16c_rig, zaber_rig
from tests.drivers.stages import pi_gcs_rig


class AnyRig(Protocol):
    """A simulated controller on a virtual clock; it is its own wire, and `url` is where that is plugged in."""

    clock: VirtualClock
    line: TriggerLine
    controller: Any
    url: str

    def receive(self, data: bytes) -> None: ...

    def transmit(self) -> bytes: ...

    def open(self, **settings: Any) -> RotationStage: ...

    def bench(self, **settings: Any) -> StageBench: ...


def pi_gcs(**build: Any) -> AnyRig:
    """Without latency: on a real terminal the virtual clock stands while a reply is on its way."""
    return pi_gcs_rig.Rig(wire={"latency": 0.0}, **build)


NAMES = (f"every-stage-test-{number}" for number in itertools.count())
RigOf = Callable[..., AnyRig]
RIGS: dict[str, RigOf] = {"pm16c": pm16c_rig.Rig, "pi_gcs": pi_gcs, "zaber": zaber_rig.Rig}
every_stage = pytest.mark.parametrize("rig_of", RIGS.values(), ids=RIGS.keys())
