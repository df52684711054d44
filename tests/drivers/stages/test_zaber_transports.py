"""Zaber driver over every transport on real time (sim://, pseudo-terminal, TCP): moves, a train, garbage, the plug."""

from __future__ import annotations

import gc
import itertools
import math
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from drivers.clock import SystemClock
from drivers.errors import DeviceError
from drivers.stages.zaber import ZaberStage
from simulators.serial_url import register
from simulators.transports import serve_pty, serve_tcp
from simulators.trigger_line import TriggerLine
from simulators.wire import Wire
from simulators.wires.zaber import ZaberController
from tests.drivers.stage_bench import StageBench
from tests.drivers.zaber_rig import settings_of

FAST = math.radians(60)
SOON = 10.0
"""s; a busy machine takes its time."""
NUMBERS = itertools.count()
Serve = Callable[[Wire], AbstractContextManager[str]]


@contextmanager
def serve_sim(wire: Wire) -> Iterator[str]:
    yield register(f"zaber-real-{next(NUMBERS)}", wire)


needs_pty = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals that pyserial opens")
TRANSPORTS = {"sim": serve_sim, "pty": serve_pty, "tcp": serve_tcp}


class Disturbed:
    """A device whose next reply may be replaced by other bytes."""

    def __init__(self, controller: ZaberController) -> None:
        self.clock, self._controller = controller.clock, controller
        self.instead: list[bytes] = []
        self._lock = threading.Lock()

    def receive(self, data: bytes) -> None:
        with self._lock:
            self._controller.receive(data)

    def transmit(self) -> bytes:
        with self._lock:
            data = self._controller.transmit()
            return self.instead.pop(0) if data and self.instead else data


class Real:
    """A stage on real time behind a transport; `unplug` pulls its cable out."""

    def __init__(self, serve: Serve, plugged: ExitStack) -> None:
        clock = SystemClock()
        line = TriggerLine(clock)
        self.wire = Disturbed(ZaberController(clock, line, counts_per_turn=360_000))
        self.url = plugged.enter_context(serve(self.wire))
        self.unplug = plugged.close
        self.bench = StageBench(self.open(), clock, line)

    def open(self, **settings: Any) -> ZaberStage:
        fast = {"max_speed": FAST, "acceleration": math.radians(2000), "timeout": 0.5}
        return ZaberStage(self.url, clock=SystemClock(), **settings_of(**(fast | settings)))


@pytest.fixture(params=["sim", pytest.param("pty", marks=needs_pty), "tcp"])
def real(request: pytest.FixtureRequest) -> Iterator[Real]:
    with ExitStack() as plugged:
        real = Real(TRANSPORTS[request.param], plugged)
        yield real
        real.bench.stage.close()


def test_moves_arrive_at_their_counts(real: Real) -> None:
    stage = real.bench.stage
    for counts in (3000, -1000, 0, 1):
        stage.start_move(stage.to_angle(counts), FAST)
        assert stage.to_counts(stage.wait(SOON)) == counts
        status = stage.status()
        assert (status.counts, status.moving, status.homed, status.fault) == (counts, False, True, "")


def test_a_train_gives_its_pulses_at_its_counts(real: Real) -> None:
    bench = real.bench
    bench.stage.arm(bench.train(1.0, 0.2, 30))
    bench.stage.start_move(math.radians(8), FAST)
    bench.stage.wait(SOON)
    assert [bench.stage.to_counts(pulse.angle) for pulse in bench.pulses()] == list(range(1000, 7000, 200))
    assert bench.stage.remaining_pulses() == 0


def test_a_search_and_a_stop(real: Real) -> None:
    stage = real.bench.stage
    stage.start_move(math.radians(90), math.radians(10))
    stage.stop()
    with pytest.raises(DeviceError, match="stopped short"):
        stage.wait(SOON)
    assert 0 <= stage.status().counts < 90_000
    stage.start_home()
    assert stage.wait(SOON) == 0.0


@pytest.mark.parametrize(
    "garbage", [b"\xff\xfe\x00\x80 noise \r\n", b"@01 1 ", b"\r\n\r\n\r\n", b"x" * 3000, b"@01 1 00 OK IDLE -- 7\r\n"]
)
def test_after_garbage_the_line_finds_its_step_again(real: Real, garbage: bytes) -> None:
    stage = real.bench.stage
    real.wire.instead.append(garbage)
    with pytest.raises(DeviceError):
        stage.position()
    assert stage.position() == 0.0
    assert stage.status().counts == 0


def test_the_transcript_of_a_real_conversation_is_whole(real: Real, tmp_path: Path) -> None:
    real.bench.stage.close()
    stage = real.open(transcript=tmp_path / "line.txt")
    stage.position()
    stage.close()
    text = (tmp_path / "line.txt").read_text()
    sent = [line.split(" ", 2)[2] for line in text.splitlines() if " > " in line]
    assert sent[1].startswith("b'/1 0 00 get comm.checksum:")
    assert "set comm.checksum 0" in sent[-1]


# pyserial leaves a socket that was reset to the garbage collector
@pytest.mark.filterwarnings("ignore:Exception ignored in. <socket:pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("serve", [pytest.param(serve_pty, marks=needs_pty), serve_tcp])
def test_a_plug_pulled_in_the_middle_of_a_move_is_one_error_that_says_so(serve: Serve) -> None:
    with ExitStack() as plugged:
        real = Real(serve, plugged)
        stage = real.bench.stage
        stage.start_move(math.radians(90), math.radians(1))
        real.unplug()
        with pytest.raises(DeviceError, match=r"port failed.*may still be doing"):
            stage.wait(SOON)
        for again in (stage.position, stage.stop, stage.abort):
            with pytest.raises(DeviceError):
                again()
        stage.close()
    gc.collect()
