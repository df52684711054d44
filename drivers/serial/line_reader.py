"""LineReader: reads lines and replies from a port, with a time limit. Transcript: record of the dialogue."""

from __future__ import annotations

import contextlib
import re
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Any

from drivers.base.clock import Clock

LONGEST_LINE = 1024
LONGEST_REPLY = 1 << 16  # largest number of characters in a reply of several lines
RECENT_LINES = 6  # number of lines that error messages quote
RECENT_CHARACTERS = 40  # largest number of characters of each of these lines


class Transcript:
    """Record of one serial line. It can be used from several threads.

    Error messages quote the last lines; a log file contains every byte. If writing to the log file fails later, the
    file is closed, because a full disk must not end a scan. Each line of the log file contains the time in s since the
    epoch, a mark and the bytes as a Python literal. Marks: ">" sent, "<" received, "!" done by the driver.

    Args:
        path: log file to which lines are appended; None: no file.

    Raises:
        OSError: the file does not open.
    """

    def __init__(self, clock: Clock, path: Path | None = None) -> None:
        self._clock = clock
        self._last: deque[tuple[float, str, str]] = deque(maxlen=RECENT_LINES)  # time, mark, text
        self._lock = threading.Lock()
        # unbuffered, so that the bytes before a crash are in the file
        self._file: FileIO | None = None if path is None else path.open("ab", buffering=0)

    def add_line(self, mark: str, text: str) -> None:
        """Add a line to the lines that error messages quote."""
        with self._lock:
            self._last.append((self._clock.now(), mark, text))

    def log_bytes(self, mark: str, data: bytes) -> None:
        """Append bytes to the log file."""
        with self._lock:
            if self._file is None or not data:
                return
            try:
                self._file.write(f"{self._clock.now():.6f} {mark} {data!r}\n".encode("ascii"))
            except OSError as problem:
                self._last.append((self._clock.now(), "!", f"transcript closed: {problem}"))
                self._give_up()

    def recent(self) -> str:
        """The last lines with their age, as one string."""
        with self._lock:
            now, last = self._clock.now(), list(self._last)
        return ", ".join(f"{mark} {_cut(text)} ({now - time:.2f} s ago)" for time, mark, text in last)

    def close(self) -> None:
        with self._lock:
            self._give_up()

    def _give_up(self) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):  # a full or missing disk may also make closing fail
                self._file.close()
            self._file = None


def _cut(text: str) -> str:
    shown = "".join(c if c.isascii() and c.isprintable() else ascii(c)[1:-1] for c in text)
    return shown if len(shown) <= RECENT_CHARACTERS else shown[:RECENT_CHARACTERS] + "..."


@dataclass(frozen=True)
class Framing:
    """Line ends of a device.

    Attributes:
        command_end: end of each command sent.
        line_end: end of each line received.
        continued: end of a line that is followed by another line of the same reply; "" if every reply is one line. The
            lines of such a reply are joined by newlines, without this text.
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
    """Reads lines from a port and keeps the bytes of an incomplete line; skips and records unsolicited lines.

    It can be used by one thread at a time.

    Args:
        port: a pyserial port whose read ends after a short silence.
        unsolicited: regular expression of lines that the device may send without a request.
        check: function that returns the fault of a received line, "" if it is good.

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
        self.heard = ""  # the last received bytes; the reader empties this after a good reply

    @property
    def incomplete(self) -> str:
        """The incomplete line in readable form."""
        return readable(self._received)

    def reply(self, deadline: float) -> str | Damaged | None:
        """The lines of a reply, joined. None if the reply is not complete by `deadline`, or is too long."""
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
        """The next line, skipping unsolicited ones; None if no line is complete by `deadline`."""
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
        """Discard bytes until the line is silent. Returns True if the line was silent by `deadline`."""
        while (junk := self._read()) or self._received:
            self._transcript.add_line("!", f"discarded {readable(self._received + junk)}")
            self._received.clear()
            if self._clock.now() > deadline:
                return False
        return True

    def discard_lines(self) -> list[str]:
        """Discard and return the complete lines received so far, which cannot be the reply to a later request.

        The incomplete rest is kept, because it may be the beginning of an unsolicited line.
        """
        while len(self._received) <= LONGEST_LINE and self._port.in_waiting:
            self._received += self._read()
        old, end, rest = bytes(self._received).rpartition(self._framing.line_end)
        if end:
            self._transcript.add_line("!", f"discarded {readable(old)}")
            self._received = bytearray(rest)
        return [readable(line) for line in old.split(self._framing.line_end)] if end else []

    def _read(self) -> bytes:
        """The bytes that have arrived (over TCP one byte), or the first byte to arrive.

        B"" if the line remains silent.
        """
        data = bytes(self._port.read(max(1, int(self._port.in_waiting))))
        self._transcript.log_bytes("<", data)
        self.heard = (self.heard + readable(data))[-LONGEST_LINE:]
        return data


def readable(data: bytes | bytearray) -> str:
    """Bytes as Latin-1 text: one character per byte."""
    return bytes(data).decode("latin-1")
