"""ToDisk: brings flushed data to the disk (fsync) in a thread, so that a loss of power cannot take them."""

from __future__ import annotations

import errno
import threading
import time

from beamline.core.files import to_disk

SECONDS = 1.0  # between two calls, at least

_PATIENCE = 60.0  # s that the last calls may take


class ToDisk:
    """Calls `to_disk` in a thread, one call at a time, so that a writer need not wait for the disk.

    The thread is a daemon: a disk that hangs does not keep the program from ending.

    Attributes:
        failed: the disk did not take what a call was for.
        rows: written to the file before the last call that succeeded.
    """

    def __init__(self, handle: int) -> None:
        self._handle = handle
        self._thread: threading.Thread | None = None
        self._error: OSError | None = None
        self.rows = 0
        self._begun = time.monotonic()

    @property
    def failed(self) -> bool:
        return self._error is not None

    def __call__(self, rows: int) -> None:
        """Begin a call, unless one is under way or began less than SECONDS ago.

        Raises:
            OSError: the disk did not take what an earlier call was for.
        """
        if self._error is not None:
            raise self._error
        under_way = self._thread is not None and self._thread.is_alive()
        if under_way or time.monotonic() - self._begun < SECONDS:
            return
        self._begun = time.monotonic()
        self._thread = self._call(rows)
        self._thread.start()

    def finish(self, rows: int) -> None:
        """Wait until everything is on the disk.

        Raises:
            OSError: it did not take it, or not within a minute a call.
        """
        for last in (self._thread, self._call(rows)):
            if last is None:
                continue
            if not last.ident:
                last.start()
            last.join(_PATIENCE)
            if last.is_alive():
                self._error = OSError(errno.ETIMEDOUT, f"the disk has not taken the file for {_PATIENCE:.0f} s")
            if self._error is not None:
                raise self._error

    def _call(self, rows: int) -> threading.Thread:
        def run() -> None:
            try:
                to_disk(self._handle)
            except OSError as error:
                self._error = error
            else:
                self.rows = rows

        return threading.Thread(target=run, name="to disk", daemon=True)
