"""Serial line: one request and its reply at a time over any pyserial URL: a port, socket://, or a simulator's sim://.

Rules that keep it in step with the device: one lock for the port, a finite timeout, every reply compared with the form
it must have. After a timeout or a reply of the wrong form nothing that arrives is believed until a harmless probe has
been answered and the line has fallen quiet.
"""

from __future__ import annotations

import re
import threading
from collections import deque
from dataclasses import dataclass

import serial

from drivers.clock import Clock
from drivers.errors import DeviceError, DeviceTimeout

END = b"\r\n"
LONGEST_LINE = 1024
TOLD_LINES = 6
"""Lines that last went over the wire, for errors."""
TOLD_CHARACTERS = 40
"""Of each of these lines."""
QUIET = 0.05
"""s without a byte after which a line counts as quiet."""


@dataclass(frozen=True)
class Probe:
    """A query without side effects, and the form of its reply, by which the line finds its step again."""

    request: str
    reply: str


class SerialLine:
    """A device that talks ASCII lines ended by CR LF, 8 bits, no parity, 1 stop bit. Safe from several threads.

    Args:
        url: what pyserial opens: "/dev/ttyUSB0", "COM3", "socket://host:port", "sim://name".
        device: the name that errors carry.
        probe: see `Probe`.
        timeout: s for a whole reply.
        unsolicited: form of lines that the device may send unasked; they are noted and passed over.

    Raises:
        DeviceError: the port cannot be opened.
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
    ) -> None:
        self._device, self._probe, self._clock, self._timeout = device, probe, clock, timeout
        self._unsolicited = re.compile(unsolicited)
        self._lock = threading.RLock()
        self._transcript: deque[tuple[float, str, str]] = deque(maxlen=TOLD_LINES)  # time, mark, text
        self._received = bytearray()
        self._in_step = True
        try:
            self._port = serial.serial_for_url(
                url, baudrate=baudrate, timeout=QUIET, write_timeout=timeout, exclusive=True
            )
        except (OSError, ValueError) as problem:
            raise DeviceError(
                device,
                f"the port {url!r} does not open: {problem}",
                expected="a port like /dev/ttyUSB0, COM3, socket://host:port or sim://pm16c",
                advice="Check the cable, the port's name in the configuration and that no other program holds it",
                state="Nothing was sent",
            ) from problem

    def send(self, command: str) -> None:
        """Send a command that has no reply. It goes out even where the line is out of step: a stop must not wait.

        Raises:
            DeviceError: the port is gone. DeviceTimeout: the device does not take bytes.
        """
        with self._lock:
            self._write(command)

    def query(self, request: str, reply: str, meaning: str, state: str = "") -> re.Match[str]:
        """Send a request and read its reply.

        Args:
            reply: regular expression that the whole reply must match.
            meaning: the expected reply in words, for the error.
            state: what has (not) moved, for the error.

        Raises:
            DeviceTimeout: no whole reply within the timeout. DeviceError: a reply of another form, or the port is gone.
        """
        with self._lock:
            if not self._in_step:
                self._find_step(state)
            self._in_step = False
            self._write(request)
            text = self._read_line()
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

    def close(self) -> None:
        """Free the port; a second time does nothing."""
        with self._lock:
            self._port.close()

    def _find_step(self, state: str) -> None:
        """Throw away what is on the line, probe, pass over late replies until the probe's own, wait for quiet."""
        self._note("!", "out of step: probing")
        self._wait_for_quiet(state)
        self._write(self._probe.request)
        while (text := self._read_line()) is not None:
            if re.fullmatch(self._probe.reply, text):
                break
        else:
            raise self._error(
                DeviceTimeout,
                f"still no answer after an earlier failure, silent for {self._timeout:g} s",
                request=self._probe.request,
                expected=f"a reply of the form {self._probe.reply}",
                advice="Check power, cable and baud rate",
                state=state,
            )
        self._wait_for_quiet(state)
        self._in_step = True
        self._note("!", "in step again")

    def _wait_for_quiet(self, state: str) -> None:
        deadline = self._clock.now() + max(self._timeout, 10 * QUIET)
        while (junk := self._read()) or self._received:
            self._note("!", f"passed over {_readable(self._received + junk)}")
            self._received.clear()
            if self._clock.now() > deadline:
                raise self._error(
                    DeviceTimeout,
                    "it sends without pause and was not asked",
                    advice="Check the baud rate and that the port is this device's",
                    state=state,
                )

    def _write(self, text: str) -> None:
        self._note(">", text)
        try:
            self._port.write(text.encode("ascii") + END)
        except serial.SerialTimeoutException as problem:
            raise self._error(
                DeviceTimeout,
                f"it took no bytes for {self._timeout:g} s",
                request=text,
                advice="Check power, cable and flow control (none is expected)",
            ) from problem
        except OSError as problem:
            raise self._port_gone(problem) from problem

    def _read_line(self) -> str | None:
        """The next line that the device was asked for; None where none is whole within the timeout."""
        deadline = self._clock.now() + self._timeout
        while True:
            while END in self._received:
                line, _, rest = bytes(self._received).partition(END)
                self._received = bytearray(rest)
                text = _readable(line)
                self._note("<", text)
                if not self._unsolicited.fullmatch(text):
                    return text
            if self._clock.now() >= deadline or len(self._received) > LONGEST_LINE:
                return None
            self._received += self._read()

    def _read(self) -> bytes:
        """What is there, or what comes first; nothing where the line is quiet."""
        try:
            return bytes(self._port.read(max(1, self._port.in_waiting)))
        except OSError as problem:
            raise self._port_gone(problem) from problem

    def _port_gone(self, problem: OSError) -> DeviceError:
        return self._error(
            DeviceError,
            f"the port failed: {problem}",
            advice="Check that the cable or adapter is still plugged in, then start again",
            state="What the device was doing it may still be doing",
        )

    def _error(self, kind: type[DeviceError], problem: str, **parts: str) -> DeviceError:
        return kind(self._device, problem, wire=self._told(), **parts)

    def _told(self) -> str:
        """The last lines and how long ago they went: ">" sent, "<" received, "!" what the driver did."""
        now = self._clock.now()
        return ", ".join(f"{mark} {_cut(text)} ({now - time:.2f} s ago)" for time, mark, text in self._transcript)

    def _note(self, mark: str, text: str) -> None:
        self._transcript.append((self._clock.now(), mark, text))


def _readable(data: bytes | bytearray) -> str:
    return bytes(data).decode("ascii", errors="backslashreplace")


def _cut(text: str) -> str:
    return text if len(text) <= TOLD_CHARACTERS else text[:TOLD_CHARACTERS] + "..."
