"""Transports: bytes both ways over TCP and pseudo-terminals, one client after another, and the plug pulled."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack

import pytest
import serial

from drivers.base.clock import SystemClock
from simulators.wires.wire import Wire
from tests.simulators.wires.transports import serve_pty, serve_tcp

needs_pty = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals that pyserial opens")
Serve = Callable[[Wire], AbstractContextManager[str]]
both = pytest.mark.parametrize("serve", [serve_tcp, pytest.param(serve_pty, marks=needs_pty)])


class Shouter:
    """Says what it hears in capitals, a moment later; and `noise` unasked."""

    def __init__(self) -> None:
        self.clock = SystemClock()
        self.noise = b""
        self._out: list[tuple[float, bytes]] = []
        self._lock = threading.Lock()

    def receive(self, data: bytes) -> None:
        with self._lock:
            self._out.append((self.clock.now() + 0.01, data.upper()))

    def transmit(self) -> bytes:
        with self._lock:
            noise, self.noise = self.noise, b""
            due = [data for time, data in self._out if time <= self.clock.now()]
            self._out = self._out[len(due) :]
            return noise + b"".join(due)


@both
def test_bytes_go_both_ways_unchanged_and_late_ones_arrive(serve: Serve) -> None:
    """All 256 of them: nothing on the way takes a control character for a command, or CR for LF."""
    every = bytes(range(256))
    with serve(Shouter()) as url, serial.serial_for_url(url, timeout=5.0) as port:
        port.write(every)
        assert port.read(256) == every.upper()


@both
def test_one_client_after_another(serve: Serve) -> None:
    with serve(Shouter()) as url:
        for word in (b"one", b"two"):
            with serial.serial_for_url(url, timeout=5.0) as port:
                port.write(word)
                assert port.read(len(word)) == word.upper()


@both
def test_a_flood_that_nobody_reads_does_not_stop_it(serve: Serve) -> None:
    wire = Shouter()
    with serve(wire) as url, serial.serial_for_url(url, timeout=5.0) as port:
        wire.noise = b"x" * 2_000_000
        port.write(b"\n")
        read = bytearray()
        while not read.endswith(b"\n"):
            data = port.read(max(1, port.in_waiting))
            assert data != b""
            read += data


@both
def test_leaving_pulls_the_plug(serve: Serve) -> None:
    plugged = ExitStack()
    with serial.serial_for_url(plugged.enter_context(serve(Shouter())), timeout=5.0) as port:
        plugged.close()
        with pytest.raises(OSError, match=r"disconnect|Input/output|returned no data|reset by peer"):
            port.read(1)


@both
def test_a_device_that_fails_is_told_and_not_hidden(serve: Serve) -> None:
    class Broken(Shouter):
        def receive(self, data: bytes) -> None:
            raise RuntimeError("a defect of the simulated device")

    with (
        pytest.raises(RuntimeError, match="a defect"),
        serve(Broken()) as url,
        serial.serial_for_url(url, timeout=0.2) as port,
        contextlib.suppress(OSError),
    ):
        port.write(b"x")
        port.read(1)


@both
def test_nothing_stays_behind(serve: Serve) -> None:
    before = threading.active_count()
    files = len(os.listdir("/proc/self/fd")) if sys.platform == "linux" else 0  # noqa: PTH208 - not a folder of files
    for _ in range(2):
        with serve(Shouter()) as url, serial.serial_for_url(url, timeout=1.0) as port:
            port.write(b"x")
    assert threading.active_count() == before
    if sys.platform == "linux":
        assert len(os.listdir("/proc/self/fd")) == files  # noqa: PTH208
