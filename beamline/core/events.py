"""Events: everything that happens in a run, in one vocabulary; terminal, events.jsonl and log are sinks of them."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from types import MappingProxyType, TracebackType
from typing import Any, Self, TextIO

import numpy as np

from drivers.base.clock import Clock


@dataclass(frozen=True)
class Event:
    """One event.

    Attributes:
        event: its kind, one word of the vocabulary below.
        time: s since the Unix epoch.
        data: its values, by name.

    Vocabulary: run_started, state, block_started, frame (throttled), block_done, beam, flag, warning, snapshot, enough,
    progress, scan_done, recon_started, recon_done, tradeoff_started, study_started, trial, bench_started, bench,
    explain, check, done, failed.
    Events of a live reconstruction have source="recon".
    """

    event: str
    time: float
    data: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))

    def to_json(self) -> str:
        """One line of JSON; NaN and infinities become null, arrays become lists, paths strings."""
        return json.dumps({"event": self.event, "time": round(self.time, 6), **_plain(self.data)}, allow_nan=False)


Sink = Callable[[Event], None]


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(v) for v in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    return value if value is None else str(value)


class JsonLines:
    """A sink that writes one JSON line per event and flushes it, so that a crash loses no earlier event."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __call__(self, event: Event) -> None:
        self._stream.write(event.to_json() + "\n")
        self._stream.flush()


def fan_out(*sinks: Sink) -> Sink:
    """A sink that passes each event to all of `sinks`, in order."""

    def send(event: Event) -> None:
        for sink in sinks:
            sink(event)

    return send


def while_it_works(sink: Sink, tell: Sink) -> Sink:
    """A sink that gets events until it raises (a full disk, a closed pipe); `tell` then gets a warning, once."""
    works = True

    def send(event: Event) -> None:
        nonlocal works
        if not works:
            return
        try:
            sink(event)
        except Exception as error:
            works = False
            message = f"An output of events failed and gets no further events: {error}"
            tell(Event("warning", event.time, {"message": message}))

    return send


Emit = Callable[[str, Mapping[str, Any]], None]
"""(kind of event, data): the event happened now."""


class Warnings:
    """Sends each warning on as an event, once, and keeps it in `messages` for the report."""

    def __init__(self, sink: Sink, clock: Clock) -> None:
        self._sink, self._clock = sink, clock
        self.messages: list[str] = []

    def __call__(self, text: str) -> None:
        if text not in self.messages:
            self.messages.append(text)
            self._sink(Event("warning", self._clock.now(), {"message": text}))


_PATIENCE = 10.0  # s


class Announcer:
    """Passes events to sinks in a thread of its own. Leaving the context waits until all events have been passed on.

    It waits for `_PATIENCE` s at most: a terminal or pipe that nobody reads takes no event, and must not keep the
    program from ending. A sink that raises (a closed pipe, a full disk) gets no further events; the others get a
    warning.
    """

    def __init__(self, sinks: Sequence[Sink], clock: Clock) -> None:
        self._sinks, self._clock = [while_it_works(sink, self._send) for sink in sinks], clock
        self._queue: SimpleQueue[Event | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._deliver, name="announcer", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._queue.put(None)
        self._thread.join(_PATIENCE)

    def __call__(self, event: str, data: Mapping[str, Any]) -> None:
        """Queue the event with the current time; returns at once."""
        self._queue.put(Event(event, self._clock.now(), data))

    def _deliver(self) -> None:
        while (event := self._queue.get()) is not None:
            self._send(event)

    def _send(self, event: Event) -> None:
        for sink in self._sinks:
            sink(event)
