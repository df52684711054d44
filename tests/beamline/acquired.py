"""Runs a scan with the fake instrument to its end, and checks the properties that its frames and files must have."""

from collections.abc import Mapping
from typing import Any

import pytest

from beamline.core.stop import StopRequest
from beamline.plan.plan import Timeline
from beamline.scan.acquisition import Acquisition
from beamline.scan.supervision import Supervision
from drivers.base.frame import Frame, FrameKind
from drivers.base.protocols import CameraSettings, TriggerSource
from tests.beamline.fakes import COUNT, HOME, FakeInstrument

SETTLE = 0.05


class Run:
    """A scan that has run to its end, however it ended."""

    def __init__(
        self,
        instrument: FakeInstrument,
        timeline: Timeline,
        stop: StopRequest | None = None,
        supervision: Supervision | None = None,
    ) -> None:
        self.events: list[tuple[str, Mapping[str, Any]]] = []
        self.frames: list[Frame] = []
        self.error: BaseException | None = None
        self.scan = Acquisition(
            instrument.devices,
            timeline,
            CameraSettings(1.0, TriggerSource.INTERNAL),
            SETTLE,
            instrument.clock,
            stop or StopRequest(),
            lambda event: self.events.append((event.event, event.data)),
            supervision,
        )
        try:
            self.frames.extend(self.scan.frames())
        except BaseException as error:
            self.error = error

    def of(self, kind: FrameKind) -> list[Frame]:
        return [frame for frame in self.frames if frame.kind is kind]

    @property
    def warnings(self) -> list[str]:
        return [data["message"] for event, data in self.events if event == "warning"]

    @property
    def views(self) -> list[int]:
        return [frame.trigger for frame in self.of(FrameKind.PROJECTION)]


def assert_safe(instrument: FakeInstrument, home: bool = True) -> None:
    assert not instrument.is_open
    assert not instrument.camera.armed
    assert not instrument.stage.moving()
    assert (instrument.stage.train, instrument.stage.pulses) == (None, [])  # disarmed
    if home:
        assert instrument.stage.position() == pytest.approx(HOME * COUNT)
        assert instrument.is_in
