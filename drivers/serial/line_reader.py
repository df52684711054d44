"""Line reader: bytes from a port to lines and replies by a deadline; what nobody asked for is told and passed over."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from drivers.clock import Clock
from drivers.serial.transcript import Transcript

LONGEST_LINE = 1024
LONGEST_REPLY = 1 << 16
"""Characters of a reply of several lines."""


@dataclass(frozen=True)
class Framing:
    """How lines end: commands with `command_end`, what the device sends with `line_end`.

    `continued`: text at the end of a line that says that another line follows; "" where every reply is one line. The
    reply is then its lines without that text, joined by newlines.
    """

    command_end: bytes = b"\r\n"
    line_end: bytes = b"\r\n"
    continued: str = ""


CRLF = Framing()


@dataclass(frozen=True)
class Damaged:
    """A line that is not what the device sent, as its checksum says."""

    text: str
    why: str


class LineReader:
    """What has been received and not been read yet. For one thread at a time.

    Args:
        port: pyserial's; its read ends after a short quiet.
        unsolicited: form of lines that the device may send unasked.
        check: what is wrong with a received line, "" where nothing is.

    Raises (in all methods):
        OSError: the port is gone.
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
    def begun(self) -> str:
        """The line that is not whole yet, in readable form."""
        return readable(self._received)

    def reply(self, deadline: float) -> str | Damaged | None:
        """The lines of a reply, joined; None where they are not whole by `deadline` or never end."""
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
        """The next line that the device was asked for; None where none is whole by `deadline`."""
        while True:
            while self._framing.line_end in self._received:
                line, _, rest = bytes(self._received).partition(self._framing.line_end)
                self._received = bytearray(rest)
                text = readable(line)
                self._transcript.tell("<", text)
                if why := self._check(text):
                    return Damaged(text, why)
                if not self._unsolicited.fullmatch(text):
                    return text
            if self._clock.now() >= deadline or len(self._received) > LONGEST_LINE:
                return None
            self._received += self._read()

    def drain(self, deadline: float) -> bool:
        """Throw away what comes until nothing does; whether that was so by `deadline`."""
        while (junk := self._read()) or self._received:
            self._transcript.tell("!", f"passed over {readable(self._received + junk)}")
            self._received.clear()
            if self._clock.now() > deadline:
                return False
        return True

    def pass_over_what_came_before(self) -> None:
        """Whole lines that are here before the request cannot be its reply. The rest may begin a line sent unasked."""
        while len(self._received) <= LONGEST_LINE and self._port.in_waiting:
            self._received += self._read()
        old, end, rest = bytes(self._received).rpartition(self._framing.line_end)
        if end:
            self._transcript.tell("!", f"passed over {readable(old)}")
            self._received = bytearray(rest)

    def _read(self) -> bytes:
        """What is there (over TCP a byte of it), or what comes first; nothing where the line is quiet."""
        data = bytes(self._port.read(max(1, int(self._port.in_waiting))))
        self._transcript.keep("<", data)
        return data


def readable(data: bytes | bytearray) -> str:
    return bytes(data).decode("ascii", errors="backslashreplace")
