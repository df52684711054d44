"""What a command tells a program: one JSON event a line on stdout, the last of them `done` or `failed`."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType

import click
from click.exceptions import ClickException, Exit

from beamline.errors import exit_code, in_words
from beamline.events import Event, JsonLines, Sink
from drivers.clock import SystemClock


@contextmanager
def told_as_json(wanted: bool) -> Iterator[list[Sink]]:
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


class EndOfFit:
    """Ctrl-C or SIGTERM during a fit: the first asks it to end with what it has, the second throws it away."""

    def __init__(self) -> None:
        self.asked = False

    @contextmanager
    def __call__(self) -> Iterator[Callable[[], bool]]:
        with ExitStack() as restore:
            for number in (signal.SIGINT, signal.SIGTERM):
                restore.callback(signal.signal, number, signal.signal(number, self._ask))
            yield lambda: self.asked

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        click.echo("Ending the fit with what it has; once more throws it away.", err=True)


@contextmanager
def terminated_like_interrupted() -> Iterator[None]:
    """SIGTERM ends the command as Ctrl-C does, so that no half-written file stays behind."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
