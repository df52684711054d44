"""The log of a call: every event as a line of text, in a file or on a terminal."""

from __future__ import annotations

import shlex
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import TextIO

from beamline.cli.terminal import closed_terminal_ignored
from beamline.core.errors import user_message
from beamline.core.events import Event, Failed, ReconStarted, Sink, StateEntered
from beamline.core.files import named_on_failure, refuse_existing
from beamline.core.narration import sentence
from beamline.core.shipped import version
from beamline.core.sinks import while_it_works
from beamline.core.text import printable
from beamline.scan.run_folder import new_log
from drivers.base.clock import SystemClock


class LogLines:
    """A sink that writes every event as a line: time, kind, and its sentence, or its values if it has no sentence.

    Where `terminal`, errors of one that was closed are ignored; from a file the same error is one of its disk.
    """

    def __init__(self, stream: TextIO, *, terminal: bool = False) -> None:
        self._stream, self._lock = stream, threading.Lock()
        self._ignored = closed_terminal_ignored if terminal else nullcontext

    def __call__(self, event: Event) -> None:
        text = None if isinstance(event, ReconStarted) else sentence(event)
        if text is None:
            text = ", ".join(f"{name} {value}" for name, value in event.data.items())
        at = datetime.fromtimestamp(event.time, UTC).isoformat(timespec="milliseconds")
        with self._lock, self._ignored():
            self._stream.write(f"{at}  {event.event}: {printable(' '.join(text.split()))}\n")
            self._stream.flush()


@contextmanager
def logged(path: Path | None, warn: Sink) -> Iterator[list[Sink]]:
    """The sink that writes a log, if one is requested. An error in the block becomes its last line.

    If its disk is full, `warn` gets a warning, and the work goes on.
    """
    if path is None:
        yield []
        return
    refuse_existing(path)
    with ExitStack() as closing:
        with named_on_failure(path):
            file = closing.enter_context(new_log(path))
        write = LogLines(file)

        def named(event: Event) -> None:
            with named_on_failure(path):
                write(event)

        lines = while_it_works(named, warn)
        lines(StateEntered("", f"splatline {version()}: {shlex.join(sys.argv)}", time=SystemClock().now()))
        try:
            yield [lines]
        except (Exception, KeyboardInterrupt) as error:
            lines(Failed(user_message(error), time=SystemClock().now()))
            raise
