"""Parses lines of events, from another process or from a log, into events or plain values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields
from typing import Any

import beamline.core.recon_events  # noqa: F401 - a kind is known once its class is defined
from beamline.core.events import KINDS, SPREAD, Event
from beamline.core.process import json_object

LONGEST = 2**20
"""Largest size in bytes of a line of a log. The line that lists 100,000 missing triggers has 700 kB."""
LARGEST_LOG = 2**30
"""Largest number of bytes of a log that are read: enough for a week with ten lines per second."""


def event_of(values: Mapping[str, Any]) -> Event:
    """The event in a JSON line that another process wrote. Raises ValueError if no kind of event has these values."""
    fields_given = {name: value for name, value in values.items() if name != "event"}
    for each in KINDS.get(str(values.get("event")), ()):
        spread = {item.name: item.metadata[SPREAD][1] for item in fields(each) if SPREAD in item.metadata}
        own = {item.name for item in fields(each) if item.name not in spread}
        rest = {name: value for name, value in fields_given.items() if name not in own}
        # the class has other fields, or the values do not belong to the dataclass whose values are spread
        with suppress(TypeError):
            taken = {name: kind(**rest) for name, kind in spread.items()} or rest
            return each(**{name: value for name, value in fields_given.items() if name in own}, **taken)
    raise ValueError(f"no event has the values {dict(values)}")


def event_in(line: str | bytes) -> dict[str, Any] | None:
    """The values of an event in a line of a log; None if the line is not an event.

    Only kind and time of the event are checked. Other fields may be missing, unknown, or of another type, because
    another version may have written them.
    """
    with suppress(UnicodeDecodeError):
        text = line.decode() if isinstance(line, bytes) else line
        values = json_object(text) if len(text) <= LONGEST else None
        if values is not None and isinstance(values.get("event"), str) and _is_time(values.get("time", 0.0)):
            return values
    return None


def _is_time(value: Any) -> bool:
    return isinstance(value, int | float) and abs(value) < math.inf
