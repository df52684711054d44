"""Requests to end work early: the StopRequest of a scan, the stop scope of a reconstruction, and the signals that make
the requests.

The first signal requests a stop that keeps the data so far; the second signal ends the work at once. In Python only the
main thread can catch signals. If the work runs in another thread, the owner of the request must request the stop.
"""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from enum import Enum
from types import FrameType
from typing import Any

from beamline.core.errors import INTERRUPTED, ScanStopped
from beamline.core.text import printable

_ENDING = [
    getattr(signal, name)
    for name in ("SIGTERM", "SIGHUP", "SIGBREAK", "SIGUSR1", "SIGUSR2", "SIGXCPU")
    if hasattr(signal, name)
]
"""Signals that ask a process to end, as far as the system has them. They come from a person, a closed terminal, or a
batch system."""


def stop_signals(stop: StopRequest) -> AbstractContextManager[None]:
    """A context in which the first Ctrl-C requests a stop, and the second Ctrl-C an abort.

    SIGTERM, a closed terminal (SIGHUP), a closed console of Windows (SIGBREAK) and the signals of batch systems request
    a stop. Ctrl-Z does not suspend the process, because the shutter would stay open, and the watchdog would conclude
    that the scan has died.
    """

    def interrupt(number: int, frame: FrameType | None) -> None:
        if stop.stopping:
            stop.abort("Ctrl-C was pressed again")
            to_stderr("Aborting.")
        else:
            stop.stop("Ctrl-C was pressed")
            to_stderr("Stopping cleanly. Press Ctrl-C again to abort.")

    def terminate(number: int, frame: FrameType | None) -> None:
        stop.stop(f"the process received {signal.Signals(number).name}")
        if not stop.aborting:
            to_stderr(f"Stopping cleanly, because the process received {signal.Signals(number).name}. Ctrl-C aborts.")

    def keep_on(number: int, frame: FrameType | None) -> None:
        to_stderr(
            "Use `beamline pause` to pause the scan. This program cannot be suspended, because the shutter would "
            "stay open."
        )

    suspended = {signal.SIGTSTP: keep_on} if hasattr(signal, "SIGTSTP") else {}
    return _caught({signal.SIGINT: interrupt, **suspended, **dict.fromkeys(_ENDING, terminate)})


class StopOnSignal:
    """A stop scope: the first Ctrl-C, SIGTERM or SIGHUP requests a stop with a partial result; the second one
    interrupts the work.

    Args:
        reply: sentence that is printed after the first signal.
        ready: function that returns True if there is a partial result, or will be soon. If it returns False, the first
            signal interrupts the work.
    """

    def __init__(
        self,
        reply: str = "Stopping as soon as there is a volume. Press Ctrl-C again to stop without a volume.",
        ready: bool = True,
    ) -> None:
        self._requested, self._reply, self.ready = False, reply, ready

    @contextmanager
    def __call__(self) -> Iterator[Callable[[], bool]]:
        with _caught(dict.fromkeys((signal.SIGINT, *_ENDING), self._on_signal)):
            yield lambda: self._requested

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self._requested or not self.ready:
            raise KeyboardInterrupt
        self._requested = True
        to_stderr(self._reply)


def terminated_like_interrupted() -> AbstractContextManager[None]:
    """A context in which SIGTERM and SIGHUP (closed terminal) interrupt the work in the same way as Ctrl-C, so that no
    partial file remains.
    """
    return _caught(dict.fromkeys(_ENDING, signal.default_int_handler))


@contextmanager
def _caught(handlers: dict[signal.Signals, Any]) -> Iterator[None]:
    """A context in which signals have these handlers, if it runs in the main thread. The end of the context restores
    the old handlers.

    Signals that are ignored stay ignored: SIGHUP under `nohup`, and SIGINT if a script started this process in the
    background.
    """
    with ExitStack() as restore:
        if threading.current_thread() is threading.main_thread():
            for number, handler in handlers.items():
                if signal.getsignal(number) not in (
                    None,
                    signal.SIG_IGN,
                ):  # None: the handler is not from Python and cannot be restored
                    restore.callback(signal.signal, number, signal.signal(number, handler))
        yield


def to_stderr(text: str) -> None:
    """Print a sentence to stderr, as the commands do."""
    with suppress(OSError, ValueError, AttributeError):  # the terminal is closed or missing
        sys.stderr.write(f"{printable(text)}\n")
        sys.stderr.flush()


