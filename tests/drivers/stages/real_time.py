"""Every stage on real time behind a port (sim://, pseudo-terminal, TCP) whose next replies can be other bytes."""

from __future__ import annotations

import itertools
import math
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any

import pytest

from drivers.base.clock import Clock, SystemClock
from drivers.stages.pi_gcs.stage import PiGcsStage
from drivers.stages.pm16c.stage import PM16CStage
from drivers.stages.settings import StageDriver
from drivers.stages.zaber.stage import ZaberStage
from drivers.testing.stages.bench import StageBench
from simulators.devices.clock import ScaledClock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.pm16c.wire import PM16CBuild, PM16CController
from simulators.wires.wire import Wire, register
from simulators.wires.zaber.wire import ZaberBuild, ZaberController
from tests.drivers import zaber_rig
from tests.drivers.stages import pi_gcs_rig
from tests.drivers.stages.flat_settings import flat
from tests.simulators.wires.transports import serve_pty, serve_tcp

FAST = math.radians(60)
SOON = 10.0
"""s; a busy machine takes its time."""
Serve = Callable[[Wire], AbstractContextManager[str]]
NUMBERS = itertools.count()


@contextmanager
def serve_sim(wire: Wire) -> Iterator[str]:
    yield register(f"real-time-{next(NUMBERS)}", wire)


needs_pty = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals that pyserial opens")
PLUGS = [pytest.param(serve_pty, marks=needs_pty, id="pty"), pytest.param(serve_tcp, id="tcp")]
"""Those that can be pulled out."""
TRANSPORTS = [pytest.param(serve_sim, id="sim"), *PLUGS]
SPEEDS: dict[Serve, float] = {serve_sim: 8.0, serve_pty: 2.0, serve_tcp: 1.0}
"""Seconds of the clock of controller and driver in one real second. In one thread nothing can be late, so that sim://
may be fast; a terminal is as real at twice the speed, with twice the timeout."""


@dataclass(frozen=True)
class Kind:
    """A driver and its stand-in.

    Attributes:
        driver: its class.
        usual: values of them.
        wire: makes the stand-in.
        unreferenced: settings of the stand-in that has not found its reference yet, where there is such a state.
        homed: what it says of its reference at power-on otherwise.
        home: counts at which a search ends.
        garbage: what may come instead of a reply to a question after the position.
        opening: beginnings of the first two things that the driver sends; `among`: a part of a later one.
        farewell: parts of the last things that it sends.
    """

    driver: StageDriver
    usual: Mapping[str, Any]
    wire: Callable[..., Any]
    garbage: tuple[bytes, ...]
    opening: tuple[str, str]
    among: str
    farewell: tuple[str, ...]
    unreferenced: Mapping[str, Any] = field(default_factory=dict)
    homed: bool = True
    home: int = 0


GARBAGE = (b"\xff\xfe\x00\x80 noise \r\n", b"\r\n\r\n\r\n", b"x" * 3000)
QUICK = {"max_speed": FAST, "acceleration": math.radians(2000)}
PATIENCE = 0.25
"""s of real time for a reply."""


def _pm16c(clock: Clock, line: TriggerLine, **faults: Any) -> PM16CController:
    return flat(PM16CBuild, counts_per_turn=36_000, home_at=50, **faults).controller(clock, line)


def _zaber(clock: Clock, line: TriggerLine, **faults: Any) -> ZaberController:
    return flat(ZaberBuild, counts_per_turn=360_000, **faults).controller(clock, line)


KINDS = {
    "pm16c": Kind(
        PM16CStage,
        QUICK
        | {"counts_per_turn": 36_000, "low": math.radians(-5), "high": math.radians(100), "home": math.radians(0.5)},
        _pm16c,
        garbage=(*GARBAGE, b"R0S0", b"\x00" * 50 + b"\r\n+0000000\r\n"),
        opening=(r"b'\r\n'", r"b'VER?\r\n'"),
        among="b'TMGR?0",
        farewell=(r"b'LOC\r\n'",),
        homed=False,
        home=50,
    ),
    "pi_gcs": Kind(
        PiGcsStage,
        pi_gcs_rig.USUAL | QUICK,
        pi_gcs_rig.controller,
        garbage=(*GARBAGE, b"1=0.0", b"2=0.000000\n"),
        opening=(r"b'\n'", r"b'*IDN?\n'"),
        among="b'ACC 1 2000",
        farewell=("b'SPA 1 0xC ", r"b'ERR?\n'"),  # what opening changed is restored, and taken
        unreferenced={"referenced": False, "found_at": 0.5},
    ),
    "zaber": Kind(
        ZaberStage,
        zaber_rig.USUAL | QUICK,
        _zaber,
        garbage=(*GARBAGE, b"@01 1 ", b"@01 1 00 OK IDLE -- 7\r\n"),
        opening=("b'", "b'/1 0 00 get comm.checksum:"),
        among="get device.id",
        farewell=("set comm.checksum 0",),
        unreferenced={"homed": False},
    ),
}


class Disturbed:
    """A stand-in whose next replies may be replaced by other bytes, in order."""

    def __init__(self, wire: Wire) -> None:
        self.clock, self._wire = wire.clock, wire
        self.instead: list[bytes] = []
        self._lock = threading.Lock()

    def receive(self, data: bytes) -> None:
        with self._lock:
            self._wire.receive(data)

    def transmit(self) -> bytes:
        with self._lock:
            data = self._wire.transmit()
            return self.instead.pop(0) if data and self.instead else data


class Real:
    """A stage on real time behind a transport; `unplug` pulls its cable out."""

    def __init__(
        self,
        kind: Kind,
        serve: Serve,
        plugged: ExitStack,
        settings: Mapping[str, Any] | None = None,
        *,
        unreferenced: bool = False,
    ) -> None:
        clock = ScaledClock(SystemClock(), SPEEDS[serve])
        line = TriggerLine(clock)
        self.kind = kind
        self.wire = Disturbed(kind.wire(clock, line, **(kind.unreferenced if unreferenced else {})))
        self.unplug = plugged.close
        url = plugged.enter_context(serve(self.wire))
        timeout = PATIENCE * SPEEDS[serve] if serve is not serve_sim else PATIENCE
        chosen = flat(kind.driver.Settings, **(kind.usual | {"timeout": timeout} | (settings or {})))
        self.stage = kind.driver(url, chosen, clock)
        self.bench = StageBench(self.stage, clock, line)
