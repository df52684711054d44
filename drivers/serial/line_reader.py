"""LineReader: bytes of a port to lines and replies, with a deadline; skips and records unsolicited lines."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from drivers.base.clock import Clock
from drivers.serial.transcript import Transcript

LONGEST_LINE = 1024
LONGEST_REPLY = 1 << 16
"""Most characters of a reply of several lines."""


@dataclass(frozen=True)
class Framing:
    """Line ends of a device.

    Attributes:
        command_end: end of each command sent.
        line_end: end of each line received.
        continued: end of a line that is followed by another line of the same reply; "" if every reply is one line.
            Such a reply is its lines without that text, joined by newlines.
    """

    command_end: bytes = b"\r\n"
    line_end: bytes = b"\r\n"
    continued: str = ""


CRLF = Framing()


@dataclass(frozen=True)
class Damaged:
    """A line whose checksum is wrong, and the reason."""

    text: str
    why: str


class LineReader:
    """Reads lines from a port and holds the bytes of an incomplete one. For one thread at a time.

    Args:
        port: a pyserial port whose read ends after a short silence.
        unsolicited: regular expression of lines that the device may send without a request.
        check: returns the fault of a received line, "" if it is good.

    Raises (in all methods):
        OSError: the port failed.
    """

    def __init__(
        self,
        port: Any,
        clock: Clock,
        transcript: Transcript,
        framing: Framing,
        unsolicited: str,
        check: Callable[[str], str],
    ) -> None:
        self._port, self._clock, self._transcript = port, clock, transcript
        self._framing, self._unsolicited, self._check = framing, re.compile(unsolicited), check
        self._received = bytearray()

    @property
    def incomplete(self) -> str:
        """The line that has not ended yet, in readable form."""
        return readable(self._received)

    def reply(self, deadline: float) -> str | Damaged | None:
        """The lines of a reply, joined; None if it is not complete by `deadline` or is too long."""
        continued = self._framing.continued
        lines: list[str] = []
        while sum(map(len, lines)) <= LONGEST_REPLY:
            line = self.line(deadline)
            if not isinstance(line, str):
                return line
            if not continued or not line.endswith(continued):
                return "\n".join([*lines, line])
            lines.append(line.removesuffix(continued))
        return None

    def line(self, deadline: float) -> str | Damaged | None:
        """The next line that is not unsolicited; None if none is complete by `deadline`."""
        while True:
            while self._framing.line_end in self._received:
                line, _, rest = bytes(self._received).partition(self._framing.line_end)
                self._received = bytearray(rest)
                text = readable(line)
                self._transcript.add_line("<", text)
                if why := self._check(text):
                    return Damaged(text, why)
                if not self._unsolicited.fullmatch(text):
                    return text
            if self._clock.now() >= deadline or len(self._received) > LONGEST_LINE:
                return None
            self._received += self._read()

    def drain(self, deadline: float) -> bool:
        """Discard bytes until the line is silent; returns whether it was silent by `deadline`."""
        while (junk := self._read()) or self._received:
            self._transcript.add_line("!", f"discarded {readable(self._received + junk)}")
            self._received.clear()
            if self._clock.now() > deadline:
                return False
        return True

    def discard_lines(self) -> None:
        """Discard the complete lines received so far: they cannot be the reply to a request not yet sent.

        The rest stays: it may be the beginning of an unsolicited line.
        """
        while len(self._received) <= LONGEST_LINE and self._port.in_waiting:
            self._received += self._read()
        old, end, rest = bytes(self._received).rpartition(self._framing.line_end)
        if end:
            self._transcript.add_line("!", f"discarded {readable(old)}")
            self._received = bytearray(rest)

    def _read(self) -> bytes:
        """The bytes that have arrived (over TCP one of them), or the first to arrive; b"" if the line stays silent."""
        data = bytes(self._port.read(max(1, int(self._port.in_waiting))))
        self._transcript.log_bytes("<", data)
        return data


def readable(data: bytes | bytearray) -> str:
    """Bytes as ASCII text, others as backslash escapes."""
    return bytes(data).decode("ascii", errors="backslashreplace")
