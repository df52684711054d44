"""Sinks of events: JSON lines, several sinks as one, warnings, and a thread that passes events on."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from queue import SimpleQueue
from typing import Self, TextIO

from beamline.core.events import Event, Sink, StateEntered, Warned
from drivers.base.clock import Clock

Warn = Callable[[str], None]  # Takes a sentence about something that is wrong though work goes on


class Note(str):
    """A sentence about what was done: nothing is wrong. Who takes warnings tells it as a state."""


def event_of_sentence(text: str, now: float) -> Event:
    """A warning; of a note a state."""
    return StateEntered("note", text, time=now) if isinstance(text, Note) else Warned(text, time=now)


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


def while_it_works(sink: Sink, others: Sink) -> Sink:
    """Pass events to a sink until it raises (a full disk, a closed pipe); then warn `others` once."""
    works = True

    def send(event: Event) -> None:
        nonlocal works
        if not works:
            return
        try:
            sink(event)
        except BaseException as error:  # of somebody's code; SystemExit would end the announcer in silence
            if isinstance(error, KeyboardInterrupt) and threading.current_thread() is threading.main_thread():
                raise  # Ctrl-C
            works = False
            why = f"{type(error).__name__}: {error}"
            others(Warned(f"An output of events failed and gets no further events: {why}", time=event.time))

    return send


class Warnings:
    """Sends each warning or note on as an event, once, and keeps it in `messages` for the report."""

    def __init__(self, sink: Sink, clock: Clock) -> None:
        self._sink, self._clock = sink, clock
        self.messages: list[str] = []

    def __call__(self, text: str) -> None:
        if text not in self.messages:
            self.messages.append(text)
            self._sink(event_of_sentence(text, self._clock.now()))


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

    def __exit__(self, *error: object) -> None:
        self._queue.put(None)
        self._thread.join(_PATIENCE)

    def __call__(self, event: Event) -> None:
        """Queue the event with the current time; returns at once."""
        self._queue.put(replace(event, time=self._clock.now()))

    def _deliver(self) -> None:
        while (event := self._queue.get()) is not None:
            self._send(event)

    def _send(self, event: Event) -> None:
        for sink in self._sinks:
            sink(event)
