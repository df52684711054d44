"""The camera driver for areaDetector keeps the laws of every camera, against a fake IOC, and says what is wrong."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.core.errors import ConfigError
from drivers.base.clock import SystemClock
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.protocols import CameraSettings, TriggerSource
from drivers.testing.camera import CameraBench, CameraConformance
from splatline_areadetector.camera import AreaDetectorCamera, AreaDetectorSettings
from splatline_areadetector.camera_labels import DRIVERS

FAKE = Path(__file__).with_name("fake_camera.py")
SETTINGS = AreaDetectorSettings(
    "pva://none:", "spinnaker", (256, 320), 0.003, 0.5, dead=0.002, ring=1_000_000, offset=100, timeout=5.0
)
EXTERNAL = CameraSettings(0.01, TriggerSource.EXTERNAL, (32, 64, 64, 96))
REFUSED = [
    ({"exposure": 0.0}, "exposure of 0 s"),
    ({"roi": (224, 0, 64, 96)}, "beyond the sensor of 256 x 320"),
    ({"binning": 5}, "not divided by binning 5"),
    ({"readout": "fast"}, "readout 'fast' is unknown; legal: standard"),
]


class FakeIoc:
    """The fake camera's program, ready."""

    def __init__(self, prefix: str, driver: str) -> None:
        command = [sys.executable, str(FAKE), prefix, driver]
        self.prefix, self.driver = prefix, driver
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        while (line := self.process.stdout.readline()) != "ready\n":
            assert line, "the fake camera has ended"

    def tell(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()

    def pulse(self, times: Sequence[float]) -> None:
        self.tell(" ".join(f"{at:.6f}" for at in times))

    def camera(self, **changes: Any) -> AreaDetectorCamera:
        own = replace(SETTINGS, prefix=f"pva://{self.prefix}", driver=self.driver)
        return AreaDetectorCamera(replace(own, **changes), SystemClock())

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


def _fixture(driver: str) -> Callable[..., Iterator[FakeIoc]]:
    def ioc(loopback: dict[str, str]) -> Iterator[FakeIoc]:
        with closing(FakeIoc(f"{driver}:", driver)) as running:
            yield running

    return ioc


spinnaker = pytest.fixture(scope="module", name="spinnaker")(_fixture("spinnaker"))
andor3 = pytest.fixture(scope="module", name="andor3")(_fixture("andor3"))


def _bench(ioc: FakeIoc) -> Iterator[CameraBench]:
    with closing(ioc.camera()) as camera:
        yield CameraBench(camera, SystemClock(), ioc.pulse, EXTERNAL, REFUSED, binnings=(2, 4), time_error=5e-3)


class TestSpinnaker(CameraConformance):
    """Frames are numbered by the camera."""

    @pytest.fixture
    def bench(self, spinnaker: FakeIoc) -> Iterator[CameraBench]:
        yield from _bench(spinnaker)


class TestAndor3(CameraConformance):
    """Frames are numbered by ArrayCounter; binning is a label."""

    @pytest.fixture
    def bench(self, andor3: FakeIoc) -> Iterator[CameraBench]:
        yield from _bench(andor3)
