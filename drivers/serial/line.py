"""SerialLine: requests and replies over any pyserial URL: a serial port, socket://, or sim:// of a simulator.

Three rules keep requests and replies synchronised: there is one request at a time, every wait has a timeout, and every
reply must match the expected form. After a timeout, or a reply of another form, the line sends a probe: a query without
side effects. It discards received data until the device has answered the probe and the line is silent. Commands without
a reply are sent at once, so that a stop does not wait.
"""

from __future__ import annotations

import contextlib
import math
import re
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import serial
from serial.tools import list_ports

from drivers.base.causes import NO_TEXT, TELNET, of_bytes, of_port
from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.serial.line_reader import CRLF, RECENT_LINES, Damaged, Framing, LineReader, Transcript, readable


def serial_ports() -> str:
    """The serial ports of this computer, by device name, with the ids of their adapters. No port is opened."""
    ports = sorted(list_ports.comports(), key=lambda port: str(port.device))
    return "; ".join(f"{port.device} ({port.description}, {port.hwid})" for port in ports) or "none"


def open_port(url: str, baudrate: int, quiet: float, write_timeout: float) -> Any:
    """Open a port by its pyserial URL: 8 data bits, no parity, 1 stop bit, exclusive access.

    Args:
        quiet: time in s without a byte after which a read ends. write_timeout: time in s after which a write fails.

    Raises:
        OSError, ValueError: the port does not open.
    """
    port = serial.serial_for_url(url, baudrate=baudrate, timeout=quiet, write_timeout=write_timeout, exclusive=True)
    if url.lower().startswith("socket://"):
        # Send each request at once, because Nagle's algorithm, which collects small packets, costs 40 to 200 ms for
        # every command and its read-back.
        with contextlib.suppress(OSError), socket.fromfd(port.fileno(), socket.AF_INET, socket.SOCK_STREAM) as copy:
            copy.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return port


_SILENT = (
    "Check power, cable and baud rate; before the next request, the program finds out again which reply "
    "belongs to which request"
)
_SERVER = ". Many terminal servers allow only one client: another program may use this port"
NEVER = r"(?!)"  # a pattern that does not match any line
QUIET = 0.05  # s without a byte after which a line counts as silent


@dataclass(frozen=True)
class Probe:
    """A query without side effects and the form of its one-line reply, used to resynchronise the line."""

    request: str
    reply: str


@dataclass(frozen=True, eq=False)
class LineRules:
    """Framing, probe and timing of a device's dialogue.

    Attributes:
        unsolicited: regular expression of lines that the device may send without a request. Such lines are skipped and
            recorded. identified: True if each reply contains the number of its request. A second reply with this number
            then comes from another device. check: function that returns the fault of a received line (such as a wrong
            checksum), or "" if the line is good. text: True if no reply contains control characters or bytes above 7F.
            A reply with such bytes is then always rejected. unanswered: further advice for the case that the device has
            never answered.
    """

    probe: Probe
    unsolicited: str = NEVER
    framing: Framing = CRLF
    identified: bool = False
    check: Callable[[str], str] = lambda line: ""
    text: bool = True
    unanswered: str = ""


