"""Beam monitors: a number read from text, from a misbehaving local web server and from an electrometer."""

from __future__ import annotations

import itertools
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.base.clock import SystemClock
from drivers.base.errors import DeviceError, DeviceTimeout
from drivers.base.protocols import BeamMonitor, BeamReading
from drivers.beam_monitors import PATTERN, ElectrometerQuery, PageSource, SerialSource, TextBeamMonitor
from simulators.devices.clock import VirtualClock
from simulators.wires.electrometer import ElectrometerWire
from simulators.wires.wire import register
from tests.messages import refused
from tests.refused_calls import refused_calls

RING = "Ring current: ([-+0-9.eE]+) mA"


class FixedText:
    """A source that always answers with one text."""

    request = "READ?"

    def __init__(self, text: str) -> None:
        self.answer, self.closed = text, False

    def text(self) -> str:
        return self.answer

    def close(self) -> None:
        self.closed = True


def monitor(text: str, pattern: str = RING, **options: Any) -> BeamMonitor:
    return TextBeamMonitor(FixedText(text), VirtualClock(7.0), pattern=pattern, unit="mA", **options)


@given(st.floats(-1e30, 1e30), st.sampled_from(["%.6e", "%.4f", "%+.3E", "%r"]))
def test_every_finite_number_comes_through(value: float, form: str) -> None:
    text = form % value
    assert monitor(f"<b>Ring current: {text} mA</b>").reading() == BeamReading(float(text), "mA", 7.0)


def test_scale_makes_the_unit() -> None:
    assert monitor("Ring current: 0.1994 mA", scale=1000.0).reading().value == pytest.approx(199.4)


@pytest.mark.parametrize(
    ("text", "pattern"),
    [
        ("", RING),
        ("Ring current: --- mA", RING),
        ("Ring current: 1.2.3 mA", RING),
        ("Ring current: e mA", RING),
        ("Ring current: nan mA", "current: (.*) mA"),
        ("Ring current: inf mA", "current: (.*) mA"),
        ("Ring current: 1_0 mA", "current: (.*) mA"),  # Python takes it for 10
        ("Ring current: 1e999 mA", RING),
        ("Ring current: 9.9E37 mA", RING),  # an instrument over range
        ("Ring current: -9.91E37 mA", RING),
        ("anything", "x(1)?|anything"),  # the group takes no part
    ],
)
def test_what_is_no_number_is_no_reading(text: str, pattern: str) -> None:
    with refused(DeviceError) as caught:
        monitor(text, pattern).reading()
    assert caught.value.request == "READ?"


def test_a_long_page_is_told_in_part() -> None:
    with pytest.raises(DeviceError) as caught:
        monitor("x" * 100_000).reading()
    assert len(str(caught.value)) < 600


@contextmanager
def page(
    status: int, body: bytes, kind: str = "text/html; charset=latin-1", length: int | None = None
) -> Iterator[str]:
    """A web server on this computer that answers everything so; its address."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body) if length is None else length))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *args: object) -> None:
            """Tests are quiet."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/ring"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def ring(url: str, timeout: float = 5.0) -> BeamMonitor:
    clock = SystemClock()
    return TextBeamMonitor(PageSource(url, clock, timeout=timeout), clock, pattern=RING, unit="mA")


@pytest.fixture(autouse=True)
def no_proxy_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """A proxy that does not exist: the facility's own page is not asked for through it."""
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    monkeypatch.delenv("no_proxy", raising=False)


@pytest.mark.parametrize("kind", ["text/html; charset=latin-1", "text/plain", "text/plain; charset=klingon"])
def test_a_page(kind: str) -> None:
    with page(200, "<h1>Störung: keine</h1> Ring current: 199.4 mA".encode("latin-1"), kind) as url:
        before = SystemClock().now()
        reading = ring(url).reading()
    assert (reading.value, reading.unit) == (199.4, "mA")
    assert before - 1 < reading.time < before + 60


@pytest.mark.parametrize(("status", "reason"), [(404, "404 Not Found"), (503, "503 Service Unavailable")])
def test_a_page_that_is_an_error(status: int, reason: str) -> None:
    """Even where the error's own page holds a number."""
    with page(status, b"Ring current: 1 mA") as url, pytest.raises(DeviceError, match=f"the server answered {reason}"):
        ring(url).reading()


def test_a_page_that_breaks_off() -> None:
    with page(200, b"Ring cur", length=1000) as url, pytest.raises(DeviceError, match=r"cannot be read|no number"):
        ring(url).reading()


