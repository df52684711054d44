"""Serial line: one request and its reply at a time over any pyserial URL: a port, socket://, or a simulator's sim://.

Rules that keep it in step with the device: one request at a time, a finite timeout, every reply compared with the form
it must have. After a timeout or a reply of the wrong form nothing that arrives is believed until a harmless probe has
been answered and the line has fallen quiet. Commands without a reply wait for nobody: a stop goes out at once.
"""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import serial

from drivers.clock import Clock
from drivers.errors import DeviceError, DeviceTimeout
from drivers.serial_port import open_port
from drivers.transcript import Transcript

LONGEST_LINE = 1024
LONGEST_REPLY = 1 << 16
"""Characters of a reply of several lines."""
QUIET = 0.05
"""s without a byte after which a line counts as quiet."""


@dataclass(frozen=True)
class Probe:
    """A query without side effects, and the form of its one-line reply, by which the line finds its step again."""

    request: str
    reply: str


@dataclass(frozen=True)
class Framing:
    """How lines end: commands with `command_end`, what the device sends with `line_end`.

    `continued`: text at the end of a line that says that another line follows; "" where every reply is one line. The
    reply is then its lines without that text, joined by newlines.
    """

    command_end: bytes = b"\r\n"
    line_end: bytes = b"\r\n"
    continued: str = ""


@dataclass(frozen=True)
class _Damaged:
    """A line that is not what the device sent, as its checksum says."""

    text: str
    why: str


def _sound(line: str) -> str:
    """A line without a checksum has nothing to say of itself."""
    return ""


