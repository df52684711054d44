"""Composition root: a configuration becomes devices whose figures are those predicted; what cannot be is refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from beamline.config import load as config
from beamline.config.stages import StageSection
from beamline.core.errors import ConfigError
from beamline.instrument import connect as devices
from drivers.base.errors import DeviceError
from drivers.base.protocols import TriggerSource
from drivers.dcam.options import DcamOptions
from drivers.manual import ManualSampleMover, ManualShutter
from tests.beamline.ball_scan import STAGES, shipped, small
from tests.beamline.closable import Closable


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
        stage, camera = instrument.devices.stage, instrument.devices.camera
        camera.configure(devices.camera_settings(settings, settings.scan.exposure_s, TriggerSource.EXTERNAL))
        assert stage.limits == limits
        assert camera.timing == timing
        assert [to_counts(a) for a in (-0.1, 0, 1, 6.3)] == [stage.to_counts(a) for a in (-0.1, 0, 1, 6.3)]
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
        ("scan.exposure_s=1e-7", "devices.camera: exposure 1e-07 s lies outside"),
        ("devices.stage.acceleration_deg_s2=0.001", "devices.stage: .*gentl"),
        ("devices.stage.max_speed_deg_s=5001", r"devices.stage: 5001 deg/s are 5001000 pulses/s, .* 1 to 5000000"),
        ("devices.stage.max_speed_deg_s=0.0001", "devices.stage: 0.0001 deg/s are 0 pulses/s"),
        ("devices.stage.pulse_width_s=0.005", "devices.stage: the trigger output has no pulses of 0.005 s; it has"),
        (f"devices.stage={STAGES['zaber'].replace('60,', '1e-9,')}", "devices.stage: 30 deg/s and 1e-09 deg/s² are"),
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
        with pytest.raises(ConfigError, match=r"simulation\.scene: "):
            call(wrong)


def test_instrument_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stage is freed where the camera does not open; shutter and sample are the operator's."""
    stage, made = Closable(), []
    monkeypatch.setattr(StageSection, "connect", lambda *args: stage)
    with pytest.raises(DeviceError, match="camera"):
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
    assert made[0][1]["options"] == DcamOptions(ring_bytes=1_000_000_000)
    assert isinstance(instrument.devices.shutter, ManualShutter)
    assert isinstance(instrument.devices.sample, ManualSampleMover)
    assert instrument.truth is None
    instrument.devices.shutter.open()
    assert asked == ["Open the beam shutter."]
    instrument.close()
    assert stage.closed == 2


def test_a_beam_monitor_is_part_of_the_bench(tmp_path: Path) -> None:
    with devices.connect(small()) as instrument:
        assert instrument.beam_monitor is None
    transcript = tmp_path / "electrometer.txt"
    chosen = f"{{kind: electrometer, port: 'sim://electrometer', scale: 1e9, unit: nA, transcript: '{transcript}'}}"
    with devices.connect(small(f"devices.beam_monitor={chosen}")) as instrument:
        assert instrument.beam_monitor is not None
        reading = instrument.beam_monitor.reading()
        assert (reading.value, reading.unit) == (pytest.approx(1.0), "nA")
        assert abs(reading.time - instrument.clock.now()) < 1
    with pytest.raises(DeviceError):
        instrument.beam_monitor.reading()
    assert b"READ?" in transcript.read_bytes()
    page = tmp_path / "ring.txt"
    page.write_text("I = 99.5 mA", encoding="utf-8")
    chosen = f"{{kind: ring_current, url: '{page.as_uri()}', pattern: 'I = ([0-9.]+) mA'}}"
    with devices.connect(small(f"devices.beam_monitor={chosen}")) as instrument:
        assert instrument.beam_monitor is not None
        assert instrument.beam_monitor.reading().value == 99.5


def test_a_port_that_is_not_there() -> None:
    with pytest.raises(DeviceError, match="COM_NONE"):
        devices.connect(shipped("instrument", "devices.stage.port=COM_NONE"))
