"""Transcript: the last lines sent and received, for error messages; optionally a log file of every byte."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from io import FileIO
from pathlib import Path

from drivers.base.clock import Clock

RECENT_LINES = 6
"""Lines that error messages quote."""
RECENT_CHARACTERS = 40
"""Characters of each of these lines."""


class Transcript:
    """Record of one serial line. Safe from several threads.

    A log file that fails later is closed: a full disk must not end a scan. Each line of the
    file holds the time in s since the epoch, a mark and the bytes as a Python literal. Marks: ">" sent, "<" received,
    "!" done by the driver.

    Args:
        path: log file, appended to; None: no file.

    Raises:
        OSError: the file does not open.
    """

    def __init__(self, clock: Clock, path: Path | None = None) -> None:
        self._clock = clock
        self._last: deque[tuple[float, str, str]] = deque(maxlen=RECENT_LINES)  # time, mark, text
        self._lock = threading.Lock()
        # Unbuffered, so that the bytes before a crash are in the file.
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
        """The last lines with their age, in one string."""
        with self._lock:
            now, last = self._clock.now(), list(self._last)
        return ", ".join(f"{mark} {_cut(text)} ({now - time:.2f} s ago)" for time, mark, text in last)

    def close(self) -> None:
        with self._lock:
            self._give_up()

    def _give_up(self) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):  # a full or missing disk may fail again
                self._file.close()
            self._file = None


def _cut(text: str) -> str:
    shown = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    return shown if len(shown) <= RECENT_CHARACTERS else shown[:RECENT_CHARACTERS] + "..."
