"""The whole conformance suite of every stage on a pseudo-terminal: real bytes through a real port.

Time is virtual all the same: bytes go through the terminal in their own time, the clock stands meanwhile.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any, ClassVar

import pytest

from simulators.transports import serve_pty
from tests.drivers import pm16c_rig, zaber_rig
from tests.drivers.stage_conformance import Build, StageBench, StageConformance
from tests.drivers.stages.rigs import AnyRig, pi_gcs

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals that pyserial opens")


class OnATerminal(StageConformance):
    """A subclass gives the rig, and what of the driver's settings differs from its usual ones."""

    RELATIVE_MOVES = 200
    SETTINGS: ClassVar[dict[str, Any]] = {}

    def rig(self, settings: dict[str, Any]) -> AnyRig:
        raise NotImplementedError("the subclass gives the rig")

    @pytest.fixture
    def build(self) -> Iterator[Build]:
        with ExitStack() as plugged:

            def build(**settings: Any) -> StageBench:
                rig = self.rig(settings)
                rig.url = plugged.enter_context(serve_pty(rig))
                return rig.bench(**(self.SETTINGS | settings))

            yield build


class TestPM16C(OnATerminal):
    NO_WIDTH = 50e-6
    SETTINGS: ClassVar[dict[str, Any]] = {"home": math.radians(2.0)}

    def rig(self, settings: dict[str, Any]) -> AnyRig:
        return pm16c_rig.Rig(home_at=500)


class TestPiGcs(OnATerminal):
    WIDTH = None
    INVERTS = True

    def rig(self, settings: dict[str, Any]) -> AnyRig:
        return pi_gcs()


class TestZaber(OnATerminal):
    WIDTH = 1e-3
    NO_WIDTH = 0.5e-3
    INVERTS = True

    def rig(self, settings: dict[str, Any]) -> AnyRig:
        return zaber_rig.Rig(active_high=settings.get("active_high", True))
