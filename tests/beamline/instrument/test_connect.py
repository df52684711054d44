"""Connecting: a configuration becomes devices whose figures match the prediction; impossible ones raise an error."""

import dataclasses
import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

from beamline.config import load as config
from beamline.config.planned import camera_settings
from beamline.config.stages import StageSection
from beamline.core.errors import ConfigError
from beamline.core.stop import ScanAborted
from beamline.instrument import connect as devices
from drivers.base.errors import DeviceError
from drivers.base.protocols import TriggerSource
from drivers.frame_memory import FrameMemory
from drivers.in_beam import ManualSampleMover, ManualShutter
from drivers.orca_quest import DcamOptions
from tests.beamline.ball_scan import STAGES, shipped, small
from tests.beamline.closable import Closable
from tests.messages import refused

pytestmark = pytest.mark.usefixtures("simulated_zaber")


@pytest.mark.parametrize(
    ("name", "stage"), [("simulated", "pm16c"), ("demo", "pm16c"), ("demo", "pi_gcs"), ("demo", "zaber")]
)
def test_dry_run_figures_are_what_the_devices_say(name: str, stage: str) -> None:
    """`describe` asks nobody, yet must agree with the stage and the camera once they are there."""
    settings = shipped(
        name,
        "simulation.clock=virtual",
        f"devices.stage={STAGES[stage]}",
        "devices.stage.acceleration_deg_s2=55",
    )
    limits, timing, to_counts = devices.describe(settings)
    with devices.connect(settings) as instrument:
        turned, camera = instrument.devices.stage, instrument.devices.camera
        camera.configure(camera_settings(settings, settings.scan.exposure_s, TriggerSource.EXTERNAL))
        assert turned.limits == limits
        assert camera.timing == timing
        assert [to_counts(a) for a in (-0.1, 0, 1, 6.3)] == [turned.to_counts(a) for a in (-0.1, 0, 1, 6.3)]
    assert math.degrees(limits.acceleration) <= 55  # the controller has only certain accelerations


def test_close_frees_everything_twice() -> None:
    instrument = devices.connect(small())
    instrument.close()
    instrument.close()
    with pytest.raises(DeviceError):
        instrument.devices.stage.position()
    with pytest.raises(DeviceError):
        instrument.devices.camera.arm(1)


def test_settings_that_a_device_would_refuse() -> None:
    for change, message in (
        ("devices.camera.roi=[0, 0, 30, 40]", "devices.camera: roi .* must be in steps of 4"),
        ("scan.exposure_s=1e-7", "devices.camera: exposure 1e-07 s is outside"),
        ("devices.stage.acceleration_deg_s2=0.001", "devices.stage: .*least acceleration"),
        ("devices.stage.max_speed_deg_s=5001", r"devices.stage: 5001 deg/s are 5001000 pulses/s, .* 1 to 5000000"),
        ("devices.stage.max_speed_deg_s=0.0001", "devices.stage: 0.0001 deg/s are 0 pulses/s"),
        ("devices.stage.pulse_width_s=0.005", "devices.stage: the trigger output has no pulses of 0.005 s; legal:"),
        (f"devices.stage={STAGES['zaber'].replace('60,', '1e-9,')}", "devices.stage: 30 deg/s and 1e-09 deg/s² become"),
        (f"devices.stage={STAGES['pi_gcs'].replace('60,', '1e-9,')}", "devices.stage: .* must be "),
    ):
        with pytest.raises(ConfigError, match=message):
            devices.describe(small(change))
    wrong = small().model_copy(
        update={
            "simulation": config.load(  # a scene that is none
                config.config_folder() / "simulated.yaml", ("simulation.scene={phantom: 7}",), {}
            ).simulation
        }
    )
    for call in (devices.describe, devices.connect):
        with refused(ConfigError):
            call(wrong)


def test_instrument_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stage is freed where the camera does not open; shutter and sample are the operator's."""
    stage, made = Closable(), []
    monkeypatch.setattr(StageSection, "connect", lambda *args: stage)
    with refused(DeviceError):
        devices.connect(shipped("instrument", "devices.camera.library=/nowhere/libdcamapi.so"))
    assert stage.closed == 1

    class Camera(Closable):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__()
            made.append((args, kwargs))

    monkeypatch.setattr("drivers.dcam.camera.DcamCamera", Camera)
    asked: list[str] = []
    instrument = devices.connect(shipped("instrument", "devices.camera.index=1"), ask=asked.append)
    assert made[0][0] == (None, 1)
    assert made[0][1]["options"] == DcamOptions()
    assert isinstance(instrument.devices.shutter, ManualShutter)
    assert isinstance(instrument.devices.sample, ManualSampleMover)
    assert instrument.truth is None
    instrument.devices.shutter.open()
    assert asked == ["Open the beam shutter."]
    instrument.close()
    assert stage.closed == 2


def test_every_camera_option_reaches_the_driver(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Values that are no default, one for each option that the driver has."""
    waited: list[float] = []

    class Camera(Closable):
        def __init__(
            self, library: Path, index: int, *, clock: object, options: DcamOptions, memory: FrameMemory
        ) -> None:
            super().__init__()
            self.library, self.options, self.memory = library, options, memory
            made.append(self)

        def wait_until_cold(self, timeout: float, progress: Callable[[float, str], None]) -> None:
            waited.append(timeout)
            progress(-19.5, "busy")

    made: list[Camera] = []
    monkeypatch.setattr(StageSection, "connect", lambda *args: Closable())
    monkeypatch.setattr("drivers.dcam.camera.DcamCamera", Camera)
    said = {
        "library": "/opt/libdcamapi.so",
        "trigger_active": "level",
        "trigger_mode": "start",
        "trigger_polarity": "negative",
        "trigger_times": 3,
        "trigger_delay_s": 0.5,
        "global_exposure": "global_reset",
        "hot_pixels": "aggressive",
        "exposure_tolerance": 0.1,
        "ring_mb": 50,
        "cool_s": 90,
    }
    changes = [f"devices.camera.{key}={value}" for key, value in said.items()]
    instrument = devices.connect(shipped("instrument", "scan.mode=step", *changes))
    instrument.close()
    assert "-19.5 °C; its cooler reports busy" in capsys.readouterr().err
    (camera,) = made
    assert camera.library == Path("/opt/libdcamapi.so")
    assert camera.memory is instrument.frame_memory is not None
    default = DcamOptions()
    for field in dataclasses.fields(DcamOptions):
        value = getattr(camera.options, field.name)
        assert value != getattr(default, field.name), field.name
        key = {"trigger_delay": "trigger_delay_s", "ring": "ring_mb"}.get(field.name, field.name)
        assert value == cast(float, said[key]) * (1_000_000 if key == "ring_mb" else 1)
    assert waited == [90]


def test_a_stop_ends_the_wait_for_a_cold_sensor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Signals only set the stop request, so that the wait has to look at it; all that is open is closed again."""
    stage, looks, asked = Closable(), itertools.count(1), 3

    class Camera(Closable):
        def wait_until_cold(self, timeout: float, progress: Callable[[float, str], None]) -> None:
            while True:
                progress(20.0, "busy")

    def check_stop() -> None:
        if next(looks) == asked:
            raise ScanAborted("Interrupted")

    camera = Camera()
    monkeypatch.setattr(StageSection, "connect", lambda *args: stage)
    monkeypatch.setattr(devices, "make_camera", lambda *args: camera)
    with pytest.raises(ScanAborted):
        devices.connect(shipped("instrument", "devices.camera.cool_s=900"), check_stop=check_stop)
    assert next(looks) == asked + 1
    assert stage.closed == camera.closed == 1
