"""The camera of a real instrument: its options reach the driver, and the wait for a cold sensor can be stopped."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path

import pytest

from beamline.config.stages import StageSection
from beamline.core.stop import ScanAborted
from beamline.instrument import connect as devices
from drivers.dcam.options import DcamOptions
from drivers.frame_memory import FrameMemory
from tests.beamline.ball_scan import shipped
from tests.beamline.closable import Closable


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
    assert "-19.5 °C, its cooler says busy" in capsys.readouterr().err
    (camera,) = made
    assert camera.library == Path("/opt/libdcamapi.so")
    assert camera.memory is instrument.frame_memory is not None
    default = DcamOptions()
    for field in dataclasses.fields(DcamOptions):
        value = getattr(camera.options, field.name)
        assert value != getattr(default, field.name), field.name
        key = {"trigger_delay": "trigger_delay_s", "ring_bytes": "ring_mb"}.get(field.name, field.name)
        assert value == said[key] * (1_000_000 if key == "ring_mb" else 1)
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
