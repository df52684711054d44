"""All our stages, in all variants, pass the conformance suite that is shipped."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import pytest

from drivers.testing.stages import Build, StageBench, StageConformance, StageKind
from simulators.wires.wire import register
from tests.drivers import pm16c_rig, zaber_rig
from tests.drivers.stages import pi_gcs_rig
from tests.drivers.stages.rig import NAMES, StageRig
from tests.drivers.stages.rigs import pi_gcs
from tests.simulators.wires.transports import serve_pty

RigOf = Callable[[dict[str, Any]], StageRig]
"""A fresh controller for a driver with these settings."""


@dataclass(frozen=True, kw_only=True)
class Kind(StageKind):
    """A stage under test.

    Attributes:
        rig: what makes the controller.
        usual: settings of the driver's constructor.
        terminal: its bytes go through a pseudo-terminal. Time is virtual all the same: they take their own time, the
            clock stands meanwhile.
    """

    rig: RigOf
    usual: dict[str, Any]
    terminal: bool = False

    def build(self, plugged: ExitStack) -> Build:
        """A function that opens the stage on a fresh wire, with settings that differ; `plugged` pulls the cables."""

        def build(**settings: Any) -> StageBench:
            rig = self.rig(settings)
            if self.terminal:
                rig.url = plugged.enter_context(serve_pty(rig))
            return rig.bench(**(self.usual | settings))

        return build


def _slow_pm16c(settings: dict[str, Any]) -> StageRig:
    rig = pm16c_rig.Rig(home_at=500)
    rig.url = register(next(NAMES), pm16c_rig.Slow(rig, 0.04))
    return rig


def _pi_gcs_by_limit_switch(settings: dict[str, Any]) -> StageRig:
    """Another axis, reference by the negative limit switch, a servo that looks once in 50 µs and no ACC and DEC."""
    wire = {"axis": "ROT_A", "output": 1, "latency": 0.0, "unknown": {"ACC", "DEC"}}
    return pi_gcs_rig.Rig(wire=wire, low=-5.0, reference_switch=False, servo_period=50e-6)


def _zaber(**device: Any) -> RigOf:
    """The device's output is cabled for the polarity that the driver is told."""
    return lambda settings: zaber_rig.Rig(active_high=settings.get("active_high", True), **device)


_PM16C = Kind(
    rig=lambda _: pm16c_rig.Rig(home_at=500),
    usual={"home": math.radians(2.0)},
    no_width=50e-6,
    turning_back_ends=False,
    disarms_moving=False,
)
_PI_GCS = Kind(rig=lambda _: pi_gcs(), usual={}, width=None, inverts=True)
_ZABER = Kind(rig=_zaber(), usual={}, width=1e-3, no_width=0.5e-3, inverts=True)
KINDS = {
    "pm16c": _PM16C,
    "pm16c, a width for all trains and no home switch": replace(
        _PM16C, rig=lambda _: pm16c_rig.Rig(home_at=None), usual={"home": None}, homes=False, width=1e-3, no_width=2e-3
    ),
    "pm16c, slow": replace(_PM16C, rig=_slow_pm16c),
    "pi_gcs": _PI_GCS,
    "pi_gcs, limit switch": replace(
        _PI_GCS, rig=_pi_gcs_by_limit_switch, usual={"axis": "ROT_A", "trigger_line": 1, "reference": "negative_limit"}
    ),
    "zaber": _ZABER,
    "zaber, toggled": replace(
        _ZABER, rig=_zaber(can_schedule=False), usual={"toggle": True}, width=None, no_width=1e-3
    ),
    "zaber, fires when enabled": replace(
        _ZABER,
        rig=_zaber(fires_when_enabled=True),
        usual={"fires_when_enabled": True},
        no_width=0.0,
    ),
    "zaber, encoder": replace(_ZABER, rig=_zaber(identity="deviceid"), usual={"measured": True}, no_width=0.0),
}
MAKERS = ("pm16c", "pi_gcs", "zaber")
needs_pty = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals that pyserial opens")
BENCHES = [
    *(pytest.param(kind, id=name, marks=[pytest.mark.slow] * (name not in MAKERS)) for name, kind in KINDS.items()),
    pytest.param(
        replace(KINDS["pi_gcs"], terminal=True), id="pi_gcs on a terminal", marks=[needs_pty, pytest.mark.slow]
    ),
]


class TestStages(StageConformance):
    @pytest.fixture(params=BENCHES)
    def kind(self, request: pytest.FixtureRequest) -> Kind:
        return request.param

    @pytest.fixture
    def build(self, kind: Kind) -> Iterator[Build]:
        with ExitStack() as plugged:
            yield kind.build(plugged)
