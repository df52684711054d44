"""What a command tells a program: one JSON event a line on stdout, the last of them `done` or `failed`."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from types import FrameType

import click
from click.exceptions import ClickException, Exit

from beamline.core.errors import exit_code, in_words
from beamline.core.events import Event, JsonLines, Sink
from drivers.clock import SystemClock


@contextmanager
def json_events(wanted: bool) -> Iterator[list[Sink]]:
    """The sinks for stdout, none where JSON is not wanted. What ends the block early becomes the event `failed`."""
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
            lines(Event("failed", SystemClock().now(), {"message": in_words(error), "exit_code": exit_code(error)}))
        raise


class StopOnSignal:
    """Ctrl-C, SIGTERM or SIGHUP during the work: the first asks for what there is so far, the second for nothing.

    Args:
        said: what the first one is answered with.
    """

    def __init__(self, said: str = "Ending as soon as there is a volume; once more throws it away.") -> None:
        self._asked, self._said = False, said

    @contextmanager
    def __call__(self) -> Iterator[Callable[[], bool]]:
        with ExitStack() as restore:
            for number in (signal.SIGINT, *_ending()):
                restore.callback(signal.signal, number, signal.signal(number, self._ask))
            yield lambda: self._asked

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self._asked:
            raise KeyboardInterrupt
        self._asked = True
        with suppress(OSError):  # a terminal that has hung up takes no words
            click.echo(self._said, err=True)


@contextmanager
def terminated_like_interrupted() -> Iterator[None]:
    """SIGTERM, and SIGHUP of a terminal that closes, end the command as Ctrl-C does: nothing half-written stays."""
    with ExitStack() as restore:
        for number in _ending():
            restore.callback(signal.signal, number, signal.signal(number, signal.default_int_handler))
        yield


def _ending() -> list[signal.Signals]:
    """The signals that ask a process to end, as far as this system has them and `nohup` has not taken them away."""
    if sys.platform == "win32" or signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        return [signal.SIGTERM]
    return [signal.SIGTERM, signal.SIGHUP]
