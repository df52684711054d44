"""Signals that end work early: the first asks for a stop with the data so far, the second ends at once.

Python lets only the main thread catch signals. Other threads catch nothing; there the request to stop must come from
its owner.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from types import FrameType
from typing import Any

from beamline.core.stop import StopRequest

_ENDING = (
    "SIGTERM", "SIGHUP", "SIGQUIT", "SIGBREAK", "SIGUSR1", "SIGUSR2", "SIGALRM", "SIGVTALRM", "SIGPROF", "SIGXCPU",
    "SIGPWR",
)  # fmt: skip
"""Signals that would end the process, on any system: of a batch system, a time limit, a power failure."""
_SAID_WITHIN = 0.2  # s


@contextmanager
def stop_signals(stop: StopRequest) -> Iterator[None]:
    """Within the context the first Ctrl-C requests a stop, the second an abort.

    SIGTERM, a closed terminal (SIGHUP, unless `nohup` has it ignored), a closed console of Windows (SIGBREAK) and
    other signals that would end the process request a stop. Ctrl-Z suspends nothing: the shutter would stay open, and
    the watchdog would take the scan for dead.
    """

    def interrupt(number: int, frame: FrameType | None) -> None:
        if stop.stopping:
            stop.abort("Ctrl-C was pressed again")
            _say("Aborting.")
        else:
            stop.stop("Ctrl-C was pressed")
            _say("Stopping cleanly. Press Ctrl-C again to abort.")

    def terminate(number: int, frame: FrameType | None) -> None:
        stop.stop(f"the process received {signal.Signals(number).name}")

    def keep_on(number: int, frame: FrameType | None) -> None:
        _say("A scan is not suspended, as its shutter would stay open. `beamline pause` pauses it.")

    suspended = {signal.SIGTSTP: keep_on} if hasattr(signal, "SIGTSTP") else {}
    there = [getattr(signal, name) for name in _ENDING if hasattr(signal, name)]
    ending = [number for number in there if signal.getsignal(number) is not signal.SIG_IGN]
    with _caught({signal.SIGINT: interrupt, **suspended, **dict.fromkeys(ending, terminate)}):
        yield


class StopOnSignal:
    """A stop scope: the first Ctrl-C, SIGTERM or SIGHUP requests a stop with a partial result, the second interrupts.

    Args:
        reply: printed on the first signal.
        ready: there is, or soon will be, such a result. Before that the first signal interrupts.
    """

    def __init__(
        self, reply: str = "Stopping as soon as there is a volume. Ctrl-C again discards it.", ready: bool = True
    ) -> None:
        self._requested, self._reply, self.ready = False, reply, ready

    @contextmanager
    def __call__(self) -> Iterator[Callable[[], bool]]:
        with _caught(dict.fromkeys((signal.SIGINT, *_asking_to_end()), self._on_signal)):
            yield lambda: self._requested

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self._requested or not self.ready:
            raise KeyboardInterrupt
        self._requested = True
        _print(self._reply)


@contextmanager
def terminated_like_interrupted() -> Iterator[None]:
    """Within the context SIGTERM, and SIGHUP of a closed terminal, interrupt like Ctrl-C: no partial file stays."""
    with _caught(dict.fromkeys(_asking_to_end(), signal.default_int_handler)):
        yield


@contextmanager
def _caught(handlers: dict[signal.Signals, Any]) -> Iterator[None]:
    """Within the context signals have these handlers, if this is the main thread; afterwards the earlier ones."""
    with ExitStack() as restore:
        if threading.current_thread() is threading.main_thread():
            for number, handler in handlers.items():
                if signal.getsignal(number) is not None:  # None: not Python's, and could not be restored
                    restore.callback(signal.signal, number, signal.signal(number, handler))
        yield


def _asking_to_end() -> list[signal.Signals]:
    """The signals that ask a process to end; SIGHUP only where the system has it and `nohup` does not ignore it."""
    if sys.platform == "win32" or signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        return [signal.SIGTERM]
    return [signal.SIGTERM, signal.SIGHUP]


def _say(text: str) -> None:
    """Print in a thread of its own: a terminal without a reader must not delay the stop of the scan."""
    thread = threading.Thread(target=_print, args=(text,), daemon=True)
    thread.start()
    thread.join(_SAID_WITHIN)


def _print(text: str) -> None:
    with suppress(OSError, ValueError, AttributeError):  # the terminal is closed or missing
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()