StopScope = Callable[[], AbstractContextManager[Callable[[], bool]]]
"""Opens a context for work that can end early with a partial result. The context gives a function that returns True
after a stop was requested."""


@contextmanager
def never_stopped() -> Iterator[Callable[[], bool]]:
    """The stop scope of work that cannot be stopped early."""
    yield lambda: False


class ScanAborted(ScanStopped):
    """The scan was aborted, or interrupted before its first frame; the frames acquired so far are in the file."""

    exit_code = INTERRUPTED


class Cause(Enum):
    """Cause of a pause. The pause lasts as long as its cause."""

    BEAM = "beam"
    SPACE = "space on the disk"
    BACKLOG = "frames that wait to be written"


class PauseRequest:
    """A request to pause a scan, from any thread, until the operator resumes it or its causes have ended."""

    def __init__(self) -> None:
        self._by_operator = ""
        self._held_by: dict[Cause, str] = {}
        self._unlit_since, self._lock = math.inf, threading.Lock()

    @property
    def reason(self) -> str:
        """The reason why the scan should wait, and how the wait ends; "" if the scan should not wait."""
        return self._by_operator or next(iter([*self._held_by.values()]), "")

    @property
    def ends_by_itself(self) -> bool:
        """Whether the disk is the only cause, so that the pause ends without the operator."""
        return not self._by_operator and self._held_by.keys() <= {Cause.SPACE, Cause.BACKLOG}

    def pause(self, reason: str = "the operator asked for it") -> None:
        self._by_operator = (
            f"{reason.rstrip('.')}. Press Enter or use `beamline resume` to continue; Ctrl-C or "
            "`beamline stop` ends the scan"
        )

    def resume(self) -> None:
        """End a pause that the operator requested. A pause because of missing beam or a slow disk continues."""
        self._by_operator = ""

    def no_beam(self, reason: str, since: float) -> None:
        """Record that the beam is missing, optionally since a given time (s since the Unix epoch)."""
        with self._lock:
            self._unlit_since = min(self._unlit_since, since)
        self.hold(Cause.BEAM, reason)

    def hold(self, by: Cause, reason: str) -> None:
        """Pause until this cause is released."""
        self._held_by[by] = reason

    def release(self, by: Cause) -> None:
        self._held_by.pop(by, None)

    def take_unlit_since(self) -> float:
        """The time since which frames may be without beam; inf if no frame is. Each such time is returned only once."""
        with self._lock:
            since, self._unlit_since = self._unlit_since, math.inf
        return since


class StopRequest:
    """A request to stop a scan (finish cleanly with fewer frames) or to abort it (end at once). A request cannot be
    undone.

    Any thread or signal handler can make the request. The class uses no lock, because a signal handler that interrupts
    another handler would wait for ever for a lock that the interrupted handler holds. Instead of using a lock, each
    method sets an attribute by a single assignment.

    Args:
        now: a clock that gives real time in s.

    Attributes (read only):
        stopping: True if a stop or an abort was requested.
        aborting: True if an abort was requested.
        reason: reason of the first stop, or of the last abort.
        by_person: True if a person or the operating system made the request; False if only the scan itself made it.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self.stopping = self.aborting = self.by_person = False
        self.reason, self._now, self._requested_at = "", now, 0.0

    def refuse_abort(self) -> None:
        """Raise ScanAborted if an abort was requested."""
        if self.aborting:
            raise ScanAborted(f"Aborted: {self.reason}.")

    def stop(self, reason: str = "the operator asked for it", *, by_itself: bool = False) -> None:
        """Request a clean end: the scan still acquires pending frames, and the planned darks (or flats) if it has no
        darks (or flats) yet. The stage returns.

        Args:
            by_itself: True if the scan itself requests the stop, because the frames so far show that no more frames are
                needed.
        """
        self.by_person = self.by_person or not by_itself
        self.reason = self.reason or reason
        self._requested_at = self._requested_at or self._now()
        self.stopping = True

    def abort(self, reason: str = "the operator aborted it") -> None:
        """Request an end at once: the stage stops, the shutter closes, and no further frame is acquired."""
        self.reason, self.by_person = reason, True
        self._requested_at = self._requested_at or self._now()
        self.aborting = True
        self.stopping = True

    @property
    def seconds(self) -> float:
        """Real time in s since the first request; 0 without a request."""
        return self._now() - self._requested_at if self.stopping else 0.0
