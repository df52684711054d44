"""DcamCamera over the fake library does what every camera does."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from drivers.orca_quest import SENSOR_SHAPE
from tests.drivers.camera_conformance import CameraBench, CameraConformance


class TestDcamCamera(CameraConformance):
    @pytest.fixture
    def bench(self, world) -> Iterator[CameraBench]:
        world.reset(*SENSOR_SHAPE)
        camera = world.connect()
        yield CameraBench(camera, world.clock, world.schedule)
        camera.close()
        assert world.live == 0
