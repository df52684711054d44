"""`beamline check --connect` asks each device; one that does not answer does not block the others; nothing moves."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from beamline.config import load as config
from beamline.config.stages import StageSection
from beamline.instrument.states import DeviceState, device_states
from drivers.base.clock import SystemClock
from tests.beamline.ball_scan import shipped
from tests.beamline.cli.small_scan import beamline
from tests.beamline.fakes import FakeInstrument
from tests.drivers.dcam.usb_bus import Bus, Descriptor

DEMO = str(config.config_folder() / "demo.yaml")
ABSENT = ("devices.camera.library=/nowhere/libdcamapi.so",)


def read(*overrides: str, usb: Bus | None = None) -> dict[str, DeviceState]:
    states = device_states(shipped("instrument", *ABSENT, *overrides), SystemClock(), usb or Bus(Descriptor()))
    return {state.name: state for state in states}


def test_who_they_are_and_how_they_stand(tmp_path: Path) -> None:
    page = tmp_path / "ring.txt"
    page.write_text("199.4 mA", encoding="utf-8")
    ring = f"devices.beam_monitor={{kind: ring_current, url: '{page.as_uri()}', pattern: '(.+) mA'}}"
    result = beamline("check", DEMO, "--connect", "--set", ring)
    assert result.exit_code == 0, result.output
    said = dict(line.split(maxsplit=1) for line in result.stdout.split("is valid")[1].splitlines()[1:])
    assert said["stage"].startswith("model Tsuji PM16C") and said["stage"].endswith("position_deg 0.0, moves False")
    assert said["shutter"] == "open False" and said["beam"] == "monitor  value 199.4, unit mA"
    page.write_text("down mA", encoding="utf-8")
    lines = beamline("check", DEMO, "--connect", "--json", "--set", ring).stdout.splitlines()
    device, failed = map(json.loads, lines[-2:])
    assert device["name"] == "beam monitor" and "'down mA'" in device["fault"]
    assert (failed["event"], failed["exit_code"]) == ("failed", 3)


def test_one_that_does_not_answer_keeps_no_other_from_being_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    found = read("devices.stage.port=COM_NONE")
    assert re.search("'COM_NONE' does not open.*Serial ports of this computer", found["stage"].fault)
    assert "cannot be loaded" in found["camera"].fault and "shutter" not in found
    result = beamline("check", str(config.config_folder() / "instrument.yaml"), "--connect", "--set", ABSENT[0])
    assert result.exit_code == 3 and "stage and camera cannot be used. Nothing has moved" in result.stderr

    instrument = FakeInstrument()
    monkeypatch.setattr(StageSection, "connect", lambda *_: instrument.stage)
    monkeypatch.setattr("beamline.instrument.states.make_camera", lambda *_: instrument.camera)
    before = instrument.stage.position()
    assert not any(state.fault for state in read().values())
    assert instrument.stage.position() == before and "open" not in instrument.log


@pytest.mark.parametrize(
    ("devices", "camera", "fault"),
    [
        ((Descriptor(),), "", ""),
        ((Descriptor(speed=3),), "", "480 Mbit/s.* needs a SuperSpeed link"),
        ((), "", "No USB device 0661"),
        ((Descriptor(),), "devices.camera.usb_serial='000999'", "with serial number 000999"),
        ((), "devices.camera.link=coaxpress", None),
    ],
)  # fmt: skip
def test_the_link_of_the_camera(devices: tuple[Descriptor, ...], camera: str, fault: str | None) -> None:
    found = read(*([camera] if camera else []), usb=Bus(*devices))
    if fault is None:
        assert "camera link" not in found
    else:
        state = found["camera link"]
        assert bool(state.fault) == bool(fault) and re.search(fault, state.fault)


def test_the_old_name_says_the_new_one() -> None:
    result = beamline("doctor", DEMO, "--session")
    assert result.exit_code == 0 and "is now `beamline check CONFIG --connect`" in result.stderr
    assert "stage  " in result.stdout