class SerialLine:
    """A device that talks ASCII lines, 8 bits, no parity, 1 stop bit. Safe from several threads.

    Args:
        url: what pyserial opens: "/dev/ttyUSB0", "COM3", "socket://host:port", "sim://name".
        device: the name that errors carry.
        probe: see `Probe`.
        timeout: s for a whole reply.
        unsolicited: form of lines that the device may send unasked; they are noted and passed over.
        check: what is wrong with a received line, "" where nothing is; for checksums.
        transcript: file to which every byte sent and received is appended with its time; None keeps none.

    Raises:
        DeviceError: the port or the transcript cannot be opened.
    """

    def __init__(
        self,
        url: str,
        *,
        device: str,
        probe: Probe,
        clock: Clock,
        timeout: float,
        baudrate: int,
        unsolicited: str = r"(?!)",
        framing: Framing = Framing(),
        check: Callable[[str], str] = _sound,
        transcript: Path | None = None,
    ) -> None:
        self._device, self._probe, self._clock, self._timeout = device, probe, clock, timeout
        self._unsolicited, self._framing, self._check = re.compile(unsolicited), framing, check
        self._asking, self._writing = threading.RLock(), threading.Lock()
        self._received = bytearray()
        self._asked = ""  # what the present reply is awaited for, for errors
        self._in_step = True
        try:
            self._transcript = Transcript(clock, transcript)
        except OSError as problem:
            raise DeviceError(
                device,
                f"the transcript {str(transcript)!r} cannot be written: {problem}",
                advice="Name a file in a folder that exists, or none",
                state="Nothing was sent",
            ) from problem
        try:
            self._port = open_port(url, baudrate, QUIET, timeout)
        except (OSError, ValueError) as problem:
            self._transcript.close()
            raise DeviceError(
                device,
                f"the port {url!r} does not open: {problem}",
                expected="a port like /dev/ttyUSB0, COM3, socket://host:port or sim://pm16c",
                advice="Check the cable, the port's name in the configuration and that no other program holds it",
                state="Nothing was sent",
            ) from problem

    def send(self, command: str) -> None:
        """Send a command that has no reply. It goes out even where the line is out of step or another thread waits for
        its reply: a stop must not wait.

        Raises:
            DeviceError: the port is gone. DeviceTimeout: the device does not take bytes.
        """
        self._write(command.encode("ascii") + self._framing.command_end, command or "an empty line")

    def send_raw(self, data: bytes) -> None:
        """`send` for bytes without an end, such as one control character."""
        self._write(data, _readable(data))

    def query(self, request: str, reply: str, meaning: str, state: str = "") -> re.Match[str]:
        """Send a request and read its reply.

        Args:
            reply: regular expression that the whole reply must match.
            meaning: the expected reply in words, for the error.
            state: what has (not) moved, for the error.

        Raises:
            DeviceTimeout: no whole reply within the timeout. DeviceError: a reply of another form, or the port is gone.
        """
        return self._query(request.encode("ascii") + self._framing.command_end, request, reply, meaning, state)

    def query_raw(self, data: bytes, reply: str, meaning: str, state: str = "") -> re.Match[str]:
        """`query` for bytes without an end, such as one control character."""
        return self._query(data, _readable(data), reply, meaning, state)

    def close(self) -> None:
        """Free the port; a second time does nothing."""
        with self._asking, self._writing:
            with contextlib.suppress(OSError):  # a port that is gone has nothing to free
                self._port.close()
            self._transcript.close()

    def _query(self, data: bytes, request: str, reply: str, meaning: str, state: str) -> re.Match[str]:
        with self._asking:
            self._asked = request
            if not self._in_step:
                self._find_step(state)
            self._in_step = False
            self._pass_over_what_came_before()
            self._write(data, request)
            text = self._read_reply()
            if text is None:
                raise self._error(
                    DeviceTimeout,
                    f"no whole reply within {self._timeout:g} s",
                    request=request,
                    reply=_readable(self._received[:80]),
                    expected=meaning,
                    advice="Check power, cable and baud rate; the next request will first find the line's step again",
                    state=state,
                )
            if isinstance(text, _Damaged):
                raise self._error(
                    DeviceError,
                    f"the reply was damaged on the way: {text.why}",
                    request=request,
                    reply=text.text,
                    expected=meaning,
                    advice="Check the cable, its shield and the baud rate",
                    state=state,
                )
            match = re.fullmatch(reply, text)
            if match is None:
                raise self._error(
                    DeviceError,
                    "the reply does not have the form it must have",
                    request=request,
                    reply=text,
                    expected=meaning,
                    advice="The line may be disturbed or the device be another model",
                    state=state,
                )
            self._in_step = True
            return match

    def _find_step(self, state: str) -> None:
        """Throw away what is on the line, probe, pass over late replies until the probe's own, wait for quiet."""
        self._transcript.tell("!", "out of step: probing")
        self._wait_for_quiet(state)
        self._write(self._probe.request.encode("ascii") + self._framing.command_end, self._probe.request)
        deadline = self._clock.now() + self._timeout
        while (text := self._read_line(deadline)) is not None:
            if isinstance(text, str) and re.fullmatch(self._probe.reply, text):
                break
        else:
            raise self._error(
                DeviceTimeout,
                f"still no answer after an earlier failure, for {self._timeout:g} s",
                request=self._probe.request,
                expected=f"a reply of the form {self._probe.reply}",
                advice="Check power, cable and baud rate",
                state=state,
            )
        self._wait_for_quiet(state)
        self._in_step = True
        self._transcript.tell("!", "in step again")

    def _wait_for_quiet(self, state: str) -> None:
        deadline = self._clock.now() + max(self._timeout, 10 * QUIET)
        while (junk := self._read()) or self._received:
            self._transcript.tell("!", f"passed over {_readable(self._received + junk)}")
            self._received.clear()
            if self._clock.now() > deadline:
                raise self._error(
                    DeviceTimeout,
                    "it sends without pause and was not asked",
                    request=self._asked,
                    expected="a quiet line before the next request",
                    advice="Check the baud rate and that the port is this device's",
                    state=state,
                )

    def _pass_over_what_came_before(self) -> None:
        """Whole lines that are here before the request cannot be its reply. The rest may begin a line sent unasked."""
        while len(self._received) <= LONGEST_LINE and self._waiting():
            self._received += self._read()
        old, end, rest = bytes(self._received).rpartition(self._framing.line_end)
        if end:
            self._transcript.tell("!", f"passed over {_readable(old)}")
            self._received = bytearray(rest)

    def _write(self, data: bytes, text: str) -> None:
        with self._writing:
            self._transcript.tell(">", text)
            self._transcript.keep(">", data)
            try:
                self._port.write(data)
            except serial.SerialTimeoutException as problem:
                raise self._error(
                    DeviceTimeout,
                    f"it took no bytes for {self._timeout:g} s",
                    request=text,
                    expected="a device that takes what is sent",
                    advice="Check power, cable and flow control (none is expected)",
                    state="What the device was doing it may still be doing",
                ) from problem
            except OSError as problem:
                raise self._port_gone(problem, text) from problem

    def _read_reply(self) -> str | _Damaged | None:
        """The lines of the reply, joined; None where they are not whole within the timeout or never end."""
        deadline = self._clock.now() + self._timeout
        continued = self._framing.continued
        lines: list[str] = []
        while sum(map(len, lines)) <= LONGEST_REPLY:
            line = self._read_line(deadline)
            if not isinstance(line, str):
                return line
            if not continued or not line.endswith(continued):
                return "\n".join([*lines, line])
            lines.append(line.removesuffix(continued))
        return None

    def _read_line(self, deadline: float) -> str | _Damaged | None:
        """The next line that the device was asked for; None where none is whole by `deadline`."""
        while True:
            while self._framing.line_end in self._received:
                line, _, rest = bytes(self._received).partition(self._framing.line_end)
                self._received = bytearray(rest)
                text = _readable(line)
                self._transcript.tell("<", text)
                if why := self._check(text):
                    return _Damaged(text, why)
                if not self._unsolicited.fullmatch(text):
                    return text
            if self._clock.now() >= deadline or len(self._received) > LONGEST_LINE:
                return None
            self._received += self._read()

    def _read(self) -> bytes:
        """What is there, or what comes first; nothing where the line is quiet."""
        waiting = self._waiting()
        try:
            data = bytes(self._port.read(max(1, waiting)))
        except OSError as problem:
            raise self._port_gone(problem, self._asked) from problem
        self._transcript.keep("<", data)
        return data

    def _waiting(self) -> int:
        """How many bytes can be read at once; over TCP only whether there are any."""
        try:
            return int(self._port.in_waiting)
        except OSError as problem:
            raise self._port_gone(problem, self._asked) from problem

    def _port_gone(self, problem: OSError, request: str) -> DeviceError:
        return self._error(
            DeviceError,
            f"the port failed: {problem}",
            request=request,
            expected="a port that stays there",
            advice="Check that the cable or adapter is still plugged in, then start again",
            state="What the device was doing it may still be doing",
        )

    def _error(self, kind: type[DeviceError], problem: str, **parts: str) -> DeviceError:
        return kind(self._device, problem, wire=self._transcript.told(), **parts)


def _readable(data: bytes | bytearray) -> str:
    return bytes(data).decode("ascii", errors="backslashreplace")
