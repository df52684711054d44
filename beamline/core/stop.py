"""StopRequest: the operator's (or an alarm's) wish to end a scan, set from any thread or signal handler."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from beamline.core.errors import INTERRUPTED, ScanStopped

Stoppable = Callable[[], AbstractContextManager[Callable[[], bool]]]
"""Makes the context in which work may be ended early with what it has; within it, ask whether somebody wants that."""


@contextmanager
def never_stopped() -> Iterator[Callable[[], bool]]:
    """For work that nobody ends early."""
    yield lambda: False


class Heeded:
    """Whether work shall end early, asked on its behalf; remembers that it was told so."""

    def __init__(self, stopped: Callable[[], bool]) -> None:
        self._stopped = stopped
        self.told = False

    def __call__(self) -> bool:
        self.told = self.told or self._stopped()
        return self.told

    def cut(self, done: int, planned: int) -> bool:
        """Whether that left work undone: `planned` steps or iterations; 0 where there was another plan."""
        return self.told and not 0 < planned <= done


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
