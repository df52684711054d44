"""Announcer: events from any thread reach every sink in order, and no slow or broken sink ever holds up a scan."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from queue import SimpleQueue
from types import TracebackType
from typing import Any, Self

from beamline.events import Event, Sink
from drivers.clock import Clock


class Announcer:
    """Use as a context manager: leaving it waits until the sinks have had everything.

    A sink that raises (a closed pipe, a full disk) gets nothing more; the others are told.
    """

    def __init__(self, sinks: Sequence[Sink], clock: Clock) -> None:
        self._sinks, self._clock = list(sinks), clock
        self._queue: SimpleQueue[Event | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._deliver, name="announcer", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._queue.put(None)
        self._thread.join()

    def __call__(self, event: str, data: Mapping[str, Any]) -> None:
        """Say that `event` happened now. Returns at once."""
        self._queue.put(Event(event, self._clock.now(), data))

    def _deliver(self) -> None:
        while (event := self._queue.get()) is not None:
            self._send(event)

    def _send(self, event: Event) -> None:
        for sink in list(self._sinks):
            if sink not in self._sinks:  # given up while the others were told of another
                continue
            try:
                sink(event)
            except Exception as error:
                self._sinks.remove(sink)
                message = f"an output of events was given up: {error}"
                self._send(Event("warning", event.time, {"message": message}))
