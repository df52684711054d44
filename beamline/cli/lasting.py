"""Outputs: stdout and stderr of this process, on which a write never fails, so that no closed terminal ends a scan."""

from __future__ import annotations

import errno
import io
import os
import sys
from typing import Any, TextIO

_CLOSED = (errno.EPIPE, errno.EBADF, errno.EINVAL)
"""Errors of a pipe without a reader (EINVAL on Windows). They are passed over: its reader has ended on purpose."""


class _Lasting(io.FileIO):
    """Accepts all output; after the first error it drops it."""

    error: OSError | None = None

    def write(self, data: Any, /) -> int:
        if self.error is None:
            try:
                return super().write(data)
            except OSError as error:
                self.error = error
        return memoryview(data).nbytes


class Outputs:
    """Puts `sys.stdout` and `sys.stderr` on files that last. Both, and stdin, are open from now on.

    The next file to be opened would get the number of a closed one (`>&-`): a scan file would receive printed text.
    """

    def __init__(self) -> None:
        while (number := os.open(os.devnull, os.O_RDWR)) < 3:
            os.set_inheritable(number, True)
        os.close(number)
        sys.stdout = _lasting(sys.stdout) or _nowhere()
        sys.stderr = _lasting(sys.stderr) or _nowhere()

    def lost(self) -> str:
        """Why stdout is incomplete; "" if it is complete, or its reader has closed it. Both are flushed."""
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        buffer = getattr(sys.stdout, "buffer", None)
        error = getattr(getattr(buffer, "raw", buffer), "error", None)
        return "" if error is None or error.errno in _CLOSED else error.strerror


def _lasting(stream: TextIO | None) -> TextIO | None:
    """The same stream without errors; the stream itself if the system has no file for it (console of Windows)."""
    buffer = getattr(stream, "buffer", None)
    raw = getattr(buffer, "raw", buffer)  # unbuffered (`python -u`) it is the same
    if not (isinstance(stream, io.TextIOWrapper) and type(raw) is io.FileIO):
        return stream
    stream.flush()
    lasting: Any = _Lasting(stream.fileno(), "w", closefd=False)
    return io.TextIOWrapper(
        lasting if raw is buffer else io.BufferedWriter(lasting),
        stream.encoding,
        stream.errors,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )


def _nowhere() -> TextIO:
    return open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123 - as long as the process
