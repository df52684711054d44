"""Requests to end work early: a scan's StopRequest, and the stop scope of a reconstruction."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from beamline.core.errors import INTERRUPTED, ScanStopped

StopScope = Callable[[], AbstractContextManager[Callable[[], bool]]]
"""Opens a context for work that can end early with a partial result. The context gives a function that returns True
once a stop was requested."""


@contextmanager
def never_stopped() -> Iterator[Callable[[], bool]]:
    """The stop scope of work that nothing ends early."""
    yield lambda: False


class StopLatch:
    """Calls `stop_requested` until it returns True, and stays True from then on.

    Attributes:
        stopped: a call has returned True.
    """

    def __init__(self, stop_requested: Callable[[], bool]) -> None:
        self._stop_requested = stop_requested
        self.stopped = False

    def __call__(self) -> bool:
        self.stopped = self.stopped or self._stop_requested()
        return self.stopped

    def cut(self, done: int, planned: int) -> bool:
        """Whether the stop left some of the `planned` steps or iterations undone; 0 where none were planned."""
        return self.stopped and not 0 < planned <= done


class ScanAborted(ScanStopped):
    """Ended at once, or before anything was acquired; what was acquired is in the file."""

    exit_code = INTERRUPTED


class StopRequest:
    """Two wishes that cannot be taken back: stop (finish cleanly with what there is) and abort (end at once).

    Plain flags, each set by one assignment: a signal handler may interrupt another one in here, and a lock would hang.
    """

    def __init__(self) -> None:
        self._stop = self._abort = False
        self._reason = ""

    def stop(self, reason: str = "the operator asked for it") -> None:
        """End cleanly: frames on their way are taken, references still owed are taken, the stage goes back."""
        self._reason = self._reason or reason
        self._stop = True

    def abort(self, reason: str = "the operator aborted it") -> None:
        """End at once: the stage stands, the shutter closes, nothing else is taken."""
        self._reason = reason
        self._abort = True
        self._stop = True

    @property
    def stopping(self) -> bool:
        """Stop or abort was asked for."""
        return self._stop

    @property
    def aborting(self) -> bool:
        return self._abort

    @property
    def reason(self) -> str:
        return self._reason