class SerialLine:
    """A device that communicates in ASCII lines (8 data bits, no parity, 1 stop bit). Several threads may use it.

    Args:
        url: pyserial URL: "/dev/ttyUSB0", "COM3", "socket://host:port", "sim://name".
        device: name of the device in error messages.
        timeout: time limit in s for a whole reply, above 0.
        transcript: log file to which every byte sent and received is appended with its time; None: no file.

    Raises:
        DeviceError: the port or the transcript cannot be opened. DeviceRefused: the timeout is not positive
            and finite.
    """

    def __init__(
        self,
        url: str,
        rules: LineRules,
        clock: Clock,
        *,
        device: str,
        timeout: float,
        baudrate: int,
        transcript: Path | None = None,
    ) -> None:
        self._device, self._probe, self._clock, self._timeout = device, rules.probe, clock, timeout
        self._url, self._rules, self._socket = url, rules, url.lower().startswith("socket:")
        self._asking, self._writing = threading.RLock(), threading.Lock()
        self._in_step, self._closed, self._has_answered = True, False, False
        self._answered = "", NEVER  # the last request that was answered, and the form of its reply
        if not 0 < timeout < math.inf:
            raise DeviceRefused(
                device,
                f"the timeout of {timeout} s is not valid",
                expected="a positive number of seconds",
                state="Nothing was sent",
            )
        try:
            self._transcript = Transcript(clock, transcript)
        except OSError as problem:
            raise DeviceError(
                device,
                f"the transcript {str(transcript)!r} cannot be written: {problem}",
                advice="Give a transcript file in an existing folder, or set transcript to null",
                state="Nothing was sent",
            ) from problem
        try:
            self._port = open_port(url, baudrate, QUIET, timeout)
        except BaseException as problem:
            self._transcript.close()
            if not isinstance(problem, OSError | ValueError):
                raise
            raise DeviceError(
                device,
                f"the port {url!r} does not open: {problem}",
                expected="a port like /dev/ttyUSB0, COM3, socket://host:port or sim://pm16c",
                advice=f"{of_port(url, problem)}. Serial ports of this computer: {serial_ports()}",
                state="Nothing was sent",
            ) from problem
        self._reader = LineReader(self._port, clock, self._transcript, rules.framing, rules.unsolicited, rules.check)

    def send(self, command: str | bytes) -> None:
        """Send a command without a reply, at once, even while another thread waits or the line is not synchronised.

        Bytes, such as one control character, get no line end.

        Raises:
            DeviceError: the port failed. DeviceTimeout: the device accepts no bytes.
        """
        self._write(*self._worded(command))

    def query(self, command: str | bytes, reply: str, meaning: str, state: str = "") -> re.Match[str]:
        """Send a request and read its reply.

        Args:
            command: as for `send`.
            reply: regular expression that the whole reply must match.
            meaning: description of the expected reply, for error messages.
            state: what has moved and what has not, for error messages.

        Raises:
            DeviceTimeout: no complete reply arrived within the timeout. DeviceError: the reply has another form, or the
                port failed.
        """
        data, request = self._worded(command)
        with self._asking:
            self._refuse_if_closed(request)
            with self._port_errors(request):
                if not self._in_step:
                    self._resynchronise(request, state)
                self._in_step = False
                for line in self._reader.discard_lines():
                    self._refuse_second_reply(line, state)
                self._write(data, request)
                text = self._reader.reply(self._clock.now() + self._timeout)
            match = re.fullmatch(reply, text) if isinstance(text, str) else None
            words = self._rules.text and isinstance(command, str)  # the answer to a control byte may be a control byte
            telnet = self._socket and TELNET.search(self._reader.heard)  # the error text may have been discarded
            if match is not None and not (words and (telnet or NO_TEXT.search(match[0]))):
                self._in_step, self._has_answered, self._reader.heard = True, True, ""
                self._answered = (request, reply) if self._rules.identified else self._answered
                return match
            if isinstance(text, str):
                self._refuse_second_reply(text, state)
            with contextlib.suppress(OSError):
                for _ in range(RECENT_LINES if self._socket else 0):  # further text of a server shows what it is
                    self._reader.line(self._clock.now() + QUIET)
            if text is None:
                what, received = (
                    f"no whole reply within {self._timeout:g} s",
                    self._reader.incomplete[:80],
                )
                advice = _SILENT + (_SERVER if self._socket else "")
            elif isinstance(text, Damaged):
                what, received = f"the reply was damaged on the way: {text.why}", text.text
                advice = "Check the cable, its shield and the baud rate"
            else:
                what, received = "the reply does not have the expected form", text
                advice = "There may be noise on the line, or the device may be another model"
            raise self._error(
                DeviceTimeout if text is None else DeviceError,
                what,
                request=request,
                reply=received.encode("latin-1").decode("ascii", "backslashreplace"),
                expected=meaning,
                advice=advice,
                state=state,
            )

    def close(self) -> None:
        """Close the port after the current request of another thread has ended. Calling it again does nothing."""
        with self._asking, self._writing:
            self._closed = True
            with contextlib.suppress(OSError):  # a failed port need not be closed
                self._port.close()
            self._transcript.close()

    def _worded(self, command: str | bytes) -> tuple[bytes, str]:
        """The bytes to send, and their text for messages."""
        if isinstance(command, bytes):
            return command, readable(command)
        return command.encode("ascii") + self._rules.framing.command_end, command or "an empty line"

    def _resynchronise(self, request: str, state: str) -> None:
        """Synchronise the line: discard received data, send the probe, skip late replies until the reply to the probe,
        and wait for silence."""
        self._transcript.add_line("!", "out of step: probing")
        self._wait_for_quiet(request, state)
        self._write(*self._worded(self._probe.request))
        deadline = self._clock.now() + self._timeout
        while (text := self._reader.line(deadline)) is not None:
            if isinstance(text, str) and re.fullmatch(self._probe.reply, text):
                break
        else:
            raise self._error(
                DeviceTimeout,
                f"the device did not answer within {self._timeout:g} s, after an earlier request had also failed",
                request=self._probe.request,
                expected=f"a reply of the form {self._probe.reply}",
                advice="Check power, cable and baud rate",
                state=state,
            )
        self._wait_for_quiet(request, state)
        self._in_step, self._reader.heard = True, ""
        self._transcript.add_line("!", "in step again")

    def _refuse_second_reply(self, line: str, state: str) -> None:
        """Raise DeviceError if a line is a second reply to the last request that was answered."""
        request, form = self._answered
        if re.fullmatch(form, line):
            raise self._error(
                DeviceError,
                "two devices answered one request",
                request=request,
                reply=line,
                expected="one reply",
                advice="Two controllers on this line have the same address: give each controller its own address, or "
                "unplug one",
                state=f"{state}. Both controllers carried out earlier requests",
            )

    def _wait_for_quiet(self, request: str, state: str) -> None:
        if not self._reader.drain(self._clock.now() + max(self._timeout, 10 * QUIET)):
            raise self._error(
                DeviceTimeout,
                "it sends data continuously without a request",
                request=request,
                expected="a silent line before the next request",
                advice="Check the baud rate, and that this port belongs to the device",
                state=state,
            )

    def _write(self, data: bytes, text: str) -> None:
        with self._writing:
            self._refuse_if_closed(text)
            self._transcript.add_line(">", text)
            self._transcript.log_bytes(">", data)
            with self._port_errors(text):
                self._port.write(data)

    @contextlib.contextmanager
    def _port_errors(self, request: str) -> Iterator[None]:
        """Convert errors of the port to errors of the device."""
        state = "The device may still be carrying out the earlier request"
        try:
            yield
        except serial.SerialTimeoutException as problem:
            raise self._error(
                DeviceTimeout,
                f"it accepted no bytes for {self._timeout:g} s",
                request=request,
                expected="a device that accepts data",
                advice="Check power, cable and flow control (flow control must be off)",
                state=state,
            ) from problem
        except OSError as error:
            raise self._error(
                DeviceError,
                f"the port failed: {error}{'; the other side closed the connection' if self._socket else ''}",
                request=request,
                expected="a port that stays open",
                advice="Configure the server to keep idle connections (idle time 0), check that no other client uses "
                "its port, and start again"
                if self._socket
                else "Check that the cable or adapter is plugged in, then start again. Serial ports of this "
                f"computer: {serial_ports()}",
                state=state,
            ) from error

    def _refuse_if_closed(self, request: str) -> None:
        """Raise DeviceError if the line is closed. (Operating systems raise different errors for a closed port.)"""
        if self._closed:
            raise DeviceError(
                self._device, "it was closed", request=request, advice="Open it again", state="Nothing was sent"
            )

    def _error(self, kind: type[DeviceError], problem: str, *, advice: str, **parts: str) -> DeviceError:
        """The error, with a cause if the bytes since the last good reply show one."""
        line_end = self._rules.framing.line_end.decode("latin-1")  # because the reply may not be text
        cause, todo = of_bytes(self._url, self._reader.heard.replace(line_end, "\n"))
        advice = (todo or advice) + ("" if self._has_answered else self._rules.unanswered)
        wire = self._transcript.recent()
        return kind(self._device, f"{problem}{cause and ': '}{cause}", advice=advice, wire=wire, **parts)


def line_to(wiring: Any, url: str, name: str, clock: Clock, probe: Probe, **rules: Any) -> SerialLine:
    """Open the line to the controller of the stage `name`.

    Args:
        wiring: settings of a stage, with `timeout`, `baudrate` and `transcript`.
        rules: the fields of `LineRules`.
    """
    return SerialLine(
        url,
        LineRules(probe, **rules),
        clock,
        device=name,
        timeout=wiring.timeout,
        baudrate=wiring.baudrate,
        transcript=wiring.transcript,
    )
