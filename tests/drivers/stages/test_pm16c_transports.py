"""PM16C driver over every transport on real time (sim://, pseudo-terminal, TCP): short moves, garbage, the plug."""

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
from drivers.motion import start_move_by
from drivers.stages.pm16c import PM16CStage
from simulators.serial_url import register
from simulators.transports import serve_pty, serve_tcp
from simulators.trigger_line import TriggerLine
from simulators.wire import Wire
from simulators.wires.pm16c import PM16CController
from tests.drivers.stage_bench import StageBench

COUNTS = 36_000
FAST = math.radians(60)
SOON = 10.0
"""s; a busy machine takes its time."""
NUMBERS = itertools.count()
Serve = Callable[[Wire], AbstractContextManager[str]]


@contextmanager
def serve_sim(wire: Wire) -> Iterator[str]:
    yield register(f"pm16c-real-{next(NUMBERS)}", wire)


needs_pty = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals that pyserial opens")
TRANSPORTS = {"sim": serve_sim, "pty": serve_pty, "tcp": serve_tcp}


class Disturbed:
    """A controller whose next reply may be replaced by other bytes, in order."""

    def __init__(self, controller: PM16CController) -> None:
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
        self.wire = Disturbed(PM16CController(clock, line, counts_per_turn=COUNTS, home_at=50))
        self.url = plugged.enter_context(serve(self.wire))
        self.unplug = plugged.close
        self.bench = StageBench(self.open(), clock, line)

    def open(self, **settings: Any) -> PM16CStage:
        usual: dict[str, Any] = {
            "counts_per_turn": COUNTS,
            "clock": SystemClock(),
            "timeout": 0.5,
            "max_speed": FAST,
            "acceleration": math.radians(2000),
            "low": math.radians(-5),
            "high": math.radians(100),
            "home": math.radians(0.5),
        }
        return PM16CStage(self.url, **(usual | settings))


@pytest.fixture(params=["sim", pytest.param("pty", marks=needs_pty), "tcp"])
def real(request: pytest.FixtureRequest) -> Iterator[Real]:
    with ExitStack() as plugged:
        real = Real(TRANSPORTS[request.param], plugged)
        yield real
        real.bench.stage.close()


# as on a virtual clock


def test_moves_arrive_at_their_counts(real: Real) -> None:
    stage = real.bench.stage
    for counts in (300, -100, 0, 1):
        stage.start_move(stage.to_angle(counts), FAST)
        assert stage.to_counts(stage.wait(SOON)) == counts
        status = stage.status()
        assert (status.counts, status.moving, status.fault) == (counts, False, "")


def test_relative_moves_land_on_exact_counts(real: Real) -> None:
    stage = real.bench.stage
    for _ in range(20):
        start_move_by(stage, math.radians(1 / 3), FAST)
        stage.wait(SOON)
    assert stage.status().counts == 20 * 33


def test_a_train_gives_its_pulses_at_its_counts(real: Real) -> None:
    bench = real.bench
    bench.stage.arm(bench.train(1.0, 0.1, 60))
    bench.stage.start_move(math.radians(8), FAST)
    bench.stage.wait(SOON)
    assert [bench.stage.to_counts(pulse.angle) for pulse in bench.pulses()] == list(range(100, 700, 10))


def test_a_search_ends_at_the_reference(real: Real) -> None:
    stage = real.bench.stage
    for degrees in (2.0, -1.0):
        stage.start_move(math.radians(degrees), FAST)
        stage.wait(SOON)
        stage.start_home()
        assert stage.to_counts(stage.wait(SOON)) == 50
        assert stage.status().homed is True


def test_a_stop_on_the_way_stands_short(real: Real) -> None:
    stage = real.bench.stage
    stage.start_move(math.radians(90), math.radians(10))
    stage.stop()
    with pytest.raises(DeviceError, match="stopped short"):
        stage.wait(SOON)
    assert 0 <= stage.status().counts < 9000
    stage.start_move(0.0, FAST)
    assert stage.wait(SOON) == 0.0


def test_the_transcript_of_a_real_conversation_is_whole(real: Real, tmp_path: Path) -> None:
    real.bench.stage.close()
    stage = real.open(transcript=tmp_path / "line.txt")
    stage.position()
    stage.close()
    text = (tmp_path / "line.txt").read_text()
    sent = [line.split(" ", 2)[2] for line in text.splitlines() if " > " in line]
    assert sent[:2] == [r"b'\r\n'", r"b'VER?\r\n'"]
    assert sent[-1] in (r"b'LOC\r\n'", r"b'PS?0\r\n'")


# disturbed


GARBAGE = [b"\xff\xfe\x00\x80 noise \r\n", b"R0S0", b"\r\n\r\n\r\n", b"x" * 3000, b"\x00" * 50 + b"\r\n+0000000\r\n"]


@pytest.mark.parametrize("garbage", GARBAGE)
def test_after_garbage_the_line_finds_its_step_again(real: Real, garbage: bytes) -> None:
    stage = real.bench.stage
    stage.start_move(math.radians(1), FAST)
    stage.wait(SOON)
    real.wire.instead.append(garbage)
    with pytest.raises(DeviceError):
        stage.position()
    assert stage.to_counts(stage.position()) == 100
    assert stage.status().counts == 100


def test_after_garbage_in_the_middle_of_a_move_the_move_is_still_waited_for(real: Real) -> None:
    stage = real.bench.stage
    stage.start_move(math.radians(20), math.radians(20))
    real.wire.instead.extend([b"\x80\x81\r\n", b"??"])
    failed = 0
    while True:
        try:
            where = stage.wait(SOON)
            break
        except DeviceError as error:
            assert "may be turning" in str(error)
            failed += 1
            assert failed <= 3
    assert failed >= 1
    assert stage.to_counts(where) == 2000


# the plug


def wait_and_unplug(real: Real) -> DeviceError:
    """What a wait in another thread ends with."""
    errors: list[BaseException] = []
    begun = threading.Event()

    def wait() -> None:
        begun.set()
        try:
            real.bench.stage.wait(SOON)
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
@pytest.mark.parametrize("serve", [pytest.param(serve_pty, marks=needs_pty), serve_tcp])
def test_a_plug_pulled_in_the_middle_of_a_move_is_one_error_that_says_so(serve: Serve) -> None:
    with ExitStack() as plugged:
        real = Real(serve, plugged)
        stage = real.bench.stage
        stage.start_move(math.radians(90), math.radians(1))
        said = str(wait_and_unplug(real))
        assert "the port failed" in said
        assert "may still be doing" in said
        for again in (stage.position, stage.stop, stage.abort):
            with pytest.raises(DeviceError):
                again()
        stage.close()
    gc.collect()


@needs_pty
def test_a_second_program_does_not_get_the_terminal() -> None:
    with ExitStack() as plugged:
        real = Real(serve_pty, plugged)
        with pytest.raises(DeviceError, match="does not open"):
            real.open()
        real.bench.stage.close()
        real.open().close()
