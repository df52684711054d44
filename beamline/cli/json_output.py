"""JSON output of commands, one event per line on stdout."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from click.exceptions import ClickException, Exit

from beamline.core.errors import exit_code, user_message
from beamline.core.events import Event, Failed, Sink
from beamline.core.sinks import JsonLines, fan_out
from drivers.base.clock import SystemClock


@contextmanager
def json_events(wanted: bool) -> Iterator[Sink]:
    """The sink for JSON on stdout, idle unless `wanted`. An error in the block becomes the event `failed`."""
    if not wanted:
        yield fan_out()
        return
    lines = JsonLines(sys.stdout)
    last: list[Event] = []
    try:
        yield fan_out(last.append, lines)
    except (Exit, ClickException):
        raise
    except (Exception, KeyboardInterrupt) as error:
        if not (last and last[-1].event in ("done", "failed")):
            lines(Failed(user_message(error), exit_code(error), time=SystemClock().now()))
        raise
