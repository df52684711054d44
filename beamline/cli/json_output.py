"""JSON output of commands, one event per line on stdout, and the signals that end a command early."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from types import FrameType

import click
from click.exceptions import ClickException, Exit

from beamline.core.errors import exit_code, user_message
from beamline.core.events import Event, JsonLines, Sink
from drivers.clock import SystemClock


@contextmanager
def json_events(wanted: bool) -> Iterator[list[Sink]]:
    """The sinks for JSON on stdout; none unless `wanted`. An error in the block becomes the event `failed`."""
    if not wanted:
        yield []
        return
    lines = JsonLines(sys.stdout)
    last = ""

    def remember(event: Event) -> None:
        nonlocal last
        last = event.event
        lines(event)

    try:
        yield [remember]
    except (Exit, ClickException):
        raise
    except (Exception, KeyboardInterrupt) as error:
        if last not in ("done", "failed"):
            lines(Event("failed", SystemClock().now(), {"message": user_message(error), "exit_code": exit_code(error)}))
        raise


class StopOnSignal:
    """A stop scope: the first Ctrl-C, SIGTERM or SIGHUP requests a stop with a partial result, the second interrupts.

    Args:
        reply: printed on the first signal.
    """

    def __init__(self, reply: str = "Stopping as soon as there is a volume. Ctrl-C again discards it.") -> None:
        self._requested, self._reply = False, reply

    @contextmanager
    def __call__(self) -> Iterator[Callable[[], bool]]:
        with ExitStack() as restore:
            for number in (signal.SIGINT, *_ending()):
                restore.callback(signal.signal, number, signal.signal(number, self._on_signal))
            yield lambda: self._requested

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self._requested:
            raise KeyboardInterrupt
        self._requested = True
        with suppress(OSError):  # the terminal was closed
            click.echo(self._reply, err=True)


@contextmanager
def terminated_like_interrupted() -> Iterator[None]:
    """Within the context SIGTERM, and SIGHUP of a closed terminal, interrupt like Ctrl-C: no partial file stays."""
    with ExitStack() as restore:
        for number in _ending():
            restore.callback(signal.signal, number, signal.signal(number, signal.default_int_handler))
        yield


def _ending() -> list[signal.Signals]:
    """The signals that ask a process to end; SIGHUP only where the system has it and `nohup` does not ignore it."""
    if sys.platform == "win32" or signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        return [signal.SIGTERM]
    return [signal.SIGTERM, signal.SIGHUP]
