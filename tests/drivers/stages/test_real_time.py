"""Every stage in real time, over pseudo-terminal and TCP: homing, a trigger train, a pulled plug."""

from __future__ import annotations

import gc
import itertools
import math
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from drivers.base.clock import Clock, SystemClock
from drivers.base.errors import DeviceError
from drivers.stages.pi_gcs.stage import PiGcsStage
from drivers.stages.pm16c.stage import PM16CStage
from drivers.stages.zaber.stage import ZaberStage
from drivers.testing.stages.bench import StageBench
from simulators.devices.clock import ScaledClock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.pm16c.wire import PM16CBuild, PM16CController
from simulators.wires.wire import Wire, register
from tests.drivers import zaber_rig
from tests.drivers.stages import pi_gcs_rig
from tests.drivers.stages.flat_settings import flat
from tests.simulators.wires.transports import serve_pty, serve_tcp
from tests.simulators.wires.zaber.wire import ZaberBuild, ZaberController

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
        home: counts at which a search ends.
        opening: beginnings of the first two things that the driver sends; `among`: a part of a later one.
        farewell: parts of the last things that it sends.
    """

    driver: Any
    usual: Mapping[str, Any]
    wire: Callable[..., Any]
    opening: tuple[str, str]
    among: str
    farewell: tuple[str, ...]
    unreferenced: Mapping[str, Any] = field(default_factory=dict)
    home: int = 0


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
        opening=(r"b'\r\n'", r"b'VER?\r\n'"),
        among="b'TMGR?0",
        farewell=(r"b'LOC\r\n'",),
        home=50,
    ),
    "pi_gcs": Kind(
        PiGcsStage,
        pi_gcs_rig.USUAL | QUICK,
        pi_gcs_rig.controller,
        opening=(r"b'\n'", r"b'*IDN?\n'"),
        among="b'ACC 1 2000",
        farewell=("b'SPA 1 0xC ", r"b'ERR?\n'"),  # what opening changed is restored, and taken
        unreferenced={"referenced": False, "found_at": 0.5},
    ),
    "zaber": Kind(
        ZaberStage,
        zaber_rig.USUAL | QUICK,
        _zaber,
        opening=("b'", "b'/1 0 00 get comm.checksum:"),
        among="get device.id",
        farewell=("set comm.checksum 0",),
        unreferenced={"homed": False},
    ),
}


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
        wire = kind.wire(clock, line, **(kind.unreferenced if unreferenced else {}))
        self.unplug = plugged.close
        url = plugged.enter_context(serve(wire))
        timeout = PATIENCE * SPEEDS[serve] if serve is not serve_sim else PATIENCE
        chosen = flat(kind.driver.Settings, **{**kind.usual, "timeout": timeout, **(settings or {})})
        self.stage = kind.driver(url, chosen, clock)
        self.bench = StageBench(self.stage, clock, line)


every_kind = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


@pytest.fixture(scope="module", params=PLUGS)
def serve(request: pytest.FixtureRequest) -> Serve:
    return request.param


# as on a virtual clock


@every_kind
def test_a_search_and_then_a_train_that_gives_its_pulses_at_its_counts(kind: Kind, serve: Serve) -> None:
    with ExitStack() as plugged:
        real = Real(kind, serve, plugged, unreferenced=True)
        stage, bench = real.stage, real.bench
        stage.start_home()
        assert stage.to_counts(stage.wait(SOON)) == kind.home
        first, step = bench.counts(1.0), bench.counts(0.12)
        assert step * 3000 == stage.limits.counts_per_turn
        stage.arm(bench.train(1.0, 0.12, 60))
        stage.start_move(math.radians(9), FAST)
        assert math.degrees(stage.wait(SOON)) == pytest.approx(9.0)
        assert [stage.to_counts(pulse.angle) for pulse in bench.pulses()] == [first + step * k for k in range(60)]
        stage.close()


@every_kind
def test_the_transcript_of_a_conversation_is_whole(kind: Kind, tmp_path: Path) -> None:
    with ExitStack() as plugged:
        stage = Real(kind, serve_sim, plugged, {"transcript": tmp_path / "line.txt"}).stage
        stage.position()
        stage.close()
    text = (tmp_path / "line.txt").read_text()
    sent = [line.split(" ", 2)[2] for line in text.splitlines() if " > " in line]
    last = sent[-len(kind.farewell) :]
    assert all(words in line for line, words in zip(last, kind.farewell, strict=True)), last
    assert all(line.startswith(words) for line, words in zip(sent, kind.opening, strict=False)), sent[:2]
    assert any(kind.among in line for line in sent)


# the plug


def wait_and_unplug(real: Real) -> DeviceError:
    """What a wait in another thread ends with."""
    errors: list[BaseException] = []
    begun = threading.Event()

    def wait() -> None:
        begun.set()
        try:
            real.stage.wait(SOON)
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=wait)
    thread.start()
    begun.wait()
    real.unplug()
    thread.join(SOON)
    assert not thread.is_alive()
    (error,) = errors
    assert type(error) is DeviceError
    return error


# pyserial leaves a socket that was reset to the garbage collector
@pytest.mark.filterwarnings("ignore:Exception ignored in. <socket:pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("serve", PLUGS)
@every_kind
def test_a_plug_pulled_in_the_middle_of_a_move_is_one_error_that_says_so(kind: Kind, serve: Serve) -> None:
    with ExitStack() as plugged:
        real = Real(kind, serve, plugged)
        stage = real.stage
        stage.start_move(math.radians(90), math.radians(1))
        said = str(wait_and_unplug(real))
        assert "the port failed" in said
        assert "may still be carrying out" in said
        for again in (stage.position, stage.moving, stage.stop, stage.abort):
            with pytest.raises(DeviceError, match=r"may still be carrying out|no whole reply|still no answer"):
                again()
        stage.close()
    gc.collect()