@contextmanager
def listening(answer: bytes) -> Iterator[str]:
    """A server that takes the connection, sends `answer` and then nothing, without an end."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        taken: list[socket.socket] = []

        def serve() -> None:
            connection, _ = server.accept()
            taken.append(connection)
            connection.sendall(answer)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.getsockname()[1]}/"
        finally:
            thread.join()
            for connection in taken:
                connection.close()


@pytest.mark.parametrize("answer", [b"", b"HTTP/1.1 200 OK\r\nContent-Length: 99\r\n\r\nRing current: 1"])
def test_a_server_that_falls_silent_is_waited_for_only_so_long(answer: bytes) -> None:
    with listening(answer) as url, pytest.raises(DeviceTimeout, match=r"no whole page within 0\.1 s"):
        ring(url, timeout=0.1).reading()


def test_a_server_that_talks_nonsense() -> None:
    with listening(b"+1.0E-9A\r\n\r\n") as url, pytest.raises(DeviceError, match="cannot be read"):
        ring(url).reading()


def test_a_page_that_never_ends_is_left_at_the_deadline() -> None:
    """Bytes that keep coming renew the network's own timeout, but not ours."""

    class Dripping(VirtualClock):
        def now(self) -> float:
            self.sleep(0.4)  # each look at the clock is as if a while had passed
            return super().now()

    endless = b"HTTP/1.1 200 OK\r\n\r\n" + b"x" * 200_000
    with listening(endless) as url, pytest.raises(DeviceTimeout, match="no whole page"):
        PageSource(url, Dripping(0.0), timeout=1.0).text()


def test_nobody_listens() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(DeviceError, match="cannot be read"):
        ring(f"http://127.0.0.1:{port}/").reading()


def test_a_file_that_another_program_keeps(tmp_path: Path) -> None:
    file = tmp_path / "ring.txt"
    file.write_text("Ring current: 3.5 mA\n", encoding="utf-8")
    source = ring(file.as_uri())
    assert source.reading().value == 3.5
    file.unlink()
    with pytest.raises(DeviceError, match="cannot be read"):
        source.reading()


NAMES = (f"electrometer-{number}" for number in itertools.count())


def over(wire: ElectrometerWire, transcript: Path | None = None, **query: Any) -> BeamMonitor:
    url, asked = register(next(NAMES), wire), ElectrometerQuery(**query)
    source = SerialSource(url, wire.clock, asked, timeout=0.5, transcript=transcript)
    return TextBeamMonitor(source, wire.clock, pattern=PATTERN, unit="A")


def test_the_current_of_the_moment() -> None:
    clock = VirtualClock(100.0)
    monitor = over(ElectrometerWire(clock, lambda time: 1e-9 * (time - 99)))
    first = monitor.reading()
    clock.sleep(10.0)
    second = monitor.reading()
    for reading in (first, second):
        assert reading.unit == "A"
        # 20 ms of a reading, and the millisecond in which the port looks for it
        assert reading.value == pytest.approx(1e-9 * (reading.time - 99), abs=2.1e-12)
    assert second.time - first.time == pytest.approx(10.02, abs=0.01)
    monitor.close()
    with refused(DeviceError):
        monitor.reading()


@pytest.mark.parametrize("end", [b"\r\n", b"\r", b"\n"])
def test_line_ends_and_setup(end: bytes, tmp_path: Path) -> None:
    clock = VirtualClock()
    wire = ElectrometerWire(clock, lambda time: -2.5e-12, end=end)
    setup = ("*RST", "SYST:ZCH OFF")
    monitor = over(wire, line_end=end, setup=setup, transcript=tmp_path / "line.txt")
    assert monitor.reading().value == -2.5e-12
    monitor.close()
    assert wire.heard == [*setup, "READ?"]
    assert b"SYST:ZCH OFF" in (tmp_path / "line.txt").read_bytes()


@pytest.mark.parametrize("text", [b"", b"\xfe\x00\x9c", b"A,+1.0", b"NAN,+1.0,+0.0", b"BUSY"])
def test_garbage_is_no_reading_and_then_it_goes_on(text: bytes) -> None:
    monitor = over(ElectrometerWire(VirtualClock(), spoilt={0: text}))
    with refused(DeviceError):
        monitor.reading()
    assert monitor.reading().value == 1e-9


test_calls_that_are_refused = refused_calls(__file__, globals())
