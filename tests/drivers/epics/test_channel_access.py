"""The same over Channel Access: aioca with a soft IOC of caproto in a separate program."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator

import pytest

from drivers.base.clock import SystemClock
from drivers.base.errors import DeviceError, DeviceTimeout
from drivers.epics.channel import ProcessVariable, open_channel
from drivers.epics.devices import FilterPvs, PvFilter, PvShutter, PvSource, ShutterPvs
from drivers.stages.epics.stage import EpicsSettings, EpicsStage
from tests.drivers.soft_ioc import PREFIX
from tests.drivers.stages.epics.test_conformance import USUAL
from tests.drivers.stages.flat_settings import flat
from tests.messages import refused

pytest.importorskip("aioca")
pytest.importorskip("caproto")
URL = f"ca://{PREFIX}"


@pytest.fixture(scope="module")
def ioc(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ProcessVariable]:
    """libca reads its addresses once in a process; nothing else here uses it."""
    errors = tmp_path_factory.mktemp("ioc") / "stderr"
    with errors.open("w") as stderr, pytest.MonkeyPatch.context() as patch:
        command = [sys.executable, "-m", "tests.drivers.ca_ioc"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=stderr, text=True) as program:
            assert program.stdout is not None
            if not (port := program.stdout.readline().strip()):
                pytest.fail(f"the soft IOC ended before it listened:\n{errors.read_text()}")
            patch.setenv("EPICS_CA_SERVER_PORT", port)
            patch.setenv("EPICS_CA_ADDR_LIST", "127.0.0.1")
            patch.setenv("EPICS_CA_AUTO_ADDR_LIST", "NO")
            yield open_channel(URL, "device", 60.0)
            program.kill()


def test_numbers_texts_choices_and_alarms(ioc: ProcessVariable) -> None:
    number, text, blade, broken = ioc.read("number", "text", "blade", "broken")
    assert (number.value, text.value, (blade.value, blade.label)) == (1.5, "mm", (0.0, "Closed"))
    assert (number.severity, broken.severity) == (0, 3)
    ioc.write("number", -2.25)
    assert ioc.read("number")[0].value == -2.25
    with refused(DeviceError):
        PvSource(f"{URL}broken", 10.0).text()
    closed = open_channel(URL, "device", 1.0)
    closed.close()
    with refused(DeviceError):
        closed.read("number")


def test_a_shutter_by_labels(ioc: ProcessVariable) -> None:
    url = f"{URL}blade"
    shutter = PvShutter(ShutterPvs(url, url, url, "Open", "Closed", "Open", timeout=30.0), SystemClock())
    shutter.open()
    assert shutter.is_open() and ioc.read("blade")[0].label == "Open"
    shutter.close()
    assert not shutter.is_open()
    shutter.disconnect()


def test_a_filter_by_labels(ioc: ProcessVariable) -> None:
    url = f"{URL}blade"
    changer = PvFilter(FilterPvs(pv=url, places={"none": "Open", "Al 1 mm": "Closed"}, timeout=30.0), SystemClock())
    for place, label in (("Al 1 mm", "Closed"), ("none", "Open")):
        changer.put(place)
        assert changer.place() == place and ioc.read("blade")[0].label == label
    changer.close()


def test_a_motor_record_moves_until_its_ioc_dies(ioc: ProcessVariable) -> None:
    url, clock = f"{URL}m1", SystemClock()
    stage = EpicsStage(url, flat(EpicsSettings, **(USUAL | {"timeout": 30.0})), clock)
    stage.start_move(math.radians(5), math.radians(20))
    assert stage.moving()
    assert math.degrees(stage.wait(60)) == pytest.approx(5)
    assert ioc.read("m1.VELO")[0].value == pytest.approx(20)
    stage.close()
    assert ioc.read("m1.VELO")[0].value == 1.0
    stage = EpicsStage(url, flat(EpicsSettings, **(USUAL | {"timeout": 2.0})), clock)
    stage.start_move(math.radians(80), math.radians(2))
    ioc.write("number", 666)
    with refused(DeviceTimeout):
        stage.wait(60)
    stage.close()
