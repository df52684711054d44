"""Stages behind a terminal server that does not just pass bytes: the message names who answers or is silent."""

from __future__ import annotations

import math
import re
import time
from contextlib import ExitStack, closing

import pytest

from drivers.base.clock import SystemClock
from drivers.base.errors import DeviceError
from drivers.serial.line import LineRules, Probe, SerialLine
from drivers.serial.line_reader import Framing
from tests.drivers.stages.rig import StageRig
from tests.drivers.stages.rigs import RigOf, every_stage
from tests.simulators.wires.transports import serve_tcp

NETWORK = 0.02  # s
NEGOTIATION = b"\xff\xfb\x01\xff\xfb\x03\xff\xfd\x00\xff\xfb\x00\xff\xfd\x2c"  # WILL ECHO, SGA, BINARY; DO COM-PORT
LINE_STATE = b"\xff\xfa\x2c\x6a\x60\xff\xf0"  # a note of RFC 2217


class Server:
    """Says `first` to a client after the time of a network, `note` before the n-th message, and `answer` in the place
    of the controller's.
    """

    def __init__(
        self, rig: StageRig, first: bytes = b"", answer: bytes | None = None, note: bytes = b"", n: int = 0
    ) -> None:
        self.clock, self._rig, self._answer, self._note = SystemClock(), rig, answer, note
        self._first, self._out, self._left = first, b"", n
        self._connected = math.inf

    def receive(self, data: bytes) -> None:
        self._left -= 1
        self._out += self._note if self._left == 0 else b""
        if self._answer is None:
            self._rig.receive(data)
        else:
            self._out += self._answer

    def transmit(self) -> bytes:
        """The first call is that of the connection; pyserial drops what comes before its port is open."""
        self._connected = min(self._connected, self.clock.now())
        if self._first and self.clock.now() > self._connected + NETWORK:
            self._out, self._first = self._first + self._out, b""
        data, self._out = self._out + (self._rig.transmit() if self._answer is None else b""), b""
        return data


TELNET = ("the server uses Telnet", "raw TCP, without Telnet")
FOREIGN = {
    "negotiates": ({"first": NEGOTIATION}, TELNET),
    "echoes": ({"first": NEGOTIATION[:6]}, TELNET),
    "negotiates late": ({"note": NEGOTIATION, "n": 2}, TELNET),
    "notes in between": ({"note": LINE_STATE, "n": 5}, TELNET),
    "login": (
        {"first": b"\r\nTS 4\r\nlogin: ", "answer": b"\r\nPassword: "},
        ("the server asks for a login", "without a login"),
    ),
    "web server": ({"answer": b"HTTP/1.1 400 Bad Request\r\n\r\n"}, ("a web or SSH server", "the number of the port")),
    "SSH server": ({"first": b"SSH-2.0-OpenSSH_9.2p1\r\n", "answer": b""}, ("a web or SSH", "the number of the port")),
    "in use": (
        {"first": b"Port already in use\r\n", "answer": b""},
        ("another client uses", "Close the other program"),
    ),
    "serves another": ({"answer": b""}, ("no whole reply", "allow only one client: another program may use this port")),
}


@pytest.mark.parametrize("what", FOREIGN)
@every_stage
def test_who_speaks_in_the_place_of_the_controller_is_named(rig_of: RigOf, what: str) -> None:
    rig, (manner, words) = rig_of(), FOREIGN[what]
    with serve_tcp(Server(rig, **manner)) as rig.url:  # type: ignore[arg-type]
        with ExitStack() as opened, pytest.raises(DeviceError, match=".*".join(map(re.escape, words))) as told:
            stage = opened.enter_context(closing(rig.open(clock=SystemClock(), timeout=0.3)))
            time.sleep(2 * NETWORK)
            stage.position()
        assert "Nothing has moved" in str(told.value)


@every_stage
def test_a_server_that_closes_a_connection_is_told_from_a_cable(rig_of: RigOf) -> None:
    rig = rig_of()
    with serve_tcp(Server(rig)) as rig.url:
        stage = rig.open(clock=SystemClock())
    with pytest.raises(DeviceError, match=r"the other side closed the connection.*idle time 0.*no other client"):
        stage.position()
    stage.close()


@every_stage
def test_through_raw_tcp_a_stage_is_what_it_is_at_a_cable(rig_of: RigOf) -> None:
    rig = rig_of()
    with serve_tcp(Server(rig)) as rig.url:
        stage = rig.open(clock=SystemClock())
        assert stage.position() == 0.0
        stage.close()


class Replies:
    """Says `first` to its client, and `answer` to every message."""

    def __init__(self, first: bytes, answer: bytes) -> None:
        self.clock, self._out, self._answer = SystemClock(), first, answer

    def receive(self, data: bytes) -> None:
        self._out += self._answer

    def transmit(self) -> bytes:
        data, self._out = self._out, b""
        return data


@pytest.mark.parametrize(
    ("first", "end"), [(b"", b"\x03"), (b"Welcome \xb5-stage\r\n", b"\r\n"), (b"\x07Moxa\r\n", b"\r\n")]
)
def test_only_a_reply_must_be_text_and_neither_line_ends_nor_what_a_server_said(first: bytes, end: bytes) -> None:
    rules = LineRules(Probe("ID", "OK"), framing=Framing(end, end))
    with serve_tcp(Replies(first, b"OK" + end)) as url:
        line = SerialLine(url, rules, SystemClock(), device="stage", timeout=1.0, baudrate=9600)
        with closing(line):
            time.sleep(2 * NETWORK)
            assert line.query("ID", "OK", "OK")[0] == "OK"
            with pytest.raises(DeviceError, match="have the expected form") as told:
                line.query("ID", "NO", "NO")
            assert "not text" not in str(told.value)
