"""Transcript: what went over a line and when; the last of it for errors, and on request every byte in a file."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from io import FileIO
from pathlib import Path

from drivers.clock import Clock

TOLD_LINES = 6
"""Lines that last went over the wire, for errors."""
TOLD_CHARACTERS = 40
"""Of each of these lines."""


class Transcript:
    """Safe from several threads. A file that fails later is given up: keeping it must not end a scan.

    Each line of the file is: s since the epoch, a mark, and the bytes as a Python literal. Marks: ">" sent, "<"
    received, "!" what the driver did.

    Args:
        path: the file that is appended to; None keeps none.

    Raises:
        OSError: the file does not open.
    """

    def __init__(self, clock: Clock, path: Path | None = None) -> None:
        self._clock = clock
        self._last: deque[tuple[float, str, str]] = deque(maxlen=TOLD_LINES)  # time, mark, text
        self._lock = threading.Lock()
        # Without a buffer, so that what led to a crash is in it.
        self._file: FileIO | None = None if path is None else path.open("ab", buffering=0)

    def tell(self, mark: str, text: str) -> None:
        """A line for errors to tell."""
        with self._lock:
            self._last.append((self._clock.now(), mark, text))

    def keep(self, mark: str, data: bytes) -> None:
        """Bytes for the file."""
        with self._lock:
            if self._file is None or not data:
                return
            try:
                self._file.write(f"{self._clock.now():.6f} {mark} {data!r}\n".encode("ascii"))
            except OSError as problem:
                self._last.append((self._clock.now(), "!", f"transcript given up: {problem}"))
                self._give_up()

    def told(self) -> str:
        """The last lines and how long ago they went."""
        with self._lock:
            now, last = self._clock.now(), list(self._last)
        return ", ".join(f"{mark} {_cut(text)} ({now - time:.2f} s ago)" for time, mark, text in last)

    def close(self) -> None:
        with self._lock:
            self._give_up()

    def _give_up(self) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):  # a disk that is full or gone may say so once more
                self._file.close()
            self._file = None


def _cut(text: str) -> str:
    shown = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    return shown if len(shown) <= TOLD_CHARACTERS else shown[:TOLD_CHARACTERS] + "..."
