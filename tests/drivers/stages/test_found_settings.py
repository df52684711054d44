"""Settings that a stage driver changes are restored at the end, also those that a killed program left."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest

from beamline.config.stages import settings_file
from drivers.base.protocols import RotationStage
from drivers.stages.epics.stage import EpicsSettings, EpicsStage
from drivers.stages.shared import FoundSettings
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.wire import register
from tests.drivers.soft_ioc import TickingClock, record_of
from tests.drivers.stages.epics.test_conformance import USUAL
from tests.drivers.stages.flat_settings import flat
from tests.drivers.stages.rigs import RIGS

SLOW, FAST = math.radians(0.5), math.radians(20)


class EpicsRig:
    def __init__(self) -> None:
        self.clock = TickingClock()
        self.controller = record_of(self.clock, TriggerLine(self.clock))
        self.url = register(f"epics-{uuid4().hex}", self.controller)

    def open(self) -> EpicsStage:
        return EpicsStage(self.url, flat(EpicsSettings, **USUAL), self.clock)


def _zaber(rig: Any) -> dict[str, Any]:
    return {**rig.controller.device.axis.settings, "checksums": rig.controller.device.checksums}


def _pi(rig: Any) -> dict[str, Any]:
    axis = rig.controller.box.axis
    return {"velocity": axis.velocity, "acceleration": axis.acceleration, "deceleration": axis.deceleration}


def _pm16c(rig: Any) -> dict[str, Any]:
    box = rig.controller.box
    channel = box.channels["B"]
    return {
        "speeds": dict(channel.speeds),
        "selected": channel.selected,
        "rate": channel.rate,
        "mapped": box.mapped,
        "remote": box.remote,
    }


def _epics(rig: Any) -> dict[str, Any]:
    return {name: rig.controller.state[name] for name in (".VELO", ".ACCL")}


KINDS: dict[str, tuple[Callable[[], Any], Callable[[Any], dict[str, Any]]]] = {
    "zaber": (RIGS["zaber"], _zaber),
    "pi_gcs": (RIGS["pi_gcs"], _pi),
    "pm16c": (RIGS["pm16c"], _pm16c),
    "epics": (EpicsRig, _epics),
}
every_kind = pytest.mark.parametrize(("rig_of", "settings"), KINDS.values(), ids=KINDS)


def _killed(rig: Any) -> None:
    """The program is gone, and with it its hold of the port."""
    name = rig.url.removeprefix("sim://")
    register(name, rig.controller)


def _moved(stage: RotationStage, degrees: float, speed: float) -> None:
    stage.start_move(math.radians(degrees), speed)
    stage.wait(600)


@every_kind
def test_an_orderly_end_leaves_them_as_they_were(rig_of: Any, settings: Any) -> None:
    rig = rig_of()
    before = settings(rig)
    stage = rig.open()
    _moved(stage, 5, SLOW)
    assert settings(rig) != before
    stage.close()
    assert settings(rig) == before


@every_kind
def test_those_of_a_killed_program_are_restored_by_the_next_and_said(
    rig_of: Any, settings: Any, tmp_path: Path
) -> None:
    rig = rig_of()
    before = settings(rig)
    first = rig.open()
    first.keep_found_settings(settings_file(first.describe(), tmp_path))
    _moved(first, 2, SLOW)
    _killed(rig)
    second = rig.open()
    assert settings_file(second.describe(), tmp_path) == settings_file(first.describe(), tmp_path)
    second.keep_found_settings(settings_file(second.describe(), tmp_path))
    assert "an earlier program that was killed, or lost the connection, changed" in str(
        second.describe()["found_at_opening"]
    )
    _moved(second, 5, FAST)
    second.close()
    # PM16C: REMOTE was set by the program that died
    assert settings(rig) | {"remote": False} == before | {"remote": False}
    assert not list(tmp_path.iterdir())
    third = rig.open()
    third.keep_found_settings(settings_file(third.describe(), tmp_path))
    assert "found_at_opening" not in third.describe()
    third.close()


@every_kind
def test_a_program_that_is_killed_again_does_not_lose_them(rig_of: Any, settings: Any, tmp_path: Path) -> None:
    rig = rig_of()
    before = settings(rig)
    for speed in (SLOW, FAST, SLOW):
        stage = rig.open()
        stage.keep_found_settings(settings_file(stage.describe(), tmp_path))
        _moved(stage, 5 if speed == FAST else 3, speed)
        _killed(rig)
    stage = rig.open()
    stage.keep_found_settings(settings_file(stage.describe(), tmp_path))
    stage.close()
    assert settings(rig) | {"remote": False} == before | {"remote": False}


@pytest.mark.parametrize("content", ["{half", "[1]", None])
def test_a_file_that_is_damaged_or_cannot_be_written_costs_only_the_protection(
    tmp_path: Path, content: str | None
) -> None:
    file = tmp_path / "a.json" if content else tmp_path / "a.json" / "below.json"
    (tmp_path / "a.json").write_text(content or "", encoding="utf-8")
    found, written = FoundSettings(), dict[str, str]()
    found.values = {"maxspeed": "1"}
    found.keep_in(file)
    assert found.notice == "" and file.exists() is (content is not None)
    found.restore(written.__setitem__)
    assert written == {"maxspeed": "1"} and not file.exists()


def test_two_devices_have_two_files(tmp_path: Path) -> None:
    said: list[Mapping[str, object]] = [
        {"model": "m", "serial": "1", "port": "/dev/ttyUSB0"},
        {"model": "m", "serial": "2", "port": "/dev/ttyUSB0"},
        {"model": "m", "port": "/dev/ttyUSB0", "channel": 1},
        {"model": "m", "port": "/dev/ttyUSB1", "channel": 1},
    ]
    assert len({settings_file(one, tmp_path) for one in said}) == 4
    assert settings_file({**said[0], "port": "/dev/ttyUSB9"}, tmp_path) == settings_file(said[0], tmp_path)
