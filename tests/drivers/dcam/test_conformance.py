"""DcamCamera over the fake library does what every camera does."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from drivers.orca_quest import SENSOR_SHAPE
from drivers.testing.camera import CameraBench, CameraConformance
from tests.drivers.orca_bench import orca_bench, says_what_an_orca_says


class TestDcamCamera(CameraConformance):
    @pytest.fixture
    def bench(self, world) -> Iterator[CameraBench]:
        world.reset(*SENSOR_SHAPE)
        camera = world.connect()
        yield orca_bench(camera, world.clock, world.schedule)
        camera.close()
        assert world.live == 0

    def test_its_conversion_is_that_of_an_orca(self, bench: CameraBench) -> None:
        says_what_an_orca_says(bench)
