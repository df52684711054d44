"""A motor record passes the suite for stages without a trigger output, in this process and behind a soft IOC."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any
from uuid import uuid4

import pytest

from drivers.stages.epics.stage import EpicsSettings, EpicsStage
from drivers.testing.stages import Build, StageBench, StageKind, StepStageConformance
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.wire import register
from tests.drivers.soft_ioc import PREFIX, TickingClock, record_of, serve_pva
from tests.drivers.stages.flat_settings import flat

USUAL: dict[str, Any] = {
    "counts_per_turn": 360_000,
    "max_speed": math.radians(30),
    "acceleration": math.radians(60),
    "low": math.radians(-5),
    "high": math.radians(100),
    "search": "forward",
}


class TestMotorRecord(StepStageConformance):
    @pytest.fixture(params=[True, False], ids=["home switch", "no search"])
    def kind(self, request: pytest.FixtureRequest) -> StageKind:
        return StageKind(triggers=False, homes=request.param)

    @pytest.fixture(params=["in process", "pva"])
    def build(
        self, kind: StageKind, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
    ) -> Iterator[Build]:
        if request.param == "pva":
            pytest.importorskip("p4p")
        with ExitStack() as served:

            def build(**settings: Any) -> StageBench:
                clock = TickingClock()
                line = TriggerLine(clock)
                record = record_of(clock, line, home_at=500)
                if request.param == "pva":
                    served.enter_context(serve_pva(record, clock, monkeypatch))
                    url = f"pva://{PREFIX}"
                else:
                    url = register(f"epics-{uuid4().hex}", record)
                chosen = USUAL | {"search": "forward" if kind.homes else "none"} | settings
                return StageBench(EpicsStage(url, flat(EpicsSettings, **chosen), clock), clock, line)

            yield build
