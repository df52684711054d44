"""JSON output of commands, one event per line on stdout."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from click.exceptions import ClickException, Exit

from beamline.core.errors import exit_code, user_message
from beamline.core.events import Event, JsonLines, Sink
from drivers.base.clock import SystemClock


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
