"""Serial line: closing it (also from another thread); nothing stays open if opening fails."""

from __future__ import annotations

import errno
import gc
import itertools
import math
import sys
import threading
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
import serial

from drivers.base.clock import SystemClock
from drivers.base.errors import DeviceError, DeviceRefused
from drivers.serial.line import LineRules, Probe, SerialLine
from simulators.devices.clock import VirtualClock
from simulators.wires.wire import Wire, register
from tests.messages import refused
from tests.simulators.wires.transports import serve_pty, serve_tcp

NAMES = (f"line-end-test-{number}" for number in itertools.count())
needs_pty = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals that pyserial opens")


class Answers:
    """Answers every line with "1" once `ready` is set."""

    def __init__(self, clock: Any) -> None:
        self.clock = clock
        self.asked, self.ready = threading.Event(), threading.Event()
        self.ready.set()
        self._owed = 0

    def receive(self, data: bytes) -> None:
        self._owed += data.count(b"\r\n")
        self.asked.set()

    def transmit(self) -> bytes:
        if not self.ready.is_set():
            return b""
        owed, self._owed = self._owed, 0
        return b"1\r\n" * owed


def connect(url: str, clock: Any, **settings: Any) -> SerialLine:
    usual: dict[str, Any] = {"timeout": 5.0, "baudrate": 9600, "device": "echo"}
    return SerialLine(url, LineRules(Probe("ID?", "1")), clock, **(usual | settings))


@pytest.mark.parametrize("serve", [pytest.param(serve_pty, marks=needs_pty), serve_tcp])
def test_a_closed_line_says_so_whatever_it_is_asked(serve: Callable[[Wire], AbstractContextManager[str]]) -> None:
    clock = SystemClock()
    with serve(Answers(clock)) as url:
        line = connect(url, clock)
        line.query("N?", "1", "one")
        for _ in range(2):
            line.close()
            for ask in (
                lambda: line.query("N?", "1", "one"),
                lambda: line.query(b"\x05", "1", "one"),
                lambda: line.send("GO"),
                lambda: line.send(b"\x18"),
            ):
                with refused(DeviceError):
                    ask()


def test_closing_waits_for_the_request_of_another_thread() -> None:
    clock = SystemClock()
    wire = Answers(clock)
    line = connect(register(next(NAMES), wire), clock)
    wire.ready.clear()
    answers: list[str] = []
    asking = threading.Thread(target=lambda: answers.append(line.query("N?", "1", "one")[0]))
    asking.start()
    assert wire.asked.wait(60.0)
    closing = threading.Thread(target=line.close)
    closing.start()
    wire.ready.set()
    asking.join(60.0)
    closing.join(60.0)
    assert answers == ["1"]
    assert not closing.is_alive()
    with refused(DeviceError):
        line.query("N?", "1", "one")


@pytest.mark.parametrize("timeout", [0.0, -1.0, math.nan, math.inf])
def test_an_invalid_timeout_is_refused(timeout: float) -> None:
    clock = VirtualClock()
    with pytest.raises(DeviceRefused, match=r"timeout.*number of seconds.*Nothing was sent"):
        connect(register(next(NAMES), Answers(clock)), clock, timeout=timeout)


@pytest.mark.parametrize(
    ("settings", "kind"),
    [({"url": "sim://nobody"}, DeviceError), ({"baudrate": None}, Exception), ({"baudrate": "fast"}, DeviceError)],
)
def test_a_line_that_does_not_open_leaves_no_transcript_open(
    tmp_path: Path, settings: dict[str, Any], kind: type[Exception]
) -> None:
    clock = VirtualClock()
    usual: dict[str, Any] = {"url": register(next(NAMES), Answers(clock)), "transcript": tmp_path / "line.txt"}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ResourceWarning)
        with pytest.raises(kind):
            connect(clock=clock, **(usual | settings))
        gc.collect()
    assert [str(entry.message) for entry in caught] == []


def test_an_interrupted_opening_leaves_no_transcript_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(serial, "serial_for_url", interrupted)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ResourceWarning)
        with pytest.raises(KeyboardInterrupt):
            connect("sim://any", VirtualClock(), transcript=tmp_path / "line.txt")
        gc.collect()
    assert [str(entry.message) for entry in caught] == []


def test_a_transcript_on_a_full_disk_ends_neither_the_conversation_nor_the_closing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class FullDisk:
        def write(self, data: bytes) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

        def close(self) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "open", lambda *_, **__: FullDisk())
    clock = VirtualClock()
    line = connect(register(next(NAMES), Answers(clock)), clock, transcript=tmp_path / "line.txt")
    assert line.query("N?", "1", "one")[0] == "1"
    line.close()
    monkeypatch.setattr(FullDisk, "write", lambda self, data: len(data))
    line = connect(register(next(NAMES), Answers(clock)), clock, transcript=tmp_path / "line.txt")
    assert line.query("N?", "1", "one")[0] == "1"
    line.close()
