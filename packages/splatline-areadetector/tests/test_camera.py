"""The camera driver for areaDetector passes the suite of all cameras against a fake IOC, and reports what is wrong."""

from __future__ import annotations

import os
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
import yaml

from beamline.config.load import load
from beamline.core.errors import ConfigError
from drivers.base.clock import SystemClock
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.protocols import CameraSettings, TriggerSource
from drivers.testing.camera import CameraBench, CameraConformance
from splatline_areadetector.camera import AreaDetectorCamera, AreaDetectorSettings
from splatline_areadetector.camera_records import DRIVERS
from tests.free_ports import free_ports

FAKE = Path(__file__).with_name("fake_camera.py")
SETTINGS = AreaDetectorSettings(
    "pva://none:", "spinnaker", (256, 320), 0.003, 0.5, dead=0.002, ring=1_000_000, offset=100, timeout=5.0
)
EXTERNAL = CameraSettings(0.01, TriggerSource.EXTERNAL, (32, 64, 64, 96))
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"exposure": 0.0}, "exposure of 0 s"),
    ({"roi": (224, 0, 64, 96)}, "beyond the sensor of 256 x 320"),
    ({"binning": 5}, "cannot be divided by binning 5"),
    ({"readout": "fast"}, "readout 'fast' is unknown; legal: standard"),
]


class FakeIoc:
    """The fake camera's program, ready. Its port of Channel Access is its own: of several IOCs at one port of a
    computer, only one is found by an address without a broadcast."""

    def __init__(self, prefix: str, driver: str) -> None:
        command = [sys.executable, str(FAKE), prefix, driver]
        self.prefix, self.driver = prefix, driver
        (self.port,) = free_ports(1)
        environment = {**os.environ, "EPICS_CA_SERVER_PORT": f"{self.port}", "EPICS_CAS_SERVER_PORT": f"{self.port}"}
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
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
        own: dict[str, Any] = {"prefix": f"pva://{self.prefix}", "driver": self.driver, **changes}
        return AreaDetectorCamera(replace(SETTINGS, **own), SystemClock())

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


def _fixture(driver: str) -> Callable[..., Iterator[FakeIoc]]:
    def ioc(loopback: dict[str, str]) -> Iterator[FakeIoc]:
        with closing(FakeIoc(f"{driver}:", driver)) as running:
            yield running

    return ioc


spinnaker = pytest.fixture(scope="module", name="spinnaker")(_fixture("spinnaker"))
simdetector = pytest.fixture(scope="module", name="simdetector")(_fixture("simdetector"))
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


class TestSimDetector(CameraConformance):
    """Its software triggers are acquisitions of one frame."""

    @pytest.fixture
    def bench(self, simdetector: FakeIoc) -> Iterator[CameraBench]:
        yield from _bench(simdetector)


def _first_frame(camera: AreaDetectorCamera, ioc: FakeIoc) -> Any:
    camera.configure(EXTERNAL)
    camera.arm(1)
    ioc.pulse([time.time() + 0.1])
    return camera.next_frame(5.0)


def test_another_size_than_configured_says_where_to_look(spinnaker: FakeIoc) -> None:
    with closing(spinnaker.camera()) as camera:
        spinnaker.tell("size 16 24")
        try:
            with pytest.raises(DeviceError, match=r"frames have 16 x 24 pixels, but 64 x 96 were set\. .*NDArrayPort"):
                _first_frame(camera, spinnaker)
        finally:
            spinnaker.tell("size")
        camera.disarm()
        assert _first_frame(camera, spinnaker).counts.shape == (64, 96)


def test_a_lost_frame_leaves_a_gap(spinnaker: FakeIoc) -> None:
    """Its number is the driver's; here a frame of another size in the middle is lost."""
    with closing(spinnaker.camera()) as camera:
        stamps = [_first_frame(camera, spinnaker).framestamp]
        for line, expected in (("size 16 24", DeviceError), ("size", None)):
            spinnaker.tell(line)
            time.sleep(0.2)
            spinnaker.pulse([time.time() + 0.05])
            if expected is not None:
                with pytest.raises(expected):
                    camera.next_frame(5.0)
            else:
                stamps.append(camera.next_frame(5.0).framestamp)
        assert stamps == [0, 2]


