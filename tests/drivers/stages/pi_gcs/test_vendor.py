"""Simulated PI GCS 2.0 driven by the vendor's own host library (PIPython), where it is installed: two readings of one
protocol that know nothing of each other. On a pseudo-terminal, as that library opens ports by itself.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest

from drivers.base.clock import SystemClock
from drivers.testing.stages.bench import emitted
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.pi_gcs.wire import PiGcsBuild
from tests.drivers.stages.flat_settings import flat
from tests.drivers.stages.pi_gcs_rig import CABLE
from tests.simulators.wires.transports import serve_pty

pytest.importorskip("pipython", reason="PIPython, the vendor's host library (Python 3.12 or newer), is not installed")
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals that pyserial opens")

SOON = 20.0


class Bench:
    """The vendor's commands on one end, the cable of output 2 on the other."""

    def __init__(self, device: Any, clock: SystemClock, line: TriggerLine) -> None:
        self.device, self.clock, self.line = device, clock, line

    def until_standing(self) -> None:
        deadline = self.clock.now() + SOON
        while any(self.device.IsMoving().values()):
            assert self.clock.now() < deadline
            time.sleep(0.01)

    def degrees(self) -> list[float]:
        """Where pulses were emitted by now."""
        return [round(math.degrees(pulse.angle), 4) for pulse in emitted(self.line, self.clock)]


@pytest.fixture
def bench() -> Iterator[Bench]:
    from pipython.pidevice.gcscommands import GCSCommands
    from pipython.pidevice.gcsmessages import GCSMessages
    from pipython.pidevice.interfaces.piserial import PISerial

    clock = SystemClock()
    line = TriggerLine(clock)
    box = flat(PiGcsBuild, **CABLE, latency=0.002, referenced=False, found_at=1.0).controller(clock, line)
    # Left without its context, that library's device is called again when the next one connects.
    with (
        serve_pty(box) as url,
        PISerial(port=url, baudrate=115200) as gateway,
        GCSCommands(GCSMessages(gateway)) as device,
    ):
        yield Bench(device, clock, line)


def test_it_knows_the_controller_and_its_axis(bench: Bench) -> None:
    assert "C-863" in bench.device.qIDN()
    assert list(bench.device.qSAI()) == ["1"]
    assert bench.device.qFRF("1")["1"] == 0
    assert bench.device.qTMN("1")["1"] == -720.0
    assert list(bench.device.qPOS("1").values()) == [0.0]


def test_it_references_and_moves(bench: Bench) -> None:
    device = bench.device
    device.SVO("1", 1)
    assert device.qSVO("1")["1"] == 1
    device.VEL("1", 30)
    device.FRF("1")
    bench.until_standing()
    assert device.qFRF("1")["1"] == 1
    device.MOV("1", 2.5)
    bench.until_standing()
    assert device.qPOS("1")["1"] == pytest.approx(2.5)
    assert device.qMOV("1")["1"] == pytest.approx(2.5)


def test_errors_are_the_codes_that_it_knows(bench: Bench) -> None:
    from pipython import GCSError, gcserror

    with pytest.raises(GCSError) as unreferenced:
        bench.device.MOV("1", 2.5)
    assert unreferenced.value == gcserror.E5_PI_CNTR_MOVE_WITHOUT_REF_OR_NO_SERVO
    bench.device.HLT("1", noraise=True)
    bench.device.StopAll(noraise=True)
    with pytest.raises(GCSError) as stopped:
        bench.device.HLT("1")
    assert stopped.value == gcserror.E10_PI_CNTR_STOP


def test_its_trigger_commands_give_the_pulses(bench: Bench) -> None:
    device = bench.device
    device.SVO("1", 1)
    device.FRF("1")
    bench.until_standing()
    for parameter, value in ((2, 1), (3, 0), (1, 0.5), (8, 1), (9, 4.25)):
        device.CTO(2, parameter, value)
    device.TRO(2, True)
    assert device.qTRO(2)[2] == 1
    device.MOV("1", 6)
    bench.until_standing()
    assert bench.degrees() == [1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0]
