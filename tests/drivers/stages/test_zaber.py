"""Zaber driver: the shared conformance suite over the simulated wire, by each way of making pulses."""

from __future__ import annotations

from typing import Any

import pytest

from drivers.stages.zaber_train import PulseSettings
from tests.drivers.stage_conformance import Build, StageBench, StageConformance
from tests.drivers.zaber_rig import Rig


def builder(device: dict[str, Any], driver: dict[str, Any]) -> Build:
    """A function that opens a fresh stage; the device's output is cabled for the polarity that the driver is told."""

    def build(**settings: Any) -> StageBench:
        return Rig(active_high=settings.get("active_high", True), **device).bench(**(driver | settings))

    return build


class TestScheduledPulses(StageConformance):
    WIDTH = 1e-3
    NO_WIDTH = 0.5e-3
    INVERTS = True

    @pytest.fixture
    def build(self) -> Build:
        return builder({}, {})


class TestToggledOutput(StageConformance):
    WIDTH = None
    NO_WIDTH = 1e-3
    INVERTS = True

    @pytest.fixture
    def build(self) -> Build:
        return builder({"can_schedule": False}, {"toggle": True})


class TestFirmwareThatFiresWhenEnabled(StageConformance):
    WIDTH = 1e-3
    INVERTS = True

    @pytest.fixture
    def build(self) -> Build:
        return builder({"fires_when_enabled": True}, {"pulses": PulseSettings(fires_when_enabled=True)})


class TestEncoderPositions(StageConformance):
    WIDTH = 1e-3
    INVERTS = True

    @pytest.fixture
    def build(self) -> Build:
        return builder({"identity": "deviceid"}, {"pulses": PulseSettings(measured=True)})