def test_another_sensor_than_configured_is_refused(spinnaker: FakeIoc) -> None:
    with pytest.raises(DeviceRefused, match=r"sensor of the camera has 256 x 320 pixels, but .*states \[512, 320\]"):
        spinnaker.camera(sensor=(512, 320))


def test_a_label_that_its_driver_does_not_know_is_named(spinnaker: FakeIoc) -> None:
    with closing(spinnaker.camera(driver="pco")) as camera, pytest.raises(DeviceError, match="TriggerMode = Ext Only"):
        camera.configure(EXTERNAL)


def test_a_wrong_prefix_is_a_timeout_that_says_what_to_check(loopback: dict[str, str]) -> None:
    with pytest.raises(
        DeviceTimeout,
        match=r"no answer within 0\.5 s.*Check the name of the process variable, whether its IOC is running",
    ):
        AreaDetectorCamera(replace(SETTINGS, timeout=0.5), SystemClock())


@pytest.mark.parametrize("driver", DRIVERS)
def test_timing_is_that_of_the_configuration(driver: str) -> None:
    own = replace(SETTINGS, driver=driver, min_period=0.0115)  # type: ignore[arg-type]
    timing = AreaDetectorCamera.timing_of(own, replace(EXTERNAL, binning=2))
    assert (timing.shape, timing.min_period, timing.readout, timing.bits) == ((32, 48), 0.012, 0.003, 16)
    assert AreaDetectorCamera.timing_of(own, replace(EXTERNAL, exposure=0.001)).min_period == 0.0115


def _configuration(tmp_path: Path, **camera: object) -> Path:
    """A configuration of an instrument with this camera."""
    text = Path("configs/instrument.yaml").read_text(encoding="utf-8")
    tree = yaml.safe_load(text)
    tree["devices"]["camera"] = {
        "kind": "area_detector", "prefix": "ca://2bmSP2:", "driver": "spinnaker", "line": "Line2", "roi": None,
        "sensor": [2048, 2448], "readout_s": 0.0062, "min_period_s": 0.0065, "electrons_per_count": 0.1, **camera,
    }  # fmt: skip
    path = tmp_path / "my.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return path


def test_a_configuration_names_it_and_a_dry_run_knows_its_timing(tmp_path: Path) -> None:
    config = load(_configuration(tmp_path))
    timing = config.devices.camera.timing_of(CameraSettings(0.005, TriggerSource.EXTERNAL))
    assert timing.shape == (2048, 2448) and timing.min_period == 0.0065


def test_an_unknown_driver_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as told:
        load(_configuration(tmp_path, driver="pcoedge"))
    assert "devices.camera.driver" in f"{told.value}" and "spinnaker" in f"{told.value}"


BY_CHANNEL_ACCESS = """
import sys
from drivers.base.clock import SystemClock
from drivers.base.protocols import CameraSettings, TriggerSource
from splatline_areadetector.camera import AreaDetectorCamera, AreaDetectorSettings
own = AreaDetectorSettings("ca://spinnaker:", "spinnaker", (256, 320), 0.003, 0.5, timeout=30.0)
camera = AreaDetectorCamera(own, SystemClock())
camera.configure(CameraSettings(0.01, TriggerSource.SOFTWARE, (32, 64, 64, 96), 2))
camera.arm(2)
for _ in range(2):
    camera.software_trigger()
    frame = camera.next_frame(30.0)
    print(frame.framestamp, frame.counts.shape, frame.counts.max())
print(camera.describe()["model"])
camera.close()
"""


def test_its_records_answer_by_channel_access_too(spinnaker: FakeIoc, loopback: dict[str, str]) -> None:
    """In a process of its own: Channel Access reads its environment once."""
    environment = {**os.environ, "EPICS_CA_ADDR_LIST": f"127.0.0.1:{spinnaker.port}"}
    done = subprocess.run(
        [sys.executable, "-c", BY_CHANNEL_ACCESS], capture_output=True, text=True, timeout=120, env=environment
    )
    assert done.stdout.splitlines() == ["0 (32, 48) 1", "1 (32, 48) 2", "fake"], done.stderr


def test_frames_are_the_pixels_of_the_message(spinnaker: FakeIoc) -> None:
    with closing(spinnaker.camera()) as camera:
        np.testing.assert_array_equal(_first_frame(camera, spinnaker).counts, np.ones((64, 96), np.uint16))
